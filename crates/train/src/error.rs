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
    /// Too many failed steps in a row.
    #[error("{count} steps in a row could not be made; the last was step {step}: {why}")]
    Stuck {
        /// Steps in a row.
        count: u64,
        /// The last one.
        step: u64,
        /// Its error and its samples.
        why: String,
    },
}
