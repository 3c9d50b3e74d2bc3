//! Checkpoints: reading the authors' files, our own file format, and filling the networks from it.
//!
//! Our file is one `.safetensors` with the authors' keys (`scale`, `dust3r.*`, `pred_unet.*`, `gs_conv.*`) and this
//! project's keys (`unet.*`, `details.*`, `side.*`), in one [`Precision`](crate::config::Precision), and the config as TOML in its
//! metadata.

mod file;
mod import;
mod init;
mod load;
pub mod schema;
mod source;

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;

pub use crate::parameters::{NamedMapper, NamedVisitor, ParameterPath, map_named, visit_named};
pub use file::{Progress, WeightFile, not_finite, save, write_tensors};
pub use import::{ImportOptions, ImportReport, export, import, stored_config};
pub use init::{SideHeads, init};
pub use load::{random_predictor, random_regressors};
pub use source::{Entry, Source};

/// The first problems, a line each, and the number of the others.
fn listed(problems: &[String]) -> String {
    /// Lines that are shown.
    const SHOWN: usize = 12;
    let shown = problems[..problems.len().min(SHOWN)].join("\n  ");
    match problems.len().saturating_sub(SHOWN) {
        0 => shown,
        more => format!("{shown}\n  … and {more} more"),
    }
}

/// Errors of weight files.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file could not be read or written, or is unsuitable.
    #[error(transparent)]
    File(#[from] FileError),
    /// Tensors are missing, unused, mis-shaped, of the wrong type, not finite or given twice.
    #[error("{origin}: {} problem(s) with the weights:\n  {}", .problems.len(), listed(.problems))]
    Tensors {
        /// File or files.
        origin: String,
        /// One line per tensor.
        problems: Vec<String>,
    },
    /// The config in a file's metadata, or beside it.
    #[error(transparent)]
    Config(#[from] ConfigError),
}
