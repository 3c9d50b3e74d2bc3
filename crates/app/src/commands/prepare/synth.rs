//! `snapsnap prepare synth`.

use clap::Args;
use snapsnap_people::synth;

use super::{Common, Generate, generate};
use crate::failure::Failure;

#[derive(Args)]
pub struct Arguments {
    #[command(flatten)]
    common: Common,
    #[command(flatten)]
    generate: Generate,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    generate(&arguments.common, &arguments.generate, quiet, "synth", &[], |name| Ok(synth::person(name)))
}
