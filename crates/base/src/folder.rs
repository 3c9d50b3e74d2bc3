//! Files of a folder.

use std::fs;
use std::path::{Path, PathBuf};

use crate::FileError;

/// Entries of a folder in order of name, without hidden files, which some systems add to copied folders.
///
/// # Errors
/// [`FileError::Read`].
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(FileError::read(folder))? {
        let entry = entry.map_err(FileError::read(folder))?;
        if !entry.file_name().to_string_lossy().starts_with('.') {
            paths.push(entry.path());
        }
    }
    paths.sort_unstable();
    Ok(paths)
}

/// The files with this extension, in upper or lower case.
///
/// # Errors
/// [`FileError::Read`].
pub fn with_ending(folder: &Path, ending: &str) -> Result<Vec<PathBuf>, FileError> {
    let mut paths = entries(folder)?;
    paths.retain(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending)) && path.is_file());
    Ok(paths)
}
