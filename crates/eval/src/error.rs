//! Errors of comparisons.

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// A comparison that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// Two pictures or sets have different sizes.
    #[error("the sizes differ: {} and {}", size(found), size(expected))]
    Sizes {
        /// The extents found; the last two are height and width.
        found: Vec<usize>,
        /// The expected extents.
        expected: Vec<usize>,
    },
    /// A value of a picture is not finite or not in [0, 1], for example because values are 0 to 255.
    #[error("value {value} at channel {channel}, row {row}, column {column} of the {what}: must be 0 to 1")]
    Value {
        /// The picture.
        what: &'static str,
        /// The value.
        value: f32,
        /// 0 to 2: red, green, blue.
        channel: usize,
        /// Row from the top.
        row: usize,
        /// Column from the left.
        column: usize,
    },
    /// There is nothing to compare, for the reason of the message.
    #[error("{0}")]
    Empty(String),
    /// Error of a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// Error of weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Error of a config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Error of a render.
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
