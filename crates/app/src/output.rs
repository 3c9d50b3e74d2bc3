//! Output files and folders.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::Path;

use snapsnap_base::file::write_whole;

use crate::failure::Failure;

/// Writes a file, whole or not at all.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    write_whole(path, |out| out.write_all(bytes)).map_err(|e| Failure::cannot_write(path, &e))
}

/// Removes a file unless it is missing.
pub fn remove(path: &Path) -> Result<(), Failure> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(Failure::cannot_write(path, &e)),
        _ => Ok(()),
    }
}

/// Refuses a path that is no folder and cannot become one, or in which no file can be written.
pub fn check_folder(path: &Path) -> Result<(), Failure> {
    if path.exists() && !path.is_dir() {
        return Err(Failure::file(path, "exists and is no folder"));
    }
    let existing = path.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
    tempfile::tempfile_in(existing).map(drop).map_err(|e| Failure::cannot_write(path, &e))
}

/// Makes a folder and its parents unless they exist.
pub fn make_folder(path: &Path) -> Result<(), Failure> {
    fs::create_dir_all(path).map_err(|e| Failure::file(path, format_args!("cannot make this folder: {e}")))
}
