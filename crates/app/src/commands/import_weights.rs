//! `snapsnap import-weights`.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use snapsnap_base::config::Schema;
use snapsnap_net::config::Config;
use snapsnap_net::weights::{self, Float, ImportOptions, SideHeads};

use super::{ConfigArguments, check_outputs};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// Checkpoints: DUSt3R or CroCo (`.safetensors`, `.pth`), Snap-Snap stage 1 and stage 2 (`.pth`), or weight files of ours.
    #[arg(required = true)]
    sources: Vec<PathBuf>,
    #[command(flatten)]
    config: ConfigArguments,
    /// Where the right and left heads come from when no checkpoint has them.
    #[arg(long, value_enum, default_value_t = Sides::Seed)]
    side_heads: Sides,
    /// Seed of whatever no checkpoint has.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write 16 bits per value: half the size, each value to the nearest of them.
    #[arg(long)]
    half: bool,
    /// Weight file to write.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

#[derive(Clone, Copy, ValueEnum)]
enum Sides {
    /// Drawn from --seed, as the authors do.
    Seed,
    /// Copied: right from front, left from back.
    Copy,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let config = config(arguments)?;
    let inputs: Vec<&Path> =
        arguments.sources.iter().map(PathBuf::as_path).chain(arguments.config.file()).collect();
    check_outputs(&[&arguments.output], &inputs)?;
    let progress = Progress::bytes(quiet);
    let side_heads = match arguments.side_heads {
        Sides::Seed => SideHeads::Seed,
        Sides::Copy => SideHeads::Copy,
    };
    let float = if arguments.half { Float::F16 } else { Float::F32 };
    let options = ImportOptions { side_heads, seed: arguments.seed, float };
    let report = weights::import(&arguments.sources, &config, options, &arguments.output, &|done, total| {
        progress.advance(done, total);
    })?;
    drop(progress);
    if !quiet {
        for note in &report.notes {
            say::out(note);
        }
        say::out(&format!(
            "{}: {} tensors, {} parameters",
            arguments.output.display(),
            report.tensors,
            report.parameters
        ));
    }
    Ok(())
}

/// The config that was asked for, else the one stored in a file of ours, else the published size: the only published weights of it were
/// trained with every quirk of the published code.
fn config(arguments: &Arguments) -> Result<Config, Failure> {
    if arguments.config.config.is_none() {
        // A pickle has no place for a config.
        for path in
            arguments.sources.iter().filter(|path| path.extension().is_some_and(|e| e == "safetensors"))
        {
            if let Some(stored) = weights::stored_config(path)? {
                let origin = format!("{} (metadata)", path.display());
                return Ok(Config::from_toml(&stored.to_toml(), &origin, &arguments.config.set)?);
            }
        }
    }
    arguments.config.resolve(("the published size", "[mode]\ncompat = true\n"))
}
