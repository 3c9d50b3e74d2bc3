//! `snapsnap init-weights`.

use std::path::PathBuf;

use clap::Args;
use snapsnap_net::weights;

use super::{ConfigArguments, check_outputs};
use crate::failure::Failure;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    #[command(flatten)]
    config: ConfigArguments,
    /// Seed of the random weights; the same seed gives the same file on every machine.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Weight file to write.
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let config = arguments.config.resolve(("the published size", ""))?;
    let inputs: Vec<_> = arguments.config.file().into_iter().collect();
    check_outputs(&[&arguments.output], &inputs)?;
    let progress = Progress::bytes(quiet);
    let parameters = weights::init(&config, arguments.seed, &arguments.output, &|done, total| {
        progress.advance(done, total);
    })?;
    drop(progress);
    if !quiet {
        let (file, seed) = (arguments.output.display(), arguments.seed);
        say::out(&format!("{file}: {parameters} random parameters from seed {seed}"));
    }
    Ok(())
}
