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
pub use init::init;
pub use load::{random_predictor, random_regressors};
pub use source::{Entry, Source};

/// A line for each kind of problem, with its first tensors and the number of the others.
fn listed(problems: &[String]) -> String {
    /// Tensors that are shown.
    const SHOWN: usize = 3;
    let mut kinds: Vec<(&str, Vec<&str>)> = Vec::new();
    for problem in problems {
        let (kind, tensor) = problem.split_once(": ").unwrap_or(("", problem));
        match kinds.iter_mut().find(|(other, _)| *other == kind) {
            Some((_, tensors)) => tensors.push(tensor),
            None => kinds.push((kind, vec![tensor])),
        }
    }
    let line = |(kind, tensors): &(&str, Vec<&str>)| {
        let shown = tensors[..tensors.len().min(SHOWN)].join("; ");
        match tensors.len().saturating_sub(SHOWN) {
            0 => format!("{kind}: {shown}"),
            more => format!("{kind}: {shown}; and {more} more"),
        }
    };
    kinds.iter().map(line).collect::<Vec<_>>().join("\n  ")
}

/// Errors of weight files.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file could not be read or written, or is unsuitable.
    #[error(transparent)]
    File(#[from] FileError),
    /// Tensors are missing, unused, mis-shaped, of the wrong type, not finite or given twice. A problem is its kind, a
    /// colon and the tensor, one line each.
    #[error("{origin}: {} problem(s) with the weights:\n  {}", .problems.len(), listed(.problems))]
    #[allow(missing_docs, reason = "the names say it")]
    Tensors { origin: String, problems: Vec<String> },
    /// The config in a file's metadata, or beside it.
    #[error(transparent)]
    Config(#[from] ConfigError),
}
