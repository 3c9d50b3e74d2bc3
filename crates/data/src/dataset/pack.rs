//! Packing of data sets into tar archives.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process;

use snapsnap_base::{FileError, file, quoted};

use super::description::{self, DESCRIPTION};
use super::shards::{self, BLOCK, INDEX, Line};
use super::write::remove_left;
use super::{Folder, Split, Stored};

/// File name of the config of `prepare`, which is copied.
const SETTINGS: &str = "prepare.config.toml";
/// Suffix of the name of an unfinished folder.
const UNFINISHED: &str = ".unfinished";
/// Suffix of the lock's name, after [`UNFINISHED`].
const LOCK: &str = ".lock";

/// What was packed.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Packed {
    /// Subjects.
    pub subjects: usize,
    /// Files of the subjects.
    pub files: usize,
    /// Archives.
    pub archives: usize,
    /// Bytes of the archives.
    pub bytes: u64,
}

/// Packs a data set of folders into the new folder `output`: archives of about `size` bytes, each with whole subjects.
/// The folder appears when all files are written. Calls `progress` with the number of packed subjects and of all
/// subjects. The same data set gives the same bytes.
///
/// # Errors
/// [`FileError`]: `output` exists and is not empty, the data set is packed already, a subject lacks a file or has a
/// full stop in its name, or a file cannot be written.
pub fn pack(
    folder: &Folder,
    output: &Path,
    size: u64,
    mut progress: impl FnMut(usize, usize),
) -> Result<Packed, FileError> {
    if folder.shards.is_some() {
        return Err(FileError::unsuitable(folder.root(), "is packed already"));
    }
    let mut all: Vec<(Option<Split>, String)> = Vec::new();
    for split in folder.splits() {
        all.extend(folder.subjects(split)?.into_iter().map(|subject| (split, subject)));
    }
    if all.is_empty() {
        return Err(FileError::unsuitable(folder.root(), "there is no subject"));
    }
    match fs::read_dir(output).map(|mut entries| entries.next().is_some()) {
        Ok(true) => return Err(FileError::unsuitable(output, "is not empty; give another folder")),
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(FileError::read(output)(e)),
        _ => {}
    }
    let output = file::target_of(output);
    let name =
        output.file_name().ok_or_else(|| FileError::unsuitable(&output, "is no name of a new folder"))?;
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let output = parent.join(name);
    fs::create_dir_all(parent).map_err(FileError::write(parent))?;
    let prefix = format!(".{}.", name.to_string_lossy());
    tidy(parent, &prefix);
    // Several runs may pack into one folder at once: the first run that ends makes the folder.
    let temporary = parent.join(format!("{prefix}{}{UNFINISHED}", process::id()));
    // The system releases the lock of a killed run. Some file systems have no locks.
    let mark = parent.join(format!("{prefix}{}{UNFINISHED}{LOCK}", process::id()));
    let lock = File::create(&mark).map_err(FileError::write(&mark))?;
    let _ = lock.try_lock();
    let mark = file::unfinished_file(&mark);
    let made = fs::create_dir(&temporary).and_then(|()| file::unfinished_folder(&temporary));
    let made = made.map_err(FileError::write(&temporary));
    let packed = made.and_then(|guard| {
        let packed = Packer::new(folder, &temporary, size).and_then(|mut packer| {
            for (done, (split, subject)) in all.iter().enumerate() {
                progress(done, all.len());
                packer.add(*split, subject)?;
            }
            progress(all.len(), all.len());
            let packed = packer.finish()?;
            // An empty folder is replaced.
            let _ = fs::remove_dir(&output);
            file::rename(&temporary, &output).map_err(FileError::write(&output))?;
            Ok(packed)
        });
        let _ = fs::remove_dir_all(&temporary);
        drop(guard);
        packed
    });
    mark.remove();
    packed
}

/// Removes the folders of killed runs in `parent`, whose locks are free. Folders of runs in progress stay.
fn tidy(parent: &Path, prefix: &str) {
    for mark in fs::read_dir(parent).into_iter().flatten().flatten().map(|entry| entry.path()) {
        let name = mark.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let left =
            name.strip_prefix(prefix).and_then(|rest| rest.strip_suffix(LOCK)?.strip_suffix(UNFINISHED));
        if left.is_some_and(|process| process.parse::<u32>().is_ok()) {
            remove_left(&mark);
        }
    }
}

/// An archive that is being written.
struct Open {
    split: Option<Split>,
    path: PathBuf,
    out: tar::Builder<BufWriter<File>>,
    /// Bytes written so far.
    at: u64,
}

struct Packer<'a> {
    folder: &'a Folder,
    output: &'a Path,
    size: u64,
    index: csv::Writer<BufWriter<File>>,
    open: Option<Open>,
    /// Number of the next archive of the split.
    next: usize,
    packed: Packed,
}

fn create(path: &Path) -> Result<BufWriter<File>, FileError> {
    File::create(path).map(BufWriter::new).map_err(FileError::write(path))
}

impl<'a> Packer<'a> {
    fn new(folder: &'a Folder, output: &'a Path, size: u64) -> Result<Self, FileError> {
        let path = output.join(DESCRIPTION);
        fs::write(&path, description::text(folder.description())).map_err(FileError::write(&path))?;
        let settings = folder.root().join(SETTINGS);
        if settings.is_file() {
            fs::copy(&settings, output.join(SETTINGS)).map_err(FileError::write(&output.join(SETTINGS)))?;
        }
        let index = csv::Writer::from_writer(create(&output.join(INDEX))?);
        Ok(Self { folder, output, size, index, open: None, next: 0, packed: Packed::default() })
    }

    fn add(&mut self, split: Option<Split>, subject: &str) -> Result<(), FileError> {
        if subject.contains('.') {
            let folder = self.folder.path(split, "img", subject);
            let message = "a full stop in a subject's name is not possible in WebDataset's archives: rename the subject's folders";
            return Err(FileError::unsuitable(&folder, message));
        }
        if self.open.as_ref().is_some_and(|open| open.split != split) {
            self.close()?;
            self.next = 0;
        }
        if self.open.as_ref().is_some_and(|open| open.at >= self.size) {
            self.close()?;
        }
        if self.open.is_none() {
            let path = self.output.join(shards::archive_name(split, self.next));
            self.next += 1;
            self.open = Some(Open { split, out: tar::Builder::new(create(&path)?), path, at: 0 });
        }
        for (kind, name) in self.files() {
            let path = self.folder.path(split, kind, subject);
            let path = if kind == "cameras" { path } else { path.join(&name) };
            self.append(&shards::member_name(kind, subject, &name), &self.folder.stored(&path)?)?;
        }
        self.packed.subjects += 1;
        Ok(())
    }

    /// Kinds and names of a subject's files.
    fn files(&self) -> Vec<(&'static str, String)> {
        let description = self.folder.description();
        let of_kind = |kind: &'static str| {
            let names: Vec<String> = match kind {
                "cameras" => vec!["json".into()],
                "parm" => (0..description.views)
                    .flat_map(|view| ["intrinsic", "extrinsic"].map(|which| format!("{view}_{which}.npy")))
                    .collect(),
                _ => {
                    let large = description.high_resolution && kind == "img";
                    let views = (0..description.views).map(|view| view.to_string());
                    views
                        .flat_map(|view| [Some(view.clone()), large.then(|| format!("{view}_hr"))])
                        .flatten()
                        .map(|view| self.folder.file_name(kind, view))
                        .collect()
                }
            };
            names.into_iter().map(move |name| (kind, name))
        };
        self.folder.kinds().iter().flat_map(|kind| of_kind(kind)).collect()
    }

    fn append(&mut self, member: &str, stored: &Stored) -> Result<(), FileError> {
        let open = self.open.as_mut().expect("opened by `add`");
        let archive = open.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if shards::path_of(&archive, member).is_none() {
            let message = format!("`{}` is no name in an archive", quoted(member));
            return Err(FileError::unsuitable(&stored.path, message));
        }
        let mut header = tar::Header::new_ustar();
        header.set_path(member).map_err(|e| {
            FileError::unsuitable(&stored.path, format!("`{}` is no name in an archive: {e}", quoted(member)))
        })?;
        header.set_size(stored.bytes.len() as u64);
        header.set_mode(0o644);
        header.set_cksum();
        open.out.append(&header, stored.bytes.as_slice()).map_err(FileError::write(&open.path))?;
        let length = stored.bytes.len() as u64;
        let line = Line { archive, file: member.to_owned(), offset: open.at + BLOCK, length };
        self.index
            .serialize(line)
            .map_err(|e| FileError::write(&self.output.join(INDEX))(io::Error::other(e)))?;
        open.at += BLOCK + length.next_multiple_of(BLOCK);
        self.packed.files += 1;
        Ok(())
    }

    fn close(&mut self) -> Result<(), FileError> {
        let Some(open) = self.open.take() else { return Ok(()) };
        let written = open.out.into_inner().and_then(|mut out| {
            out.flush()?;
            out.get_ref().sync_all()?;
            out.get_ref().metadata()
        });
        self.packed.bytes += written.map_err(FileError::write(&open.path))?.len();
        self.packed.archives += 1;
        Ok(())
    }

    fn finish(mut self) -> Result<Packed, FileError> {
        self.close()?;
        let path = self.output.join(INDEX);
        let written = self.index.into_inner().map_err(|e| e.into_error());
        let synced = written.and_then(|mut out| {
            out.flush()?;
            out.get_ref().sync_all()
        });
        synced.map_err(FileError::write(&path))?;
        Ok(self.packed)
    }
}
