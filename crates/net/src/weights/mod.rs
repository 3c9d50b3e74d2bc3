//! Checkpoints: reading the authors' files, our own file format, and filling the networks from it.
//!
//! Our file is one `.safetensors` with the authors' keys (`scale`, `dust3r.*`, `pred_unet.*`, `gs_conv.*`), all f32, and
//! the config as TOML in its metadata.

mod export;
mod file;
mod import;
mod init;
mod load;
pub mod schema;
mod source;

use std::path::{Path, PathBuf};

pub use crate::names::{NamedMapper, NamedVisitor, map_named, visit_named};
pub use export::export;
pub use file::{Progress, WeightFile, not_finite, save, write_tensors};
pub use import::{ImportOptions, ImportReport, import, stored_config};
pub use init::{SideHeads, init};
pub use load::{random_predictor, random_regressors};
pub use source::{CONFIG_KEY, Entry, Float, Source};

/// What can be wrong with weights.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file could not be read.
    #[error("{path}: cannot read: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("{path}: cannot write: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{path}: {message}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// Tensors are missing, unused, mis-shaped, of the wrong type, not finite or given twice.
    #[error("{origin}: {} problem(s) with the weights:\n  {}", .problems.len(), .problems.join("\n  "))]
    Tensors {
        /// File or files.
        origin: String,
        /// One line per tensor.
        problems: Vec<String>,
    },
    /// The config in a file's metadata, or beside it.
    #[error(transparent)]
    Config(#[from] crate::config::ConfigError),
}

impl WeightsError {
    fn format(path: &Path, message: &str) -> Self {
        Self::Format { path: path.to_owned(), message: message.to_owned() }
    }
}
