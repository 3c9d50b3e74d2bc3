//! `snapsnap prepare makehuman`.

use std::path::PathBuf;

use clap::Args;
use snapsnap_people::makehuman::{Library, person};

use super::{Common, Generate, generate};
use crate::failure::Failure;

#[derive(Args)]
pub struct Arguments {
    /// MakeHuman's folder `data`, or a checkout that contains it.
    folder: PathBuf,
    #[command(flatten)]
    common: Common,
    #[command(flatten)]
    generate: Generate,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let library = Library::open(&arguments.folder)?;
    let inputs = [library.root()];
    generate(&arguments.common, &arguments.generate, quiet, "makehuman", &inputs, |name| {
        person(&library, name)
    })
}
