//! One module per subcommand.

pub mod bench;
pub mod compare;
pub mod convert;
pub mod demo;
pub mod doctor;
pub mod evaluate;
pub mod export_weights;
pub mod fetch_weights;
pub mod import_weights;
pub mod init_weights;
pub mod manuals;
pub mod mesh;
pub mod prepare;
pub mod reconstruct;
pub mod render;
pub mod stability;
pub mod train;
pub mod view;

use std::path::{Component, Path, PathBuf};

use clap::Args;
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_net::config::Config;
use snapsnap_splat::scene::Kind;

use crate::failure::Failure;

/// Where a config comes from.
#[derive(Args)]
pub struct ConfigArguments {
    /// TOML config; without one, the config stored with the weights, or the published size.
    #[arg(long, value_name = "TOML")]
    pub config: Option<PathBuf>,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
}

impl ConfigArguments {
    /// The config file, if one is given.
    pub fn file(&self) -> Option<&Path> {
        self.config.as_deref()
    }

    /// The config of the file given, or else of `fallback` (name and TOML text), with the overrides applied.
    pub fn resolve(&self, fallback: (&str, &str)) -> Result<Config, Failure> {
        Ok(match &self.config {
            Some(path) => Config::from_file(path, &self.set)?,
            None => Config::from_toml(fallback.1, fallback.0, &self.set)?,
        })
    }
}

/// Refuses output paths that could not be written in the end, that are one another, or that are an input.
pub fn check_outputs(outputs: &[&Path], inputs: &[&Path]) -> Result<(), Failure> {
    for (i, output) in outputs.iter().enumerate() {
        file::check_writable(output).map_err(|e| Failure::cannot_write(output, &e))?;
        if inputs.iter().any(|input| is_same_file(output, input)) {
            let message = "is an input of this command and would be overwritten";
            return Err(Failure::Input(format!("{}: {message}", output.display())));
        }
        if outputs[..i].iter().any(|other| place(output) == place(other) || is_same_file(output, other)) {
            return Err(Failure::Input(format!("{}: is given for two outputs", output.display())));
        }
    }
    Ok(())
}

/// Refuses a file of Gaussians whose extension does not say what to write. A pipe or a device without one gets a PLY.
pub fn check_kind(path: &Path) -> Result<(), Failure> {
    if Kind::named(path).is_some() || file::is_special(path) {
        return Ok(());
    }
    let message = "is neither .ply nor .spz; the extension says what to write";
    Err(Failure::Input(format!("{}: {message}", path.display())))
}

/// Refuses a folder to write into that lies in a data set (roots), before it is made: an empty folder among a data set's would be
/// a subject without pictures.
pub fn outside_data<'a>(path: &Path, roots: impl IntoIterator<Item = &'a Path>) -> Result<(), Failure> {
    let whole = std::path::absolute(path).map_err(|e| Failure::cannot_write(path, &e))?;
    // Links are followed as far as there are any; `..` behind what is not there yet is taken literally.
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
            return Err(Failure::Input(format!("{}: lies in a data set", path.display())));
        }
    }
    Ok(())
}

/// Where a file is or will be, however its path is spelled.
fn place(path: &Path) -> PathBuf {
    let path = file::target_of(path);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}

/// Whether both paths lead to one existing regular file.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b && a.is_file())
}
