//! Errors of comparisons.

use snapsnap_base::FileError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// A comparison that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// There is nothing to compare, or things do not fit, for the reason of the message.
    #[error("{0}")]
    Message(String),
    /// Error of a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// Error of weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Error of a render.
    #[error(transparent)]
    Splat(#[from] SplatError),
}

impl EvalError {
    /// An error with this message.
    pub(crate) fn new(message: impl ToString) -> Self {
        Self::Message(message.to_string())
    }
}

/// The result of a comparison.
pub type Result<T, E = EvalError> = std::result::Result<T, E>;
