//! What can go wrong in a training.

use snapsnap_base::FileError;
use snapsnap_eval::EvalError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// Why a training could not begin or go on.
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
    /// Comparing with the truth.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// What was asked for does not fit together.
    #[error("{0}")]
    Unsuitable(String),
    /// Too many steps in a row could not be made.
    #[error("{count} steps in a row could not be made, the last one, {step}, because {why}")]
    Stuck {
        /// Steps in a row.
        count: u64,
        /// The last one.
        step: u64,
        /// What was wrong with it, and which samples it was made of.
        why: String,
    },
}
