//! `snapsnap bench`.

use std::path::{Path, PathBuf};
use std::process::Command;

use clap::Args;
use serde_json::Value;
use snapsnap_eval::bench::config::BenchConfig;
use snapsnap_eval::bench::report::{Bench, Training};
use snapsnap_eval::bench::{Measured, dominated, measure};
use snapsnap_eval::evaluate::LeftOut;

use snapsnap_base::config::Schema;

use super::{ConfigArguments, outside_data};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::report::{ReportFolder, header};
use crate::{device, memory, perceptual, say, weights};

/// What a process that measures one setting prints before its figures.
const MARK: &str = "measured ";

#[derive(Args)]
pub struct Arguments {
    /// Settings to compare, as in configs/bench.toml.
    #[arg(long, value_name = "TOML")]
    config: PathBuf,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Data set with people to compare [default: the first of data.folders in the config].
    #[arg(long, value_name = "DATASET")]
    data: Option<PathBuf>,
    /// Weights of all settings that name none [default: model.weights of the config].
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Folders of trainings whose validations become a curve.
    #[arg(long, value_name = "RUN", num_args = 1..)]
    runs: Vec<PathBuf>,
    #[command(flatten)]
    lpips: perceptual::Arguments,
    /// Folder of the report.
    #[arg(short, long, value_name = "REPORT")]
    output: PathBuf,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal [default: model.device of the config].
    #[arg(long)]
    device: Option<String>,
    /// Few runs of few people: that it works, not how well.
    #[arg(long)]
    quick: bool,
    /// Measure this setting alone and print its figures.
    #[arg(long, hide = true)]
    one: Option<String>,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let config = config_of(arguments)?;
    if config.data.folders.is_empty() {
        let message =
            "no data: give --data DATASET, made with `snapsnap prepare`, or data.folders in the config";
        return Err(Failure::Input(message.into()));
    }
    if let Some(name) = &arguments.one {
        return one(arguments, &config, name);
    }
    let output = arguments.output.as_path();
    let settings = || config.settings.values().chain([&config.model]);
    let own = settings().filter_map(|setting| setting.data.as_ref());
    outside_data(output, config.data.folders.iter().chain(own).map(PathBuf::as_path))?;
    let inputs: Vec<&Path> = std::iter::once(&arguments.config)
        .chain(settings().filter_map(|setting| setting.weights.as_ref()))
        .chain(arguments.lpips.files())
        .map(PathBuf::as_path)
        .collect();
    // Asked before every setting says so.
    if let Some(path) = &config.model.weights
        && let Err(e) = path.metadata()
    {
        return Err(Failure::Input(format!("{}: cannot read: {e}", path.display())));
    }
    let folder = ReportFolder::new(output, &inputs)?;
    let mut left_out = Vec::new();
    let mut training = Vec::new();
    for run in &config.training.runs {
        match Training::read(run) {
            Ok(read) => training.push(read),
            Err(why) => left_out.push(LeftOut { name: run.display().to_string(), why }),
        }
    }
    let names = config.names();
    let progress = Progress::steps(quiet, names.len(), "settings");
    let mut measured = Vec::new();
    for (done, name) in names.iter().enumerate() {
        match in_process(name) {
            Ok(found) => measured.push(found),
            Err(why) => left_out.push(LeftOut { name: name.clone(), why }),
        }
        progress.step(done + 1, names.len(), "settings");
    }
    drop(progress);
    if measured.is_empty() {
        let whys: Vec<String> = left_out.iter().map(|l| format!("{}: {}", l.name, l.why)).collect();
        return Err(Failure::Input(format!("nothing could be measured: {}", whys.join("; "))));
    }
    let lpips = measured[0].lpips_weights.clone();
    let device = measured[0].device.clone();
    let report = Bench {
        header: header(&device),
        measured: &measured,
        left_out: &left_out,
        lpips,
        training: &training,
    };
    let plots = report.plots();
    let there: Vec<&str> = plots.iter().filter(|(_, text)| !text.is_empty()).map(|(name, _)| *name).collect();
    for (name, text) in &plots {
        folder.text(name, text)?;
    }
    folder.text("settings.csv", &report.csv())?;
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report.markdown(&there))?;
    folder.finish(&report.json())?;
    if !quiet {
        for (m, by) in measured.iter().zip(dominated(&measured)) {
            let by =
                by.map_or("on the front".into(), |place| format!("dominated by {}", measured[place].name));
            say::out(&format!("{:<24} {:>8.1} ms   {:>6.2} dB   {by}", m.name, 1e3 * m.p50, m.psnr));
        }
        say::out(&format!("{}: report.md, report.json, plots and a table", folder.path().display()));
    }
    let partly = measured.iter().flat_map(|m| m.left_out.iter().map(|why| (&m.name, why)));
    let left_out: Vec<_> = left_out.iter().map(|l| (&l.name, &l.why)).chain(partly).collect();
    if left_out.is_empty() {
        return Ok(());
    }
    left_out.iter().for_each(|(name, why)| say::err(&format!("left out: {name}: {why}")));
    Err(Failure::Internal(format!("{} left out, the rest was measured", left_out.len())))
}

fn config_of(arguments: &Arguments) -> Result<BenchConfig, Failure> {
    let mut config = BenchConfig::from_file(&arguments.config, &arguments.set)?;
    if let Some(data) = &arguments.data {
        config.data.folders = vec![data.clone()];
    }
    if arguments.weights.is_some() {
        config.model.weights.clone_from(&arguments.weights);
    }
    if arguments.device.is_some() {
        config.model.device.clone_from(&arguments.device);
    }
    if !arguments.runs.is_empty() {
        config.training.runs.clone_from(&arguments.runs);
    }
    if arguments.quick {
        config.bench = config.bench.quick();
    }
    Ok(config)
}

/// Measures a setting in a process of its own, whose memory is its own and whose end is not ours.
fn in_process(name: &str) -> Result<Measured, String> {
    let program = std::env::current_exe().map_err(|e| format!("cannot find the program: {e}"))?;
    let mut command = Command::new(program);
    command.args(std::env::args_os().skip(1)).arg(format!("--one={name}"));
    let output = command.output().map_err(|e| format!("cannot start a process: {e}"))?;
    let printed = String::from_utf8_lossy(&output.stdout);
    let figures = printed.lines().find_map(|line| line.strip_prefix(MARK));
    if let Some(figures) = figures.filter(|_| output.status.success()) {
        return serde_json::from_str(figures).map_err(|e| format!("its figures cannot be read: {e}"));
    }
    let said = String::from_utf8_lossy(&output.stderr);
    // All lines of the error.
    let start = said.rfind("\nerror: ").map_or(0, |at| at + 1);
    match said[start..].trim().trim_start_matches("error: ") {
        "" => Err(format!("ended with {}", output.status)),
        message => Err(message.replace('\n', " ")),
    }
}

fn one(arguments: &Arguments, config: &BenchConfig, name: &str) -> Result<(), Failure> {
    let setting = config.setting(name).ok_or_else(|| Failure::Input(format!("no setting {name}")))?;
    let chosen = setting.device.clone().unwrap_or_else(|| "auto".into());
    let device = device::choose(&chosen)?;
    let arguments_of = ConfigArguments { config: None, set: setting.set.clone() };
    let weights = weights::open(setting.weights.as_deref(), &arguments_of)?;
    memory::check_networks(&weights, &device)?;
    let lpips = arguments.lpips.load_or(&config.bench.lpips, &chosen)?;
    let described = device::describe(&device);
    let measured = measure(
        config,
        name,
        &setting,
        &weights,
        (&device, &described),
        (lpips.as_ref().ok(), &perceptual::describe(&lpips)),
        &memory::most_used,
    )?;
    let value: Value = serde_json::to_value(measured).expect("a value");
    say::out(&format!("{MARK}{value}"));
    Ok(())
}
