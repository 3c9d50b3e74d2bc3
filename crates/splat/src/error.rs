//! Errors of this crate.

use snapsnap_base::FileError;

/// Errors of cameras, Gaussians and their files.
#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    /// A tensor of the wrong shape.
    #[error("Gaussians: `{field}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Name of the tensor.
        field: &'static str,
        /// Shape it has.
        found: Vec<usize>,
        /// Shape it should have.
        expected: Vec<usize>,
    },
    /// A render without a view.
    #[error("no camera to render into")]
    NoCamera,
    /// A camera that cannot be rendered into.
    #[error("camera {index}: {problem}")]
    Camera {
        /// Position in the list, from 0.
        index: usize,
        /// Its fault.
        problem: String,
    },
    /// A render option outside its allowed range.
    #[error("render option `{field}` must be {allowed}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// The allowed values.
        allowed: &'static str,
    },
    /// An array that does not fit into memory, or that is larger than the device's largest buffer.
    #[error(
        "{what} needs {bytes} bytes, more than this device holds in one piece: render fewer views at once, or a smaller image"
    )]
    Memory {
        /// The array.
        what: &'static str,
        /// Its size.
        bytes: u64,
    },
    /// More pairs of a splat and a tile than the device's memory or [`RenderOptions`](crate::RenderOptions) allow.
    #[error(
        "{found} pairs of a splat and a 16×16 tile, at most {limit} fit: render fewer views at once, or a smaller image"
    )]
    TooManyIntersections {
        /// Pairs in this scene.
        found: u64,
        /// Pairs that fit.
        limit: u64,
    },
    /// A value that is not written: most viewers fail at a NaN or an infinity in a PLY.
    #[error("Gaussian {index}: `{field}` is not finite")]
    NotFinite {
        /// Name of the tensor.
        field: &'static str,
        /// Row of the offending value.
        index: usize,
    },
    /// A file of cameras or Gaussians.
    #[error(transparent)]
    File(#[from] FileError),
}
