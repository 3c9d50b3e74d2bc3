//! What can go wrong on this floor.

use std::fs::File;
use std::path::{Path, PathBuf};

/// Opens a regular file: reading a pipe or a device might never end.
///
/// # Errors
/// [`FileError`] if it is something else, or cannot be opened.
pub fn open(path: &Path) -> Result<File, FileError> {
    if std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir()) {
        return Err(FileError::unsuitable(path, "is no regular file"));
    }
    File::open(path).map_err(FileError::read(path))
}

/// Errors of photographs, scans, data of people and data sets; each names its file.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// Missing or unreadable file.
    #[error("{path}: cannot read: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file that could not be written.
    #[error("{path}: cannot write: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not an image of a known format, or a damaged one.
    #[error("{path}: not a readable image: {source}")]
    Decode {
        /// The file.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
    /// A file that can be read but not used.
    #[error("{path}: {message}")]
    Unsuitable {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
}

impl FileError {
    /// For `map_err`: `path` cannot be read.
    pub fn read(path: &Path) -> impl Fn(std::io::Error) -> Self {
        move |source| Self::Read { path: path.to_owned(), source }
    }

    /// For `map_err`: `path` cannot be written.
    pub fn write(path: &Path) -> impl Fn(std::io::Error) -> Self {
        move |source| Self::Write { path: path.to_owned(), source }
    }

    /// A camera file's error, which names the file itself.
    pub fn splat(path: &Path, error: snapsnap_splat::SplatError) -> Self {
        if let snapsnap_splat::SplatError::Write { source, .. } = error {
            return Self::Write { path: path.to_owned(), source };
        }
        let message = error.to_string();
        let message = message.strip_prefix(&format!("{}: ", path.display())).unwrap_or(&message).to_owned();
        Self::Unsuitable { path: path.to_owned(), message }
    }

    /// `path` can be read but not used.
    pub fn unsuitable(path: &Path, message: impl ToString) -> Self {
        Self::Unsuitable { path: path.to_owned(), message: message.to_string() }
    }
}
