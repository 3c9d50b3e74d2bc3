//! `snapsnap evaluate`.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::tensor::Device;
use clap::Args;
use serde_json::Value;
use snapsnap_base::config::Schema;
use snapsnap_data::sample::PhotographChanges;
use snapsnap_eval::evaluate::config::EvalConfig;
use snapsnap_eval::evaluate::meshes::evaluate_meshes;
use snapsnap_eval::evaluate::model::Model;
use snapsnap_eval::evaluate::person::People;
use snapsnap_eval::evaluate::{Contestant, Kind, LeftOut, evaluate, sheet};
use snapsnap_eval::geometry::Align;
use snapsnap_eval::report;
use snapsnap_eval::report::evaluation::{Cost, Evaluation};
use snapsnap_eval::variant::Variant;
use snapsnap_net::weights::WeightFile;

use crate::arguments::{ConfigArguments, check_utf8, one_of};
use crate::failure::{Failure, bail};
use crate::output::outside_data;
use crate::pictures::write_png;
use crate::progress::Progress;
use crate::report::{ReportFolder, complete, header, nothing_left};
use crate::{device, memory, perceptual, say, weights};

#[derive(Args)]
pub struct Arguments {
    /// Config of the evaluation, as in configs/eval.toml.
    #[arg(long, value_name = "TOML")]
    config: PathBuf,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Data sets [default: data.folders of the config].
    #[arg(long, value_name = "DATASET", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Weights of the model [default: model.weights of the config, else the program's own].
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Other weights, which are compared with the model person by person.
    #[arg(long, value_name = "FILE|DIR")]
    against: Option<PathBuf>,
    /// Also evaluate the model on changed photographs. grey: every pixel of the person gets the person's mean colour,
    /// so that only the outline is left.
    #[arg(long, value_parser = ["grey"], value_name = "KIND", conflicts_with = "mesh_dir")]
    inputs: Option<String>,
    /// Evaluate the meshes NAME.obj, .ply or .glb in this folder instead of weights.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["weights", "against"])]
    mesh_dir: Option<PathBuf>,
    /// Align models or meshes with the ground truth first: turned and moved (rigid), or scaled as well (similarity).
    #[arg(long, value_parser = one_of(ALIGN), value_name = "HOW", num_args = 0..=1)]
    #[arg(default_missing_value = "rigid")]
    align: Option<Align>,
    #[command(flatten)]
    lpips: perceptual::Arguments,
    /// Folder of the report.
    #[arg(short, long, value_name = "REPORT")]
    output: PathBuf,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal [default: model.device of the config].
    #[arg(long)]
    device: Option<String>,
}

const ALIGN: [(&str, &str, Align); 3] =
    [("none", "", Align::None), ("rigid", "", Align::Rigid), ("similarity", "", Align::Similarity)];
/// The end of the message about failed parts.
const REST: &str = "the rest, if there is any, was evaluated";

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let config = config_of(arguments)?;
    let (sets, mut missing) = data_sets(&config)?;
    let roots = sets.iter().map(|set| set.folder.root());
    outside_data(&arguments.output, roots)?;
    if let Some(meshes) = &arguments.mesh_dir {
        return judge_meshes(arguments, &config, &sets, meshes, missing);
    }
    let name = arguments.device.as_deref().or(config.model.device.as_deref()).unwrap_or("auto");
    let device = device::choose(name)?;
    let variants = config.variants(name);
    let inputs = inputs(&arguments.config, &variants, &arguments.lpips);
    let lpips = arguments.lpips.load(&config.metrics.lpips, name)?;
    let contestants = contestants(&config, &variants, &device, &mut missing);
    if contestants.is_empty() {
        return Err(nothing_left("nothing is left to evaluate", &missing));
    }
    let folder = ReportFolder::new(&arguments.output, &inputs)?;

    let start = Instant::now();
    let progress = Progress::counted("people");
    let mut outcome = evaluate(&config, &sets, &contestants, lpips.as_ref().ok(), &progress);
    let cost = Cost { seconds: start.elapsed().as_secs_f64(), memory: memory::most_used() };
    drop(progress);
    outcome.left_out.splice(0..0, missing);
    let (header, lpips) = (header(&device::describe(&device)), perceptual::describe(&lpips));
    let mut report = Evaluation { header, config: &config, outcome, lpips, cost };
    let mut pictures = Vec::new();
    let ranked = report.ranked(config.report.people);
    // The first contestant is the model, without which the ranking is empty.
    if !ranked.is_empty() {
        let (picture, left_out) = sheet(&config, &sets, &contestants[0], &ranked);
        report.outcome.left_out.extend(left_out);
        if let Some(picture) = picture {
            write_png(&folder.file("people.png"), &picture)?;
            pictures.push("people.png");
        }
    }
    let by_view = report.by_view();
    if !by_view.is_empty() {
        folder.text("by_view.svg", &by_view)?;
        pictures.push("by_view.svg");
    }
    folder.text("views.csv", &report.views_csv())?;
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report.markdown(&pictures))?;
    let json = report.json();
    folder.finish(&json)?;
    summarise(&json);
    say::info(&format!("{}: report.md, report.json, pictures and tables", folder.path.display()));
    complete(&report.outcome.left_out, REST)
}

/// Files that a report must not replace.
pub(super) fn inputs<'a>(
    config: &'a Path,
    variants: &'a [(String, Variant)],
    lpips: &'a perceptual::Arguments,
) -> Vec<&'a Path> {
    let weights = variants.iter().filter_map(|(_, variant)| variant.weights.as_ref());
    let files = weights.chain(&lpips.files).map(PathBuf::as_path);
    std::iter::once(config).chain(files).collect()
}

/// Refuses a config without data sets.
pub(super) fn check_data(folders: &[PathBuf]) -> Result<(), Failure> {
    if folders.is_empty() {
        bail!("no data: give --data DATASET, made with `snapsnap prepare`, or data.folders in the config");
    }
    Ok(())
}

/// The data sets that can be opened, at least one, and failures of the others.
fn data_sets(config: &EvalConfig) -> Result<(Vec<People>, Vec<LeftOut>), Failure> {
    check_data(&config.data.folders)?;
    let mut known = HashSet::new();
    let (mut sets, mut missing, mut first) = (Vec::new(), Vec::new(), None);
    for path in &config.data.folders {
        if !known.insert(path.canonicalize().unwrap_or(path.clone())) {
            bail!("data.folders: {} is there twice", path.display());
        }
        match People::open(path, &config.data, &config.views) {
            Ok(set) => sets.push(set),
            Err(e) => {
                missing.push(LeftOut::new(path.display().to_string(), &e));
                first.get_or_insert(e);
            }
        }
    }
    match first {
        Some(e) if sets.is_empty() => Err(e.into()),
        _ => Ok((sets, missing)),
    }
}

fn judge_meshes(
    arguments: &Arguments,
    config: &EvalConfig,
    sets: &[People],
    meshes: &Path,
    missing: Vec<LeftOut>,
) -> Result<(), Failure> {
    if !meshes.is_dir() {
        bail!("--mesh-dir {}: is no folder", meshes.display());
    }
    let folder = ReportFolder::new(&arguments.output, &[&arguments.config])?;
    let alignment = config.metrics.align.description();
    let (figures, mut left_out) = evaluate_meshes(config, sets, meshes, &Progress::counted("people"));
    left_out.splice(0..0, missing);
    let header = header("cpu");
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report::meshes::markdown(&header, &figures, &left_out, alignment))?;
    let json = report::meshes::json(&header, &figures, &left_out);
    folder.finish(&json)?;
    for (name, figure) in json["geometry_cm"].as_object().into_iter().flatten() {
        let mean = figure["mean"].as_f64().map_or("n/a".into(), |v| format!("{v:.4}"));
        let unit = if name == "normal_consistency" { "" } else { " cm" };
        say::info(&format!("{name:<20} {mean}{unit}"));
    }
    complete(&left_out, REST)
}

fn config_of(arguments: &Arguments) -> Result<EvalConfig, Failure> {
    let mut config = EvalConfig::from_file(&arguments.config, &arguments.set)?;
    if !arguments.data.is_empty() {
        config.data.folders.clone_from(&arguments.data);
    }
    config.model.weights = arguments.weights.clone().or(config.model.weights);
    if let Some(against) = &arguments.against {
        let other = Variant { weights: Some(against.clone()), ..Variant::default() };
        config.ablations.insert("against".into(), other);
    }
    if let Some(align) = arguments.align {
        config.metrics.align = align;
    }
    if arguments.inputs.is_some() {
        let photographs = Some(PhotographChanges { grey: true, ..config.photographs });
        config.ablations.insert("grey".into(), Variant { photographs, ..Variant::default() });
    }
    check_utf8(config.data.folders.iter().chain(&config.model.weights).chain(&arguments.against))?;
    Ok(config)
}

/// The weights and the device of a variant.
pub(super) fn opened(variant: &Variant) -> Result<(WeightFile, Device), Failure> {
    let device = device::choose(variant.device.as_deref().unwrap_or("auto"))?;
    let arguments = ConfigArguments { set: variant.set.clone(), ..ConfigArguments::default() };
    let weights = weights::open(variant.weights.as_deref(), &arguments)?;
    let device = memory::with_room(device, &weights)?;
    Ok((weights, device))
}

/// The model, its variants and the baselines. Contestants that cannot be loaded are added to `missing`.
fn contestants(
    config: &EvalConfig,
    variants: &[(String, Variant)],
    device: &Device,
    missing: &mut Vec<LeftOut>,
) -> Vec<Contestant> {
    let mut contestants = Vec::new();
    for (i, (name, variant)) in variants.iter().enumerate() {
        let kind = if i == 0 { Kind::Model } else { Kind::Other };
        let model =
            opened(variant).and_then(|(weights, device)| Ok(Model::load(&weights, &device, variant)?));
        match model {
            Ok(model) => contestants.push(Contestant::Model(name.clone(), kind, Box::new(model))),
            Err(e) => missing.push(LeftOut::new(name, e)),
        }
    }
    let baselines = &config.baselines;
    contestants.extend(baselines.billboard.then(|| Contestant::Billboard(device.clone())));
    contestants.extend(baselines.true_points.then(|| Contestant::TruePoints(device.clone())));
    contestants
}

/// Prints the most important figures.
fn summarise(report: &Value) {
    let line = |name: &str, figures: &Value| {
        let figure = |key: &str| match &figures[key]["mean"] {
            Value::Null => "n/a".to_owned(),
            value => value.as_f64().map_or("inf".into(), |v| format!("{v:.4}")),
        };
        let (psnr, ssim, lpips) = (figure("psnr"), figure("ssim"), figure("lpips"));
        say::info(&format!("{name:<28} PSNR {psnr:>8} dB   SSIM {ssim}   LPIPS {lpips}"));
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
}
