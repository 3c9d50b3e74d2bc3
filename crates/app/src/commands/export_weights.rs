//! `snapsnap export-weights`.

use std::path::PathBuf;

use clap::Args;
use snapsnap_net::weights;

use super::check_outputs;
use crate::failure::Failure;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// Weight file written by `import-weights`, `init-weights` or training.
    input: PathBuf,
    /// File to write, with the key names and aliases of the authors' state dicts.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    check_outputs(&[&arguments.output], &[&arguments.input])?;
    let progress = Progress::bytes(quiet);
    let tensors =
        weights::export(&arguments.input, &arguments.output, &|done, total| progress.advance(done, total))?;
    drop(progress);
    if !quiet {
        say::out(&format!("{}: {tensors} tensors", arguments.output.display()));
    }
    Ok(())
}
