//! Errors of comparisons.

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// A comparison that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// Different sizes.
    #[error("the sizes differ: {} and {}", size(found), size(expected))]
    Sizes {
        /// Extents, the last two of which are height and width.
        found: Vec<usize>,
        /// Those of the other picture.
        expected: Vec<usize>,
    },
    /// A value of a picture that is not finite or outside [0, 1], such as one of 0 to 255.
    #[error("value {value} at channel {channel}, row {row}, column {column} of the {what}: must be 0 to 1")]
    Value {
        /// The picture.
        what: &'static str,
        /// The value.
        value: f32,
        /// 0 to 2: red, green, blue.
        channel: usize,
        /// From the top.
        row: usize,
        /// From the left.
        column: usize,
    },
    /// Nothing to compare.
    #[error("{0}")]
    Empty(String),
    /// A file.
    #[error(transparent)]
    File(#[from] FileError),
    /// Weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A render.
    #[error(transparent)]
    Splat(#[from] SplatError),
}

/// Width and height for messages.
fn size(extents: &[usize]) -> String {
    match extents {
        [.., height, width] => format!("{width}×{height}"),
        _ => format!("{extents:?}"),
    }
}
