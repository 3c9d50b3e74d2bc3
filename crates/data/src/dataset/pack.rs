//! Packing of data sets into tar archives.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use snapsnap_base::{FileError, file, quoted};

use super::archives::{self, BLOCK, INDEX, Line};
use super::description::{self, DESCRIPTION};
use super::{Folder, Split, Stored};

/// File name of the config of `prepare`, which is copied.
const SETTINGS: &str = "prepare.config.toml";

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
/// The description is written last, and makes the folder a data set. Calls `progress` with the number of packed subjects
/// and of all subjects. The same data set gives the same bytes.
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
    if folder.archives.is_some() {
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
    let output = &file::target_of(output);
    let _guard = file::unfinished_folder(output).map_err(FileError::write(output))?;
    let index = csv::Writer::from_writer(create(&output.join(INDEX))?);
    let mut packer = Packer { folder, output, size, index, open: None, next: 0, packed: Packed::default() };
    let pack = || {
        for (done, (split, subject)) in all.iter().enumerate() {
            progress(done, all.len());
            packer.add(*split, subject)?;
        }
        progress(all.len(), all.len());
        packer.finish()
    };
    let packed = pack();
    match packed {
        Ok(_) => file::sync_folder(&output.join("..")),
        Err(_) => drop(fs::remove_dir_all(output)),
    }
    packed
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
    // New: of two runs into one folder, one fails before it has written anything.
    File::create_new(path).map(BufWriter::new).map_err(FileError::write(path))
}

impl Packer<'_> {
    fn add(&mut self, split: Option<Split>, subject: &str) -> Result<(), FileError> {
        let person = self.folder.person(split, subject);
        if subject.contains('.') {
            let message = "a full stop in a subject's name is not possible in WebDataset's archives: rename the subject's folders";
            return Err(FileError::unsuitable(&person.path("img"), message));
        }
        if self.open.as_ref().is_some_and(|open| open.split != split) {
            self.close()?;
            self.next = 0;
        }
        if self.open.as_ref().is_some_and(|open| open.at >= self.size) {
            self.close()?;
        }
        if self.open.is_none() {
            let path = self.output.join(archives::archive_name(split, self.next));
            self.next += 1;
            self.open = Some(Open { split, out: tar::Builder::new(create(&path)?), path, at: 0 });
        }
        for (kind, name) in self.files() {
            let path = person.path(kind);
            let path = if kind == "cameras" { path } else { path.join(&name) };
            self.append(&archives::member_name(kind, subject, &name), &self.folder.stored(&path)?)?;
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
        if archives::path_of(&archive, member).is_none() {
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
        let settings = self.folder.root().join(SETTINGS);
        if settings.is_file() {
            let bytes = fs::read(&settings).map_err(FileError::read(&settings))?;
            let path = self.output.join(SETTINGS);
            file::write_whole(&path, |out| out.write_all(&bytes)).map_err(FileError::write(&path))?;
        }
        description::write(&self.output.join(DESCRIPTION), self.folder.description())?;
        Ok(self.packed)
    }
}
