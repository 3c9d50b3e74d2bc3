//! What can go wrong on this floor.

use std::cell::Cell;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use snapsnap_splat::{file, quoted};

/// Opens a regular file: reading a pipe or a device might never end.
///
/// # Errors
/// [`FileError`] if it is something else, or cannot be opened.
pub fn open(path: &Path) -> Result<File, FileError> {
    file::open(path).map_err(FileError::read(path))
}

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Whether this thread is inside [`guarded`]: what panics there becomes an error, and a panic hook need not report it.
pub fn is_guarded() -> bool {
    GUARDED.get()
}

/// Reads a file with libraries that may panic on damaged ones, and turns a panic into an error.
///
/// # Errors
/// What `read` returns, or [`FileError::Unsuitable`] with the panic's message.
pub fn guarded<T>(path: &Path, read: impl FnOnce() -> Result<T, FileError>) -> Result<T, FileError> {
    let outer = GUARDED.replace(true);
    // What `read` may have left half-changed is dropped with it.
    let result = catch_unwind(AssertUnwindSafe(read));
    GUARDED.set(outer);
    result.unwrap_or_else(|panic| {
        let message = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let message = message.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
        Err(FileError::unsuitable(path, format!("is damaged: the reader failed ({})", quoted(&message))))
    })
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
