//! The subcommands.

pub mod bench;
pub mod compare;
pub mod convert;
pub mod demo;
pub mod doctor;
pub mod evaluate;
pub mod fetch_weights;
pub mod manuals;
pub mod mesh;
mod pairs;
pub mod prepare;
pub mod reconstruct;
pub mod render;
pub mod stability;
pub mod studio;
pub mod train;
pub mod view;
pub mod weight_files;

use std::path::{Component, Path, PathBuf};

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_net::config::Config;
use snapsnap_splat::scene::Kind;

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

/// Refuses outputs that cannot be written, that are given twice or that are inputs.
pub fn check_outputs(outputs: &[&Path], inputs: &[&Path]) -> Result<(), Failure> {
    for (i, output) in outputs.iter().enumerate() {
        file::check_writable(output).map_err(|e| Failure::cannot_write(output, &e))?;
        if inputs.iter().any(|input| is_same_file(output, input)) {
            return Err(Failure::file(output, "is an input of this command and would be overwritten"));
        }
        if outputs[..i].iter().any(|other| place(output) == place(other) || is_same_file(output, other)) {
            return Err(Failure::file(output, "is given for two outputs"));
        }
    }
    Ok(())
}

/// Refuses a file of Gaussians with an unknown extension. A pipe or a device without one receives a PLY.
pub fn check_kind(path: &Path) -> Result<(), Failure> {
    if Kind::named(path).is_some() || file::is_special(path) {
        return Ok(());
    }
    Err(Failure::file(path, "is no .ply, .spz, .glb or .sog; the extension says what to write"))
}

/// Refuses an output folder in a data set (one of `roots`): the data set would take it for a subject without pictures.
pub fn outside_data<'a>(path: &Path, roots: impl IntoIterator<Item = &'a Path>) -> Result<(), Failure> {
    let whole = std::path::absolute(path).map_err(|e| Failure::cannot_write(path, &e))?;
    // Links of existing folders are followed. `..` after a missing folder is taken literally.
    let mut there = PathBuf::new();
    for part in whole.components() {
        match part {
            Component::ParentDir => drop(there.pop()),
            part => there.push(part),
        }
        there = there.canonicalize().unwrap_or(there);
    }
    for root in roots {
        let root = root.canonicalize().ok();
        if root.is_some_and(|root| there.starts_with(root)) {
            return Err(Failure::file(path, "lies in a data set"));
        }
    }
    Ok(())
}

/// The canonical path of a file, which may be missing.
pub fn place(path: &Path) -> PathBuf {
    let path = file::target_of(path);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}

/// Whether both paths lead to one existing folder.
pub fn is_same_folder(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Whether both paths lead to one existing regular file.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b && a.is_file())
}
