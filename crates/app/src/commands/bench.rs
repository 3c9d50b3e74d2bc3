//! `snapsnap bench`.

use std::path::PathBuf;
use std::process::Command;

use clap::Args;
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_eval::bench::config::BenchConfig;
use snapsnap_eval::bench::report::{Bench, Training};
use snapsnap_eval::bench::{Measured, dominated, measure};
use snapsnap_eval::evaluate::LeftOut;

use super::evaluate::{check_data, inputs, opened};
use crate::arguments::check_utf8;
use crate::failure::Failure;
use crate::output::outside_data;
use crate::progress::Progress;
use crate::report::{ReportFolder, complete, header, nothing_left, print_left_out};
use crate::{device, memory, perceptual, say};

/// Prefix of the line with the figures of a process that measures one setting.
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
    /// Weights of every setting that names none [default: model.weights of the config].
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
    /// Few runs of few people, as a test of the config.
    #[arg(long)]
    quick: bool,
    /// Measure this setting alone and print its figures.
    #[arg(long, hide = true)]
    one: Option<String>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let config = config_of(arguments)?;
    check_data(&config.data.folders)?;
    if let Some(name) = &arguments.one {
        return one(arguments, &config, name);
    }
    let output = arguments.output.as_path();
    let variants = config.variants();
    let own = variants.iter().filter_map(|(_, variant)| variant.data.as_ref());
    outside_data(output, config.data.folders.iter().chain(own).map(PathBuf::as_path))?;
    // One error instead of one for each setting.
    if let Some(path) = &config.model.weights {
        path.metadata().map_err(FileError::read(path))?;
    }
    let folder = ReportFolder::new(output, &inputs(&arguments.config, &variants, &arguments.lpips))?;
    let (mut left_out, mut training, mut measured) = (Vec::new(), Vec::new(), Vec::new());
    for run in &config.training.runs {
        match Training::read(run) {
            Ok(read) => training.push(read),
            Err(why) => left_out.push(LeftOut::new(run.display().to_string(), why)),
        }
    }
    let mut absent = Vec::new();
    for (name, variant) in Progress::over(variants.iter(), "settings") {
        // Another machine has the device: no failure.
        if let Some(Err(why)) = variant.device.as_deref().map(device::choose) {
            left_out.push(LeftOut::new(name, &why));
            absent.push(name);
            continue;
        }
        match in_process(name) {
            Ok(found) => measured.push(found),
            Err(why) => left_out.push(LeftOut::new(name, why)),
        }
    }
    let Some(Measured { device, .. }) = measured.first() else {
        return Err(nothing_left("nothing could be measured", &left_out));
    };
    let report =
        Bench { header: header(device), measured: &measured, left_out: &left_out, training: &training };
    let plots = report.plots();
    let drawn: Vec<&str> = plots.iter().filter(|(_, text)| !text.is_empty()).map(|(name, _)| *name).collect();
    for (name, text) in &plots {
        folder.text(name, text)?;
    }
    folder.text("settings.csv", &report.csv())?;
    folder.text("config.toml", &config.to_toml())?;
    folder.text("report.md", &report.markdown(&drawn))?;
    folder.finish(&report.json())?;
    for (m, by) in measured.iter().zip(dominated(&measured)) {
        let by = by.map_or("on the front".into(), |index| format!("dominated by {}", measured[index].name));
        say::info(&format!("{:<24} {:>8.1} ms   {:>6.2} dB   {by}", m.name, 1e3 * m.p50, m.score.psnr));
    }
    say::info(&format!("{}: report.md, report.json, plots and a table", folder.path.display()));
    let (left_out, failed): (Vec<_>, _) =
        report.failures().into_iter().partition(|failure| absent.contains(&&failure.name));
    print_left_out(&left_out);
    complete(&failed, "the rest was measured")
}

fn config_of(arguments: &Arguments) -> Result<BenchConfig, Failure> {
    let mut config = BenchConfig::from_file(&arguments.config, &arguments.set)?;
    if let Some(data) = &arguments.data {
        config.data.folders = vec![data.clone()];
    }
    config.model.weights = arguments.weights.clone().or(config.model.weights);
    config.model.device = arguments.device.clone().or(config.model.device);
    if !arguments.runs.is_empty() {
        config.training.runs.clone_from(&arguments.runs);
    }
    if arguments.quick {
        config.bench = config.bench.quick();
    }
    check_utf8(config.data.folders.iter().chain(&config.model.weights).chain(&config.training.runs))?;
    Ok(config)
}

/// Measures a setting in its own process, whose memory and failures do not affect the others.
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
    // Errors may have several lines.
    let start = said.rfind("\nerror: ").map_or(0, |at| at + 1);
    match said[start..].trim().trim_start_matches("error: ") {
        "" => Err(format!("ended with {}", output.status)),
        message => Err(message.replace('\n', " ")),
    }
}

fn one(arguments: &Arguments, config: &BenchConfig, name: &str) -> Result<(), Failure> {
    let variant = config.variants().into_iter().find(|(other, _)| other == name);
    let (_, variant) = variant.ok_or_else(|| Failure::Input(format!("no setting {name}")))?;
    let (weights, device) = opened(&variant)?;
    let chosen = variant.device.as_deref().unwrap_or("auto");
    let lpips = arguments.lpips.load(&config.bench.lpips, chosen)?;
    let measured = measure(
        config,
        (name, &variant),
        &weights,
        (&device, &device::describe(&device)),
        (lpips.as_ref().ok(), &perceptual::describe(&lpips)),
        &memory::most_used,
    )?;
    say::out(&format!("{MARK}{}", serde_json::to_string(&measured).expect("figures")));
    Ok(())
}
