//! `snapsnap init-weights`, `snapsnap import-weights` and `snapsnap export-weights`.

use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_base::config::Schema;
use snapsnap_net::config::{Config, Precision};
use snapsnap_net::weights::{self, ImportOptions};

use crate::arguments::ConfigArguments;
use crate::failure::Failure;
use crate::output::check_outputs;
use crate::progress::Progress;
use crate::say;

/// Name of the default config.
const PUBLISHED: &str = "the published size";

#[derive(Args)]
pub struct InitArguments {
    #[command(flatten)]
    config: ConfigArguments,
    /// Seed of the random weights; the same seed gives the same file on every machine.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Weight file to write.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

#[derive(Args)]
pub struct ImportArguments {
    /// Checkpoints: DUSt3R or CroCo (`.safetensors`, `.pth`), Snap-Snap stage 1 and stage 2 (`.pth`), or weight files
    /// of this program.
    #[arg(required = true)]
    sources: Vec<PathBuf>,
    /// Checkpoint for the tensors that no other checkpoint contains.
    #[arg(long, value_name = "FILE")]
    fill: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArguments,
    /// Seed of the tensors that no checkpoint has.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write f16 instead of f32: half the size. Values are rounded to the nearest.
    #[arg(long)]
    half: bool,
    /// Weight file to write.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

#[derive(Args)]
pub struct ExportArguments {
    /// Weight file written by `import-weights`, `init-weights` or training.
    input: PathBuf,
    /// File to write, with the key names and aliases of the authors' state dicts.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

pub fn init(InitArguments { config, seed, output }: &InitArguments) -> Result<(), Failure> {
    let resolved = config.resolve((PUBLISHED, ""))?;
    let inputs: Vec<&Path> = config.config.iter().map(PathBuf::as_path).collect();
    check_outputs(&[output], &inputs)?;
    let parameters = weights::init(&resolved, *seed, output, &Progress::megabytes())?;
    say::info(&format!("{}: {parameters} random parameters from seed {seed}", output.display()));
    Ok(())
}

pub fn import(arguments: &ImportArguments) -> Result<(), Failure> {
    let ImportArguments { sources, fill, output, .. } = arguments;
    let config = import_config(arguments)?;
    let inputs: Vec<&Path> =
        sources.iter().chain(fill).chain(&arguments.config.config).map(PathBuf::as_path).collect();
    check_outputs(&[output], &inputs)?;
    let float = if arguments.half { Precision::F16 } else { Precision::F32 };
    let options = ImportOptions { fill: fill.as_deref(), seed: arguments.seed, float };
    let report = weights::import(sources, &config, options, output, &Progress::megabytes())?;
    for note in &report.notes {
        say::info(note);
    }
    let (file, tensors) = (output.display(), report.tensors);
    say::info(&format!("{file}: {tensors} tensors, {} parameters", report.parameters));
    Ok(())
}

/// The config of --config, else the config stored in the files, else the published size with `compat`, which the
/// published weights need.
fn import_config(ImportArguments { sources, fill, config, .. }: &ImportArguments) -> Result<Config, Failure> {
    if config.config.is_none() {
        // A pickle contains no config.
        let is_safetensors = |path: &&Path| path.extension().is_some_and(|e| e == "safetensors");
        let files = sources.iter().chain(fill).map(PathBuf::as_path).filter(is_safetensors);
        if let Some(stored) = weights::stored_config(files.clone())? {
            let origin = files.map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
            return Ok(Config::from_toml(&stored.to_toml(), &format!("{origin} (metadata)"), &config.set)?);
        }
    }
    config.resolve((PUBLISHED, "[mode]\ncompat = true\n"))
}

pub fn export(ExportArguments { input, output }: &ExportArguments) -> Result<(), Failure> {
    check_outputs(&[output], &[input])?;
    let tensors = weights::export(input, output, &Progress::megabytes())?;
    say::info(&format!("{}: {tensors} tensors", output.display()));
    Ok(())
}
