//! `snapsnap reconstruct`.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use snapsnap_data::photo::{self, Canvas, Placement};
use snapsnap_net::weights::schema::Part;
use snapsnap_net::{Photograph, Reconstructor};
use snapsnap_splat::{file, ply};

use super::{ConfigArguments, check_output};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::{device, dump, weights};

#[derive(Args)]
pub struct Arguments {
    /// Photograph of the front: RGBA, or RGB with --masks.
    front: PathBuf,
    /// Photograph of the back.
    back: PathBuf,
    /// Masks of the two photographs (white: person).
    #[arg(long, num_args = 2, value_names = ["FRONT_MASK", "BACK_MASK"])]
    masks: Option<Vec<PathBuf>>,
    /// The pictures already are the canvas: no box, no scaling, no centring.
    #[arg(long)]
    as_is: bool,
    /// Weight file, or a folder that holds `weights.safetensors`.
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArguments,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Gaussian PLY to write; the config in force is written beside it.
    #[arg(short, long, default_value = "human.ply")]
    output: PathBuf,
    /// Also write every intermediate tensor.
    #[arg(long, value_name = "FILE.safetensors")]
    dump: Option<PathBuf>,
    /// Print what ran, what was left out and why, and the time of every module.
    #[arg(short, long)]
    verbose: bool,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let inputs: Vec<&Path> = [&arguments.front, &arguments.back]
        .into_iter()
        .chain(arguments.masks.iter().flatten())
        .chain(&arguments.weights)
        .chain(&arguments.config.config)
        .map(PathBuf::as_path)
        .collect();
    // Beside a pipe or a device there is no place for a config.
    let beside = std::fs::metadata(&arguments.output).map_or(true, |m| m.is_file());
    let config_path = beside.then(|| arguments.output.with_extension("config.toml"));
    for path in [Some(&arguments.output), arguments.dump.as_ref(), config_path.as_ref()].into_iter().flatten()
    {
        check_output(path, &inputs)?;
    }
    let weights = weights::open(arguments.weights.as_deref(), &arguments.config)?;
    weights.require(Part::PointPredictor)?;
    weights.require(Part::Regressor)?;
    let config = weights.config.clone();
    let placement = match (arguments.as_is, config.mode.compat) {
        (true, _) => Placement::AsIs,
        (false, true) => Placement::Demo { height: config.person_height() },
        (false, false) => Placement::Training { height: config.person_height() },
    };
    let masks = arguments.masks.as_deref().unwrap_or_default();
    let mut times = Vec::new();
    let start = Instant::now();
    let load = |path: &Path, mask: Option<&PathBuf>| {
        photo::load(path, mask.map(PathBuf::as_path), config.network.resolution, placement)
    };
    let canvases = [load(&arguments.front, masks.first())?, load(&arguments.back, masks.get(1))?];
    times.push(("photographs", start.elapsed()));
    let device = device::choose(&arguments.device)?;

    let progress = Progress::stages(quiet);
    progress.stage("loading weights");
    let start = Instant::now();
    let reconstructor = Reconstructor::load(&weights, &device)?;
    times.push(("loading weights", start.elapsed()));
    let mut plan = vec![format!("device: {device:?}"), format!("weights: {}", weights.path().display())];
    for (name, canvas) in ["front", "back"].into_iter().zip(&canvases) {
        plan.push(format!("{name}: {}", canvas.report));
    }
    let [front, back] = canvases.map(|Canvas { rgb, mask, valid, .. }| Photograph { rgb, mask, valid });
    let mut result = reconstructor.reconstruct(&front, &back, &|name| progress.stage(name));
    plan.append(&mut result.plan);
    times.append(&mut result.times);

    progress.stage("writing");
    let start = Instant::now();
    if let Some(path) = &arguments.dump {
        dump::write(&result, path)?;
    }
    if let Some(path) = &config_path {
        write_text(path, &config.to_toml())?;
    }
    ply::write(&result.in_world(&config), &arguments.output)?;
    times.push(("writing", start.elapsed()));
    drop(progress);
    if arguments.verbose {
        report(&plan, &times);
    }
    if !quiet {
        println!("{}: {} Gaussians", arguments.output.display(), result.gaussians.len());
    }
    Ok(())
}

fn write_text(path: &Path, text: &str) -> Result<(), Failure> {
    file::write_whole(path, |out| out.write_all(text.as_bytes()))
        .map_err(|e| Failure::Input(format!("{}: cannot write: {e}", path.display())))
}

fn report(plan: &[String], times: &[(&str, Duration)]) {
    println!("plan");
    for line in plan {
        println!("  {line}");
    }
    println!("time, device synchronised");
    for (name, time) in times {
        println!("  {name:<26} {:>9.1} ms", time.as_secs_f64() * 1e3);
    }
    let total: Duration = times.iter().map(|(_, time)| *time).sum();
    println!("  {:<26} {:>9.1} ms", "total", total.as_secs_f64() * 1e3);
}
