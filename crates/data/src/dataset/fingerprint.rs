//! The fingerprint of a data set, by which a resumed training detects changed pictures.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use sha2::{Digest, Sha256};
use snapsnap_base::folder::entries;
use snapsnap_base::{FileError, file};

use super::{Folder, Split};

/// Bytes that are read at the beginning and at the end of a file. A PNG and a compressed array end with checksums of
/// their content.
const ENDS: u64 = 4096;
/// Largest depth of files below a split: `img/S/v.png`.
const MAX_DEPTH: usize = 3;

impl Folder {
    /// A hash of the description and of the files of `splits`: their names, lengths, beginnings and ends.
    ///
    /// # Errors
    /// [`FileError::Read`] for a file or folder that cannot be read.
    pub fn fingerprint(&self, splits: &[Split]) -> Result<String, FileError> {
        let mut files = Vec::new();
        let there = self.splits();
        for split in splits.iter().map(|split| Some(*split)).filter(|split| there.contains(split)) {
            list(&self.split_path(split), MAX_DEPTH, &mut files)?;
        }
        files.sort_unstable();
        let hashes: Vec<_> = files
            .par_iter()
            .map(|path| {
                let (length, bytes) = ends(path).map_err(FileError::read(path))?;
                Ok(Sha256::new().chain_update(length.to_le_bytes()).chain_update(bytes).finalize())
            })
            .collect::<Result<_, FileError>>()?;
        let mut whole = Sha256::new();
        whole.update(toml::to_string(&self.description).expect("the description has only TOML types"));
        for (path, hash) in files.iter().zip(hashes) {
            let below = path.strip_prefix(&self.root).unwrap_or(path);
            whole.update(below.to_string_lossy().as_bytes());
            whole.update(hash);
        }
        Ok(format!("{:x}", whole.finalize()))
    }
}

/// Adds the files below a folder. Hidden files are unfinished, and left out.
fn list(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<(), FileError> {
    for path in entries(folder)? {
        match path.is_dir() {
            false => files.push(path),
            true if depth > 1 => list(&path, depth - 1, files)?,
            true => {}
        }
    }
    Ok(())
}

/// Length, beginning and end of a file.
fn ends(path: &Path) -> io::Result<(u64, Vec<u8>)> {
    let mut file: File = file::open(path)?;
    let length = file.metadata()?.len();
    let mut bytes = Vec::new();
    (&mut file).take(ENDS).read_to_end(&mut bytes)?;
    file.seek(SeekFrom::Start(length.saturating_sub(ENDS).max(ENDS)))?;
    file.take(ENDS).read_to_end(&mut bytes)?;
    Ok((length, bytes))
}
