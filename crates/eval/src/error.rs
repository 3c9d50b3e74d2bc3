//! What can be wrong with what is compared.

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;
use snapsnap_net::weights::WeightsError;
use snapsnap_splat::SplatError;

/// A comparison that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// Pictures of different sizes.
    #[error("the sizes differ: {} and {}", size(found), size(expected))]
    Sizes {
        /// `[B, C, H, W]`, or what there is of it.
        found: Vec<usize>,
        /// What it is compared with.
        expected: Vec<usize>,
    },
    /// A value that no picture has: not finite, or outside [0, 1], as of values up to 255 that were not divided.
    #[error("value {value} at channel {channel}, row {row}, column {column} of the {what}: must be 0 to 1")]
    Value {
        /// Which of the two.
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

/// The last two extents as people say them.
fn size(extents: &[usize]) -> String {
    match extents {
        [.., height, width] => format!("{width}×{height}"),
        _ => format!("{extents:?}"),
    }
}
