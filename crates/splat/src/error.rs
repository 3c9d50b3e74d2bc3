//! Errors of this crate.

use snapsnap_base::FileError;

/// Errors of cameras, Gaussians and their files.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the names say it")]
pub enum SplatError {
    /// A tensor of the wrong shape.
    #[error("Gaussians: `{field}` has shape {found:?}, expected {expected:?}")]
    Shape { field: &'static str, found: Vec<usize>, expected: Vec<usize> },
    /// A render without a view.
    #[error("no camera to render into")]
    NoCamera,
    /// A camera, counted from 0, that cannot be rendered into.
    #[error("camera {index}: {problem}")]
    Camera { index: usize, problem: String },
    /// A render option outside its allowed range.
    #[error("render option `{field}` must be {allowed}")]
    Option { field: &'static str, allowed: &'static str },
    /// An array that does not fit into memory, or that is larger than the device's largest buffer.
    #[error(
        "{what} needs {bytes} bytes, more than this device holds in one piece: render fewer views at once, or a smaller image"
    )]
    Memory { what: &'static str, bytes: u64 },
    /// More pairs of a splat and a tile than the device's memory or [`RenderOptions`](crate::RenderOptions) allow.
    #[error(
        "{found} pairs of a splat and a 16×16 tile, at most {limit} fit: render fewer views at once, or a smaller image"
    )]
    TooManyIntersections { found: u64, limit: u64 },
    /// A value that is not written: most viewers fail at a NaN or an infinity in a PLY.
    #[error("Gaussian {index}: `{field}` is not finite")]
    NotFinite { field: &'static str, index: usize },
    /// A file of cameras or Gaussians.
    #[error(transparent)]
    File(#[from] FileError),
}
