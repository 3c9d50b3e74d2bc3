//! One module per subcommand.

pub mod export_weights;
pub mod import_weights;
pub mod init_weights;
pub mod reconstruct;

use std::path::Path;

use clap::Args;
use snapsnap_net::config::Config;

use crate::failure::Failure;

/// Where a config comes from.
#[derive(Args)]
pub struct ConfigArguments {
    /// TOML config; without one, the config stored with the weights, or the published size.
    #[arg(long, value_name = "TOML")]
    pub config: Option<std::path::PathBuf>,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
}

impl ConfigArguments {
    /// The config of the file given, or else of `fallback` (name and TOML text), with the overrides applied.
    pub fn resolve(&self, fallback: (&str, &str)) -> Result<Config, Failure> {
        Ok(match &self.config {
            Some(path) => Config::from_file(path, &self.set)?,
            None => Config::from_toml(fallback.1, fallback.0, &self.set)?,
        })
    }
}

/// Refuses an output path that could not be written in the end, or that is one of the inputs.
pub fn check_output(path: &Path, inputs: &[&Path]) -> Result<(), Failure> {
    let same = |input: &&&Path| match (path.canonicalize(), input.canonicalize()) {
        (Ok(output), Ok(input)) => output == input && output.is_file(),
        _ => false,
    };
    if inputs.iter().any(|input| same(&input)) {
        return Err(Failure::Input(format!(
            "{}: is an input of this command and would be overwritten",
            path.display()
        )));
    }
    snapsnap_splat::file::check_writable(path)
        .map_err(|e| Failure::Input(format!("{}: cannot write: {e}", path.display())))
}
