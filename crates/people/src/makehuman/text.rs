//! Text files of MakeHuman.

use std::path::Path;

use glam::Vec3;
use snapsnap_base::{FileError, file, quoted};

/// Metres per unit of MakeHuman's files, a decimetre.
pub const METRES: f32 = 0.1;
/// Size limit of a file. The largest of MakeHuman's files has a few megabytes.
const MAX_BYTES: u64 = 256 << 20;
/// Largest coordinate, decimetres.
const LARGEST: f32 = 1000.0;

pub fn read_text(path: &Path) -> Result<String, FileError> {
    file::read_text(path, MAX_BYTES).map_err(FileError::read(path))
}

pub fn wrong(path: &Path, line: usize, text: &str) -> FileError {
    FileError::unsuitable(path, format!("line {}, `{}`: not understood", line + 1, quoted(text)))
}

/// Three numbers within ±`LARGEST`, converted to metres.
pub fn vector<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<Vec3> {
    let mut next = || words.next()?.parse().ok().filter(|v: &f32| v.abs() < LARGEST);
    Some(METRES * Vec3::new(next()?, next()?, next()?))
}
