//! Packed data sets: tar archives in WebDataset's layout, and an index by which single files are read.
//!
//! ```text
//! ROOT/dataset.toml             the description
//!     /index.csv                archive,file,offset,length: one line per file
//!     /train-000000.tar, …      0000.img.0.png, 0000.depth.0.npz, …, 0000.cameras.json
//! ```
//!
//! A file `train/img/0000/0.png` of a folder is the member `0000.img.0.png` of an archive of its split: the subject is the
//! sample's key, and the rest its field. Archives of a set without splits begin with `all`.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use snapsnap_base::{FileError, file, quoted};

use super::Split;

/// Name of the index.
pub const INDEX: &str = "index.csv";
/// First word of archives of a set without splits.
const WHOLE: &str = "all";
/// Bytes of a tar header. Members begin at multiples of it.
pub const BLOCK: u64 = 512;

/// A line of the index.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Line {
    /// File name of the archive.
    pub archive: String,
    /// Name of the member.
    pub file: String,
    /// Position of its content in the archive, in bytes. The header lies before it.
    pub offset: u64,
    /// Bytes of its content.
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

/// The path of a member in a data set of folders.
fn path_of(archive: &str, member: &str) -> Option<PathBuf> {
    let (split, number) = archive.strip_suffix(".tar")?.rsplit_once('-')?;
    let is_split = split == WHOLE || Split::ALL.iter().any(|known| known.name() == split);
    let is_plain =
        |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\\', '\0']);
    if !is_split || number.is_empty() || !number.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let (subject, rest) = member.split_once('.')?;
    let (kind, name) = rest.split_once('.')?;
    if ![subject, kind, name].into_iter().all(is_plain) {
        return None;
    }
    let root = Path::new(if split == WHOLE { "" } else { split });
    let folder = root.join(kind);
    Some(if kind == "cameras" {
        folder.join(format!("{subject}.{name}"))
    } else {
        folder.join(subject).join(name)
    })
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
    file: Mutex<Option<File>>,
}

/// The files of a packed data set.
#[derive(Debug)]
pub struct Shards {
    index: PathBuf,
    archives: Vec<Archive>,
    /// By their paths in a data set of folders.
    files: BTreeMap<PathBuf, Place>,
}

impl Shards {
    /// Reads the index in `root`, if there is one.
    ///
    /// # Errors
    /// [`FileError`] for an index that is damaged or does not fit the archives, and for archives that are missing or cut.
    pub fn open(root: &Path) -> Result<Option<Self>, FileError> {
        let index = root.join(INDEX);
        if !index.exists() {
            return Ok(None);
        }
        let lines = csv::Reader::from_reader(file::open(&index).map_err(FileError::read(&index))?);
        let (mut archives, mut files) = (Vec::<Archive>::new(), BTreeMap::new());
        // Places of the archives in the list, and where their last members end.
        let mut known: HashMap<String, (usize, u64)> = HashMap::new();
        for (number, line) in lines.into_deserialize().enumerate() {
            let wrong =
                |problem: &str| FileError::unsuitable(&index, format!("line {}: {problem}", number + 2));
            let Line { archive, file, offset, length } = line.map_err(|e| wrong(&quoted(&e.to_string())))?;
            let path = path_of(&archive, &file).ok_or_else(|| {
                wrong(&format!("`{}` in `{}` is no file of a data set", quoted(&file), quoted(&archive)))
            })?;
            if offset < BLOCK || !offset.is_multiple_of(BLOCK) {
                return Err(wrong(&format!("`offset` is {offset}, must be a positive multiple of {BLOCK}")));
            }
            let end = offset.checked_add(length).and_then(|end| end.checked_next_multiple_of(BLOCK));
            let end =
                end.ok_or_else(|| wrong(&format!("`length` is {length}, more than a file can have")))?;
            let (place, last) = known.entry(archive).or_insert_with_key(|name| {
                archives.push(Archive { path: root.join(name), file: Mutex::default() });
                (archives.len() - 1, 0)
            });
            *last = end.max(*last);
            if files.insert(path, Place { archive: *place, offset, length }).is_some() {
                return Err(wrong(&format!("`{file}` is listed twice")));
            }
        }
        for (place, last) in known.into_values() {
            let path = &archives[place].path;
            let size =
                file::open(path).and_then(|file| file.metadata()).map_err(FileError::read(path))?.len();
            // Two empty blocks end an archive.
            let least = last.saturating_add(2 * BLOCK);
            if size < least {
                let message =
                    format!("is cut off, or not the archive of {INDEX}: it has {size} bytes of {least}");
                return Err(FileError::unsuitable(path, message));
            }
        }
        Ok(Some(Self { index, archives, files }))
    }

    fn place(&self, path: &Path) -> Result<Place, FileError> {
        let missing = || FileError::unsuitable(&self.index, format!("lists no {}", path.display()));
        self.files.get(path).copied().ok_or_else(missing)
    }

    /// The content of the file that folders would have at `path`, below the root, and a path for messages.
    ///
    /// # Errors
    /// [`FileError`] for a file that is not listed, and for one that is not where the index says.
    pub fn read(&self, path: &Path) -> Result<(PathBuf, Vec<u8>), FileError> {
        let place = self.place(path)?;
        let archive = &self.archives[place.archive].path;
        let whole = self.part(place, 0, BLOCK + place.length)?;
        // The header is compared, so that archives of another packing are noticed.
        let (header, content) = whole.split_at(BLOCK as usize);
        let mut members = tar::Archive::new(header);
        let member = members.entries().ok().and_then(|mut entries| entries.next()?.ok());
        let found = member.map(|member| (member.path_bytes().into_owned(), member.header().size()));
        match found {
            Some((name, Ok(length))) if length == place.length => {
                let name = String::from_utf8_lossy(&name).into_owned();
                let file = archive.file_name().unwrap_or_default().to_string_lossy();
                if path_of(&file, &name).as_deref() == Some(path) {
                    return Ok((archive.join(name), content.to_vec()));
                }
            }
            _ => {}
        }
        let message = format!("has no {} at byte {}, where {INDEX} has it", path.display(), place.offset);
        Err(FileError::unsuitable(archive, message))
    }

    /// Bytes of a member from `from` on, counted from its header.
    fn part(&self, place: Place, from: u64, count: u64) -> Result<Vec<u8>, FileError> {
        let archive = &self.archives[place.archive];
        let read = || -> io::Result<Vec<u8>> {
            let mut opened = archive.file.lock().unwrap_or_else(PoisonError::into_inner);
            let file = match opened.take() {
                Some(file) => file,
                None => file::open(&archive.path)?,
            };
            let file = opened.insert(file);
            file.seek(SeekFrom::Start(place.offset - BLOCK + from))?;
            // The archive may have become shorter since it was opened.
            let mut bytes = Vec::new();
            file.take(count).read_to_end(&mut bytes)?;
            if bytes.len() as u64 == count { Ok(bytes) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
        };
        read().map_err(FileError::read(&archive.path))
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
