//! Errors of a training.

use snapsnap_base::FileError;
use snapsnap_eval::EvalError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// A training that cannot begin or continue.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Data sets, samples, logs.
    #[error(transparent)]
    File(#[from] FileError),
    /// Weights and checkpoints.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Rendering.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// Comparison with the ground truth.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// Settings that do not fit one another or the data.
    #[error("{0}")]
    Unsuitable(String),
    /// Another rank cannot continue. The message has its number, its machine and its error.
    #[error("{0}")]
    Elsewhere(String),
    /// Too many failed steps in a row. `why` has the last one's error and samples.
    #[error("{count} steps in a row could not be made; the last was step {step}: {why}")]
    #[allow(missing_docs, reason = "the names say it")]
    Stuck { count: u64, step: u64, why: String },
}

/// The result of a part of a training.
pub type Result<T, E = TrainError> = std::result::Result<T, E>;
