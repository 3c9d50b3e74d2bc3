//! The weights of a command.

use std::io::{self, Read};
use std::path::Path;

use sha2::{Digest, Sha256};
use snapsnap_base::config::Schema;
use snapsnap_base::{FileError, file};
use snapsnap_net::config::Config;
use snapsnap_net::weights::WeightFile;

use crate::arguments::ConfigArguments;
use crate::failure::Failure;

/// File name of the weights in a folder.
const IN_FOLDER: &str = "weights.safetensors";
/// The default weights, trained on synthetic people (docs/weights.md).
const DEFAULT: &[u8] = include_bytes!("../../../assets/weights/default.safetensors");
/// Name of the default weights, in place of a path.
pub const DEFAULT_NAME: &str = "the default weights";

/// The SHA-256 of a weight file, or of the default weights.
pub fn sum_of(weights: &WeightFile) -> Result<String, Failure> {
    let path = weights.path();
    let sum = if path == Path::new(DEFAULT_NAME) {
        sha256(&mut &DEFAULT[..])
    } else {
        file::open(path).and_then(|mut file| sha256(&mut file))
    };
    Ok(sum.map_err(FileError::read(path))?)
}

/// SHA-256 of the remaining bytes, in hexadecimal digits.
pub fn sha256(from: &mut impl Read) -> io::Result<String> {
    let mut hasher = Sha256::new();
    io::copy(from, &mut hasher)?;
    Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Opens a weight file, or `weights.safetensors` in a folder, or without a path the default weights. --config and
/// --set override the stored config.
pub fn open(path: Option<&Path>, arguments: &ConfigArguments) -> Result<WeightFile, Failure> {
    let path = path.map(|path| if path.is_dir() { path.join(IN_FOLDER) } else { path.to_owned() });
    let opened = |config: Option<Config>| match &path {
        Some(path) => WeightFile::open(path, config),
        None => WeightFile::embedded(DEFAULT_NAME, DEFAULT, config),
    };
    if arguments.config.is_some() {
        return Ok(opened(Some(arguments.resolve(("", ""))?))?);
    }
    let file = opened(None)?;
    if arguments.set.is_empty() {
        return Ok(file);
    }
    let origin = format!("{} (metadata)", file.path().display());
    let config = Config::from_toml(&file.config.to_toml(), &origin, &arguments.set)?;
    Ok(opened(Some(config))?)
}
