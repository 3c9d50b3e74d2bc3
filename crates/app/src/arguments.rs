//! Options of several commands, and parsers of their values.

use std::path::PathBuf;

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use snapsnap_base::config::Schema;
use snapsnap_net::config::Config;

use crate::failure::Failure;

/// Options of a config.
#[derive(Args, Default)]
pub struct ConfigArguments {
    /// TOML config; without one, the config stored with the weights, or the published size.
    #[arg(long, value_name = "TOML")]
    pub config: Option<PathBuf>,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
}

impl ConfigArguments {
    /// The config of the file, else of `fallback` (name and TOML text), with the overrides applied.
    pub fn resolve(&self, fallback: (&str, &str)) -> Result<Config, Failure> {
        Ok(match &self.config {
            Some(path) => Config::from_file(path, &self.set)?,
            None => Config::from_toml(fallback.1, fallback.0, &self.set)?,
        })
    }
}

/// A parser of an argument that takes one of these values: name, help, value.
pub fn one_of<T: Copy + Send + Sync + 'static, const N: usize>(
    values: [(&'static str, &'static str, T); N],
) -> impl TypedValueParser<Value = T> {
    let possible = values.map(|(name, help, _)| match help {
        "" => PossibleValue::new(name),
        help => PossibleValue::new(name).help(help),
    });
    PossibleValuesParser::new(possible).map(move |name| {
        let (_, _, value) = values.iter().find(|(other, ..)| *other == name).expect("a possible value");
        *value
    })
}

/// Refuses paths that are not UTF-8: the config beside an output contains them.
pub fn check_utf8<'a>(paths: impl IntoIterator<Item = &'a PathBuf>) -> Result<(), Failure> {
    let message = "the path is not UTF-8, which the config beside an output must be";
    let other = paths.into_iter().find(|path| path.to_str().is_none());
    other.map_or(Ok(()), |path| Err(Failure::file(path, message)))
}
