//! What can go wrong on this floor.

use std::path::PathBuf;

/// Errors of cameras, Gaussians and PLY files.
#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    /// The tensors of one set of Gaussians disagree.
    #[error("Gaussians: `{field}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Name of the tensor.
        field: &'static str,
        /// Shape it has.
        found: Vec<usize>,
        /// Shape it should have.
        expected: Vec<usize>,
    },
    /// A value that may not be written: a NaN or an infinity in a PLY blinds most viewers.
    #[error("Gaussian {index}: `{field}` is not finite")]
    NotFinite {
        /// Name of the tensor.
        field: &'static str,
        /// Row of the offending value.
        index: usize,
    },
    /// A file could not be written.
    #[error("{path}: cannot write: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}
