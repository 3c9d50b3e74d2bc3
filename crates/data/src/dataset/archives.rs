//! Packed data sets: tar archives in WebDataset's layout, and an index for reading single files.
//!
//! ```text
//! ROOT/dataset.toml             the description
//!     /archives.csv             archive,file,offset,length: one line per file
//!     /train-000000.tar, …      0000.img.0.png, 0000.depth.0.npz, …, 0000.cameras.json
//! ```
//!
//! A file `train/img/0000/0.png` of a folder is the member `0000.img.0.png` of an archive of its split: the subject is
//! the sample's key, and the rest its field. Archives of a set without splits begin with `all`.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};
use snapsnap_base::folder::entries;
use snapsnap_base::{FileError, file, quoted};

use super::{MAX_FILE, Split};

/// Name of the index.
pub const INDEX: &str = "archives.csv";
/// First word of archives of a set without splits.
const WHOLE: &str = "all";
/// Largest index that is read, in bytes: four million files.
const MAX_INDEX: u64 = 256 << 20;
/// Number of archives that stay open after the first read. Systems limit the number of open files.
const KEPT_OPEN: usize = 256;
/// Bytes of a tar header. Members begin at multiples of this size.
pub const BLOCK: u64 = 512;

/// A line of the index.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Line {
    /// File name of the archive.
    pub archive: String,
    /// Name of the member.
    pub file: String,
    /// Position of the member's content in the archive, in bytes. The header lies before the content.
    pub offset: u64,
    /// Bytes of the member's content.
    pub length: u64,
}

/// Name of the archive `number` of a split.
pub fn archive_name(split: Option<Split>, number: usize) -> String {
    format!("{}-{number:06}.tar", split.map_or(WHOLE, Split::name))
}

/// Name of the member with the file `name` of a kind, or with the cameras of a subject.
pub fn member_name(kind: &str, subject: &str, name: &str) -> String {
    format!("{subject}.{kind}.{name}")
}

/// The folder of an archive's split; `None` if this is no archive's name.
fn folder_of(archive: &str) -> Option<&str> {
    let (split, number) = archive.strip_suffix(".tar")?.rsplit_once('-')?;
    let is_number = !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit());
    let known = Split::ALL.into_iter().map(Split::name).find(|name| *name == split);
    let folder = if split == WHOLE { Some("") } else { known };
    folder.filter(|_| is_number)
}

/// The path of a member in a data set of folders.
pub fn path_of(archive: &str, member: &str) -> Option<PathBuf> {
    let is_plain =
        |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\\', '\0']);
    let (subject, rest) = member.split_once('.')?;
    let (kind, name) = rest.split_once('.')?;
    if ![subject, kind, name].into_iter().all(is_plain) {
        return None;
    }
    let folder = Path::new(folder_of(archive)?).join(kind);
    Some(if kind == "cameras" {
        folder.join(format!("{subject}.{name}"))
    } else {
        folder.join(subject).join(name)
    })
}

/// Names of the archives in a folder, in order.
fn archives_in(root: &Path) -> Result<Vec<String>, FileError> {
    let entries = entries(root)?;
    let names = entries.iter().filter_map(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    Ok(names.filter(|name| folder_of(name).is_some()).collect())
}

/// Place of a file.
#[derive(Debug, Clone, Copy)]
struct Place {
    archive: usize,
    offset: u64,
    length: u64,
}

#[derive(Debug)]
struct Archive {
    path: PathBuf,
    /// Opened when it is first read.
    file: OnceLock<File>,
}

/// The files of a packed data set.
#[derive(Debug)]
pub struct Archives {
    index: PathBuf,
    archives: Vec<Archive>,
    /// By their paths in a data set of folders.
    files: BTreeMap<PathBuf, Place>,
}

impl Archives {
    /// Reads the index in `root`; `None` if there is neither an index nor an archive.
    ///
    /// # Errors
    /// [`FileError`] for an index that is damaged or does not fit the archives, and for missing or truncated archives.
    pub fn open(root: &Path) -> Result<Option<Self>, FileError> {
        let index = root.join(INDEX);
        let there = archives_in(root)?;
        if there.is_empty() && !index.exists() {
            return Ok(None);
        }
        let source = file::open(&index).map_err(FileError::read(&index))?;
        let size = source.metadata().map_err(FileError::read(&index))?.len();
        if size > MAX_INDEX {
            return Err(FileError::unsuitable(&index, format!("has {size} bytes, more than {MAX_INDEX}")));
        }
        let archives: Vec<Archive> =
            there.iter().map(|name| Archive { path: root.join(name), file: OnceLock::new() }).collect();
        let known: HashMap<&str, usize> = there.iter().enumerate().map(|(i, name)| (&**name, i)).collect();
        // Where the last members of the archives end.
        let mut ends = vec![0; archives.len()];
        let mut files = BTreeMap::new();
        for (number, line) in csv::Reader::from_reader(source.take(MAX_INDEX)).into_deserialize().enumerate()
        {
            let wrong =
                |problem: &str| FileError::unsuitable(&index, format!("line {}: {problem}", number + 2));
            let Line { archive, file, offset, length } = line.map_err(|e| wrong(&quoted(&e.to_string())))?;
            let path = path_of(&archive, &file).ok_or_else(|| {
                wrong(&format!("`{}` in `{}` is no file of a data set", quoted(&file), quoted(&archive)))
            })?;
            let Some(archive) = known.get(&*archive).copied() else {
                return Err(wrong(&format!(
                    "`archive` is {}, which is missing",
                    root.join(archive).display()
                )));
            };
            if offset < BLOCK || !offset.is_multiple_of(BLOCK) {
                return Err(wrong(&format!("`offset` is {offset}, must be a positive multiple of {BLOCK}")));
            }
            if length > MAX_FILE {
                return Err(wrong(&format!("`length` is {length}, more than {MAX_FILE}")));
            }
            let end = offset.checked_add(length).and_then(|end| end.checked_next_multiple_of(BLOCK));
            let end = end.ok_or_else(|| wrong(&format!("`offset` is {offset}, beyond every file")))?;
            ends[archive] = end.max(ends[archive]);
            if files.insert(path, Place { archive, offset, length }).is_some() {
                return Err(wrong(&format!("`{file}` is listed twice")));
            }
        }
        for (archive, end) in archives.iter().zip(ends) {
            let path = &archive.path;
            let size =
                file::open(path).and_then(|file| file.metadata()).map_err(FileError::read(path))?.len();
            // Two empty blocks end an archive.
            let expected = end.saturating_add(2 * BLOCK);
            if size != expected {
                let message = format!(
                    "has {size} bytes, by {INDEX} {expected}: one of the two files is truncated or of another data set"
                );
                return Err(FileError::unsuitable(path, message));
            }
        }
        Ok(Some(Self { index, archives, files }))
    }

    fn place(&self, path: &Path) -> Result<Place, FileError> {
        let missing = || FileError::unsuitable(&self.index, format!("lists no {}", path.display()));
        self.files.get(path).copied().ok_or_else(missing)
    }

    /// The content of the file that a data set of folders has at `path`, below its root, and a path for messages.
    ///
    /// # Errors
    /// [`FileError`] for a file that is not listed, and for one that is not where the index says.
    pub fn read(&self, path: &Path) -> Result<(PathBuf, Vec<u8>), FileError> {
        let place = self.place(path)?;
        let archive = &self.archives[place.archive].path;
        // The header is compared, so that archives of another packing are noticed.
        let header = self.part(place, 0, BLOCK)?;
        let mut members = tar::Archive::new(&header[..]);
        let member = members.entries().ok().and_then(|mut entries| entries.next()?.ok());
        let found = member.map(|member| (member.path_bytes().into_owned(), member.header().size()));
        if let Some((name, Ok(length))) = found
            && length == place.length
        {
            let name = String::from_utf8_lossy(&name).into_owned();
            let file = archive.file_name().unwrap_or_default().to_string_lossy();
            if path_of(&file, &name).as_deref() == Some(path) {
                return Ok((archive.join(name), self.part(place, BLOCK, length)?));
            }
        }
        let message = format!("has no {} at byte {}, where {INDEX} has it", path.display(), place.offset);
        Err(FileError::unsuitable(archive, message))
    }

    /// Reads `count` bytes of a member, from byte `from` on, counted from the beginning of its header.
    fn part(&self, place: Place, from: u64, count: u64) -> Result<Vec<u8>, FileError> {
        let Archive { path, file: kept } = &self.archives[place.archive];
        let at = place.offset - BLOCK + from;
        let read = || {
            let mut bytes = vec![0; count as usize];
            if let Some(kept) = kept.get() {
                file::read_exact_at(kept, &mut bytes, at)?;
                return Ok(bytes);
            }
            let opened = file::open(path)?;
            file::read_exact_at(&opened, &mut bytes, at)?;
            if place.archive < KEPT_OPEN {
                let _ = kept.set(opened);
            }
            Ok(bytes)
        };
        read().map_err(FileError::read(path))
    }

    /// Length of a file, and its first and last `ends` bytes, as far as they do not overlap.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn ends(&self, path: &Path, ends: u64) -> Result<(u64, Vec<u8>), FileError> {
        let place = self.place(path)?;
        let first = place.length.min(ends);
        let mut bytes = self.part(place, BLOCK, first)?;
        let from = place.length.saturating_sub(ends).max(first);
        bytes.extend(self.part(place, BLOCK + from, place.length - from)?);
        Ok((place.length, bytes))
    }

    /// Paths of all files below a folder, in order.
    pub fn files(&self, folder: &Path) -> impl Iterator<Item = &Path> {
        self.files
            .range(folder.to_owned()..)
            .map(|(path, _)| path.as_path())
            .take_while(move |p| p.starts_with(folder))
    }

    /// Names in a folder, in order, and whether they are folders.
    pub fn names(&self, folder: &Path) -> Vec<(String, bool)> {
        let mut names: Vec<(String, bool)> = Vec::new();
        for path in self.files(folder) {
            let Ok(below) = path.strip_prefix(folder) else { continue };
            let mut parts = below.components();
            let Some(first) = parts.next() else { continue };
            let name = first.as_os_str().to_string_lossy().into_owned();
            if names.last().is_none_or(|(last, _)| *last != name) {
                names.push((name, parts.next().is_some()));
            }
        }
        names
    }
}
