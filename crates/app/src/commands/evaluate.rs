//! `snapsnap evaluate`.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::tensor::Device;
use clap::{Args, ValueEnum};
use snapsnap_eval::baselines::MeanPictures;
use snapsnap_eval::evaluate::config::{Ablation, EvalConfig};
use snapsnap_eval::evaluate::meshes::{Align, evaluate_meshes};
use snapsnap_eval::evaluate::model::{Leave, Model};
use snapsnap_eval::evaluate::person::People;
use snapsnap_eval::evaluate::{Contestant, LeftOut, Outcome, evaluate, sheet};
use snapsnap_eval::report;
use snapsnap_eval::report::evaluation::{Cost, Evaluation};

use snapsnap_base::config::Schema;

use super::{ConfigArguments, outside_data};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::report::{ReportFolder, header};
use crate::{device, memory, perceptual, say, weights};

#[derive(Args)]
pub struct Arguments {
    /// What to compare, how and with what, as in configs/eval.toml.
    #[arg(long, value_name = "TOML")]
    config: PathBuf,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Data sets [default: data.folders of the config].
    #[arg(long, value_name = "DATASET", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Weights to judge [default: model.weights of the config, else those that come with the program].
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Other weights, which are compared with these person by person.
    #[arg(long, value_name = "FILE|DIR")]
    against: Option<PathBuf>,
    /// Judge the meshes NAME.obj, .ply or .glb in this folder instead of weights.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["weights", "against"])]
    mesh_dir: Option<PathBuf>,
    /// Move meshes onto the truth first: turned and moved (rigid), or scaled as well (similarity).
    #[arg(long, value_enum, value_name = "HOW", num_args = 0..=1, default_missing_value = "rigid")]
    icp: Option<Icp>,
    #[command(flatten)]
    lpips: perceptual::Arguments,
    /// Folder of the report.
    #[arg(short, long, value_name = "REPORT")]
    output: PathBuf,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal [default: model.devices of the config].
    #[arg(long)]
    device: Option<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Icp {
    Rigid,
    Similarity,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    if arguments.icp.is_some() && arguments.mesh_dir.is_none() {
        return Err(Failure::Input("--icp needs --mesh-dir: only meshes are moved".into()));
    }
    let config = config_of(arguments)?;
    if config.data.folders.is_empty() {
        let message =
            "no data: give --data DATASET, made with `snapsnap prepare`, or data.folders in the config";
        return Err(Failure::Input(message.into()));
    }
    let folders = &config.data.folders;
    let mut known = HashSet::new();
    if let Some(again) = folders.iter().find(|f| !known.insert(f.canonicalize().unwrap_or((*f).clone()))) {
        return Err(Failure::Input(format!("data.folders: {} is there twice", again.display())));
    }
    let (mut sets, mut missing, mut first) = (Vec::new(), Vec::new(), None);
    for path in folders {
        match People::open(path, &config.data, &config.views) {
            Ok(set) => sets.push(set),
            Err(e) => {
                missing.push(LeftOut { name: path.display().to_string(), why: e.to_string() });
                first.get_or_insert(e);
            }
        }
    }
    if let (true, Some(e)) = (sets.is_empty(), first) {
        return Err(e.into());
    }
    let roots = sets.iter().map(|set| set.folder().root());
    outside_data(&arguments.output, roots.chain(config.baselines.mean.iter().map(PathBuf::as_path)))?;
    if let Some(meshes) = &arguments.mesh_dir {
        return judge_meshes(arguments, &config, &sets, meshes, missing, quiet);
    }
    let names = match (&arguments.device, config.model.devices.as_slice()) {
        (Some(name), _) => vec![name.clone()],
        (None, []) => vec!["auto".to_owned()],
        (None, names) => names.to_vec(),
    };
    let devices = names.iter().map(|name| device::choose(name)).collect::<Result<Vec<_>, _>>()?;
    let others = config.ablations.values().filter_map(|ablation| ablation.weights.as_ref());
    let inputs: Vec<&Path> = std::iter::once(&arguments.config)
        .chain(&config.model.weights)
        .chain(others)
        .chain(arguments.lpips.files())
        .map(PathBuf::as_path)
        .collect();
    let lpips = arguments.lpips.load_or(&config.metrics.lpips, &names[0])?;
    let contestants = contestants(&config, &sets, (&names, &devices), &mut missing)?;
    if contestants.is_empty() {
        let whys: Vec<String> = missing.iter().map(|m| format!("{}: {}", m.name, m.why)).collect();
        return Err(Failure::Input(format!("nothing is left to evaluate: {}", whys.join("; "))));
    }
    let folder = ReportFolder::new(&arguments.output, &inputs)?;

    let people = sets.iter().map(|set| set.chosen().len()).sum();
    let progress = Progress::steps(quiet, people, "people");
    let done = |done: usize, total: usize| progress.step(done, total, "people");
    let start = Instant::now();
    let mut outcome = evaluate(&config, &sets, &contestants, lpips.as_ref().ok(), &done);
    let cost = Cost { seconds: start.elapsed().as_secs_f64(), memory: memory::most_used() };
    drop(progress);
    outcome.left_out.splice(0..0, missing);
    let described = perceptual::describe(&lpips);
    let named = device::describe(&devices[0]);
    let shown = contestants.iter().find(|contestant| contestant.networks().is_some());
    let ranked = report_of(&named, &config, &outcome, &described, cost).ranked(config.report.people);
    let mut people = None;
    if let Some(contestant) = shown.filter(|_| !ranked.is_empty()) {
        let (picture, mut left_out) = sheet(&config, &sets, contestant, &ranked);
        people = picture;
        outcome.left_out.append(&mut left_out);
    }
    let report = report_of(&named, &config, &outcome, &described, cost);
    let by_view = report.by_view();
    let pictures: Vec<&str> = [(people.is_some(), "people.png"), (!by_view.is_empty(), "by_view.svg")]
        .into_iter()
        .filter_map(|(there, name)| there.then_some(name))
        .collect();
    folder.picture("people.png", people.as_ref())?;
    folder.text("by_view.svg", &by_view)?;
    folder.text("views.csv", &report.views_csv())?;
    folder.text("subjects.csv", &report.subjects_csv())?;
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report.markdown(&pictures))?;
    let json = report.json();
    folder.finish(&json)?;
    if !quiet {
        say::out(&summary(&json));
        say::out(&format!("{}: report.md, report.json, pictures and tables", folder.path().display()));
    }
    complete(&outcome.left_out)
}

fn report_of<'a>(
    device: &str,
    config: &'a EvalConfig,
    outcome: &'a Outcome,
    lpips: &str,
    cost: Cost,
) -> Evaluation<'a> {
    Evaluation { header: header(device), config, outcome, lpips: lpips.into(), cost }
}

/// What is left out is told, and is a failure.
fn complete(left_out: &[LeftOut]) -> Result<(), Failure> {
    if left_out.is_empty() {
        return Ok(());
    }
    left_out.iter().for_each(|l| say::err(&format!("left out: {}: {}", l.name, l.why)));
    Err(Failure::Internal(format!("{} left out, the rest, if there is any, was evaluated", left_out.len())))
}

fn judge_meshes(
    arguments: &Arguments,
    config: &EvalConfig,
    sets: &[People],
    meshes: &Path,
    missing: Vec<LeftOut>,
    quiet: bool,
) -> Result<(), Failure> {
    if !meshes.is_dir() {
        return Err(Failure::Input(format!("--mesh-dir {}: is no folder", meshes.display())));
    }
    let folder = ReportFolder::new(&arguments.output, &[&arguments.config])?;
    let (align, said) = match arguments.icp {
        None => (Align::No, "none: as the meshes are"),
        Some(Icp::Rigid) => (Align::Rigidly, "rigid, by iterated closest points"),
        Some(Icp::Similarity) => (Align::Similarly, "rigid and scale, by iterated closest points"),
    };
    let total = sets.iter().map(|set| set.chosen().len()).sum();
    let progress = Progress::steps(quiet, total, "people");
    let done = |done: usize, total: usize| progress.step(done, total, "people");
    let (figures, mut left_out) = evaluate_meshes(config, sets, meshes, align, &done);
    drop(progress);
    left_out.splice(0..0, missing);
    let header = header("cpu");
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report::meshes::markdown(&header, &figures, &left_out, said))?;
    let json = report::meshes::json(&header, &figures, &left_out);
    folder.finish(&json)?;
    if !quiet {
        for (name, figure) in json["geometry_cm"].as_object().into_iter().flatten() {
            say::out(&format!(
                "{name:<20} {}{}",
                figure["mean"].as_f64().map_or("n/a".into(), |v| format!("{v:.4}")),
                if name == "normal_consistency" { "" } else { " cm" }
            ));
        }
    }
    complete(&left_out)
}

fn config_of(arguments: &Arguments) -> Result<EvalConfig, Failure> {
    let mut config = EvalConfig::from_file(&arguments.config, &arguments.set)?;
    if !arguments.data.is_empty() {
        config.data.folders.clone_from(&arguments.data);
    }
    if arguments.weights.is_some() {
        config.model.weights.clone_from(&arguments.weights);
    }
    if let Some(against) = &arguments.against {
        let other = Ablation { weights: Some(against.clone()), ..Ablation::default() };
        config.ablations.insert("against".into(), other);
    }
    Ok(config)
}

/// The model, what it is compared with, and the baselines; what cannot be loaded goes to `missing`.
fn contestants(
    config: &EvalConfig,
    sets: &[People],
    (names, devices): (&[String], &[Device]),
    missing: &mut Vec<LeftOut>,
) -> Result<Vec<Contestant>, Failure> {
    let mut contestants = Vec::new();
    let mut left_out = |name: &str, why: String| missing.push(LeftOut { name: name.into(), why });
    let whole = Ablation::default();
    let model = |ablation: &Ablation, device: &Device| -> Result<Model, Failure> {
        let path = ablation.weights.as_deref().or(config.model.weights.as_deref());
        let set = [config.model.set.clone(), ablation.set.clone()].concat();
        let weights = weights::open(path, &ConfigArguments { config: None, set })?;
        memory::check_networks(&weights, device)?;
        let sides = ablation.sides && !has_known_sides(config);
        let leave = Leave { sides, side_colors: ablation.side_colors, ..Leave::default() };
        let photographs = ablation.photographs.unwrap_or(config.photographs);
        let mut model = Model::load(&weights, device, leave)?;
        model.photographs = photographs;
        Ok(model)
    };
    match model(&whole, &devices[0]) {
        Ok(model) => contestants.push(Contestant::model("model", model)),
        Err(e) => left_out("model", e.to_string()),
    }
    for (name, device) in names.iter().zip(devices).skip(1) {
        match model(&whole, device) {
            Ok(model) => contestants.push(Contestant::other(&format!("on {name}"), model)),
            Err(e) => left_out(name, e.to_string()),
        }
    }
    for (name, ablation) in &config.ablations {
        match model(ablation, &devices[0]) {
            Ok(model) => contestants.push(Contestant::other(name, model)),
            Err(e) => left_out(name, e.to_string()),
        }
    }
    if config.baselines.billboard {
        contestants.push(Contestant::billboard(&devices[0]));
    }
    if config.baselines.true_points {
        contestants.push(Contestant::true_points(&devices[0]));
    }
    if !config.baselines.mean.is_empty() {
        let views = sets[0].views();
        let mean = match sets.iter().find(|set| set.views() != views) {
            Some(set) => Err(snapsnap_eval::EvalError::Empty(format!(
                "{} has {} views, the data set before it {views}: no one picture is the mean of a view",
                set.folder().root().display(),
                set.views()
            ))),
            None => MeanPictures::new(&config.baselines.mean, views),
        };
        match mean {
            Ok(pictures) => contestants.push(Contestant::mean(pictures)),
            Err(e) => left_out("mean_picture", e.to_string()),
        }
    }
    Ok(contestants)
}

/// Scenes of more than two photographs have no unseen sides.
fn has_known_sides(config: &EvalConfig) -> bool {
    config.views.inputs.len() > 2
}

/// The most important lines.
fn summary(report: &serde_json::Value) -> String {
    let mut lines = Vec::new();
    let mut line = |name: &str, figures: &serde_json::Value| {
        let figure = |key: &str| match &figures[key]["mean"] {
            serde_json::Value::Null => "n/a".to_owned(),
            value => value.as_f64().map_or("inf".into(), |v| format!("{v:.4}")),
        };
        let (psnr, ssim, lpips) = (figure("psnr"), figure("ssim"), figure("lpips"));
        lines.push(format!("{name:<28} PSNR {psnr:>8} dB   SSIM {ssim}   LPIPS {lpips}"));
    };
    for (protocol, found) in report["protocols"].as_object().into_iter().flatten() {
        line(&format!("model, {protocol}"), &found["overall"]);
        for kind in ["compared", "baselines"] {
            for (name, found) in report[kind].as_object().into_iter().flatten() {
                let found = if kind == "compared" { &found["protocols"] } else { found };
                line(&format!("{name}, {protocol}"), &found[protocol]);
            }
        }
    }
    lines.join("\n")
}
