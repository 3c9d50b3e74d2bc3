//! Files that a command writes.

use std::io::Write;
use std::path::Path;

use snapsnap_base::file::write_whole;

use crate::failure::Failure;

/// Writes a file, whole or not at all.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    write_whole(path, |out| out.write_all(bytes)).map_err(|e| Failure::cannot_write(path, &e))
}
