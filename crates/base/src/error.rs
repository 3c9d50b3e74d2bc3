//! Errors of files, and readers that panic.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Whether this thread is inside [`guarded`], where a panic becomes an error that a panic hook need not report.
pub fn is_guarded() -> bool {
    GUARDED.get()
}

/// Runs `read`, whose libraries may panic on damaged files, and turns a panic into an error.
///
/// # Errors
/// The error of `read`, or [`FileError::Unsuitable`] with the panic's message.
pub fn guarded<T>(path: &Path, read: impl FnOnce() -> Result<T, FileError>) -> Result<T, FileError> {
    let outer = GUARDED.replace(true);
    // Half-changed state of `read` is dropped with it.
    let result = catch_unwind(AssertUnwindSafe(read));
    GUARDED.set(outer);
    result.unwrap_or_else(|panic| {
        let message = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let message = message.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
        Err(FileError::unsuitable(path, format!("is damaged: the reader failed ({})", quoted(&message))))
    })
}

/// Errors of files; each names its file.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the names say it")]
pub enum FileError {
    /// Missing or unreadable file.
    #[error("{path}: cannot read: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    /// A file that could not be written.
    #[error("{path}: cannot write: {source}")]
    Write { path: PathBuf, source: std::io::Error },
    /// A file that can be read but not used, with the fault and the remedy.
    #[error("{path}: {message}")]
    Unsuitable { path: PathBuf, message: String },
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

    /// `path` can be read but not used.
    pub fn unsuitable(path: &Path, message: impl ToString) -> Self {
        Self::Unsuitable { path: path.to_owned(), message: message.to_string() }
    }
}

/// Text from a file as it may appear in a message: escaped and short.
pub fn quoted(text: &str) -> String {
    /// Characters that are shown.
    const SHOWN: usize = 80;
    let mut shown: String = text.chars().take(SHOWN).flat_map(char::escape_debug).collect();
    if text.chars().nth(SHOWN).is_some() {
        shown.push('…');
    }
    shown
}
