//! Finding and opening the weights a command was given.

use std::path::{Path, PathBuf};

use snapsnap_net::config::Config;
use snapsnap_net::weights::WeightFile;

use crate::commands::ConfigArguments;
use crate::failure::Failure;

/// File name of the weights in a folder.
const IN_FOLDER: &str = "weights.safetensors";

/// Opens a weight file, or `weights.safetensors` in a folder; --config and --set win over the config stored with it.
pub fn open(path: Option<&Path>, arguments: &ConfigArguments) -> Result<WeightFile, Failure> {
    let Some(path) = path else {
        let message = "no weights: give --weights FILE; make one with `import-weights` from the authors' checkpoints, \
                       or with `init-weights` (random) to try things out";
        return Err(Failure::Input(message.into()));
    };
    let path: PathBuf = if path.is_dir() { path.join(IN_FOLDER) } else { path.to_owned() };
    if arguments.config.is_some() {
        return Ok(WeightFile::open(&path, Some(arguments.resolve(("", ""))?))?);
    }
    let file = WeightFile::open(&path, None)?;
    if arguments.set.is_empty() {
        return Ok(file);
    }
    let stored = (format!("{} (metadata)", path.display()), file.config.to_toml());
    let config = Config::from_toml(&stored.1, &stored.0, &arguments.set)?;
    Ok(WeightFile::open(&path, Some(config))?)
}
