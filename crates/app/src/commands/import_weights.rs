//! `snapsnap import-weights`.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use snapsnap_net::weights::{self, ImportOptions, SideHeads};

use super::{ConfigArguments, check_outputs};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// Checkpoints: DUSt3R or CroCo (`.safetensors`, `.pth`), Snap-Snap stage 1 and stage 2 (`.pth`).
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
    // The only published weights of this size were trained with every quirk of the published code.
    let config = arguments.config.resolve(("the published size", "[mode]\ncompat = true\n"))?;
    let inputs: Vec<&Path> =
        arguments.sources.iter().map(PathBuf::as_path).chain(arguments.config.file()).collect();
    check_outputs(&[&arguments.output], &inputs)?;
    let progress = Progress::bytes(quiet);
    let side_heads = match arguments.side_heads {
        Sides::Seed => SideHeads::Seed,
        Sides::Copy => SideHeads::Copy,
    };
    let options = ImportOptions { side_heads, seed: arguments.seed };
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
