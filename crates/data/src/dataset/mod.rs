//! Data-set folders: rendered views of many subjects, in the layout of the authors' tools or in the exact layout
//! (docs/method.md, "Layouts").
//!
//! ```text
//! authors' layout                          exact layout
//! ROOT_1024_24/dataset.toml (ours)         ROOT/dataset.toml
//! └ train, val                             └ train, val, test
//!   ├ img/S/v.jpg, v_hr.jpg                  ├ img/S/v.png, v_hr.png   RGBA, straight alpha
//!   ├ mask/S/v.png          0 or 255         ├ depth/S/v.npz           `depth`, f32 metres, 0: background
//!   ├ depth/S/v.png         ⌊2¹⁵/z⌋          └ cameras/S.json          one camera per view
//!   └ parm/S/v_intrinsic.npy, v_extrinsic.npy  └ depth2/S/v.npz       optional: the second surface, as depth
//! ```
//!
//! A subject is added whole or not at all: it is written under another name, and its `img` folder, which marks a
//! subject, is renamed last.

mod check;
mod description;
mod files;
#[cfg(test)]
mod tests;
mod views;
mod write;

use std::fmt::Display;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use sha2::{Digest, Sha256};
use snapsnap_base::{FileError, file, folder};

pub use check::{Checked, check};
pub use description::DESCRIPTION;
pub use description::{Arrangement, Description, Drawn, Layout, MAX_RESOLUTION, MAX_VIEWS, Split};
use snapsnap_mesh::picture;
pub(crate) use views::centres;
pub use views::{DepthMap, Person};

/// Largest file of a data set that is read.
const MAX_FILE: u64 = 1 << 30;
/// Bytes that are read at the beginning and at the end of a file. A PNG and a compressed array end with checksums of
/// their content.
const ENDS: u64 = 4096;
/// Largest depth of files below a split: `img/S/v.png`.
const MAX_DEPTH: usize = 3;

/// A data-set folder.
#[derive(Debug, Clone)]
pub struct Folder {
    root: PathBuf,
    description: Description,
}

impl Folder {
    /// Opens a data set. Without a `dataset.toml` it must be in the layout of the authors' tools.
    ///
    /// # Errors
    /// [`FileError`]: no folder, a wrong `dataset.toml`, or neither a `dataset.toml` nor the authors' layout.
    pub fn open(root: &Path) -> Result<Self, FileError> {
        let path = root.join(DESCRIPTION);
        if path.is_file() {
            let description = description::read(&path)?;
            return Ok(Self { root: root.to_owned(), description });
        }
        fs::read_dir(root).map(drop).map_err(FileError::read(root))?;
        let foreign = |message: &str| {
            FileError::unsuitable(root, format!("is no data set: it has no {DESCRIPTION}, and {message}"))
        };
        let views = views_in_name(root)
            .ok_or_else(|| foreign("its name does not end in the number of views, as `_1024_24`"))?;
        let mut folder = Self {
            root: root.to_owned(),
            description: Description {
                layout: Layout::Authors,
                views,
                arrangement: Arrangement::Ring,
                resolution: 1,
                high_resolution: false,
                second_depth: false,
                pixel_centre: 0.0,
                source: "written by the authors' tools".into(),
                drawn: None,
            },
        };
        let first = |split| Some((split, folder.subjects(split).ok()?.into_iter().next()?));
        let found = folder.splits().into_iter().find_map(first);
        let missing = || foreign("no subject lies in img, train/img, val/img or test/img");
        let (split, subject) = found.ok_or_else(missing)?;
        let first = folder.person(split, &subject).picture_path(0);
        let [width, _] = picture::size(&first, None)?;
        folder.description.resolution = width;
        folder.description.high_resolution = first.with_file_name("0_hr.jpg").is_file();
        if let Some(problem) = folder.description.problem() {
            return Err(FileError::unsuitable(&first, problem));
        }
        Ok(folder)
    }

    /// Opens the folder `root` for new subjects, and makes it if necessary.
    ///
    /// # Errors
    /// [`FileError`] if it cannot be made or contains another kind of data set. In the authors' layout, its name must
    /// end in the number of views, which the authors' loader reads there.
    pub fn create(root: &Path, description: Description) -> Result<Self, FileError> {
        if let Some(problem) = description.problem() {
            return Err(FileError::unsuitable(root, problem));
        }
        let Description { layout, views, resolution, .. } = description;
        if layout == Layout::Authors && views_in_name(root) != Some(views) {
            let message = format!(
                "the authors' loader reads the number of views from the folder's name: it must end in `_{resolution}_{views}`"
            );
            return Err(FileError::unsuitable(root, message));
        }
        fs::create_dir_all(root).map_err(FileError::write(root))?;
        let path = root.join(DESCRIPTION);
        if path.exists() {
            let there = description::read(&path)?;
            if there != description {
                let message = format!(
                    "describes another data set than the one to be written: {}; give another folder",
                    description::differences(&there, &description)
                );
                return Err(FileError::unsuitable(&path, message));
            }
        } else {
            description::write(&path, &description)?;
        }
        Ok(Self { root: root.to_owned(), description })
    }

    /// The folder's path.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Description of the data set.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// The splits of the data set; `None` is the root itself, as in the authors' test sets.
    pub fn splits(&self) -> Vec<Option<Split>> {
        let there = |split: &Option<Split>| self.split_path(*split).join("img").is_dir();
        std::iter::once(None).chain(Split::ALL.map(Some)).filter(there).collect()
    }

    /// Names of the subjects of a split, in order.
    ///
    /// # Errors
    /// [`FileError::Read`] for a missing split.
    pub fn subjects(&self, split: Option<Split>) -> Result<Vec<String>, FileError> {
        let folder = self.split_path(split).join("img");
        Ok(folder::entries(&folder)?.iter().filter(|path| path.is_dir()).map(|path| name(path)).collect())
    }

    /// Reads a file of the data set.
    fn bytes(&self, path: &Path) -> Result<Vec<u8>, FileError> {
        file::read(path, self.largest()).map_err(FileError::read(path))
    }

    /// Largest size of a file in bytes: enough for all cameras, and for 16 bytes per pixel at twice the side.
    fn largest(&self) -> u64 {
        let Description { resolution, views, .. } = self.description;
        let (pixels, views) = (u64::from(resolution).pow(2), views as u64);
        MAX_FILE.min((1 << 20) + 4096 * views + 64 * pixels)
    }

    /// File name of a view's picture, mask or depth; `kind` is the name of the folder.
    fn file_name(&self, kind: &str, view: impl Display) -> String {
        let ending = match (kind, self.description.layout) {
            ("depth" | "depth2", Layout::Exact) => "npz",
            ("img", Layout::Authors) => "jpg",
            _ => "png",
        };
        format!("{view}.{ending}")
    }

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
        let hash = |path: &PathBuf| -> Result<_, FileError> {
            let (length, bytes) = ends(path).map_err(FileError::read(path))?;
            Ok(Sha256::new().chain_update(length.to_le_bytes()).chain_update(bytes).finalize())
        };
        let hashes = files.par_iter().map(hash).collect::<Result<Vec<_>, _>>()?;
        let mut whole = Sha256::new();
        whole.update(toml::to_string(&self.description).expect("the description has only TOML types"));
        for (path, hash) in files.iter().zip(hashes) {
            let below = path.strip_prefix(&self.root).unwrap_or(path);
            whole.update(below.to_string_lossy().as_bytes());
            whole.update(hash);
        }
        Ok(format!("{:x}", whole.finalize()))
    }

    fn split_path(&self, split: Option<Split>) -> PathBuf {
        match split {
            Some(split) => self.root.join(split.name()),
            None => self.root.clone(),
        }
    }
}

/// Adds the files below a folder. Hidden files are unfinished, and left out.
fn list(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<(), FileError> {
    for path in folder::entries(folder)? {
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

/// The last part of a path.
fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The number after the last underscore of the folder's name.
fn views_in_name(root: &Path) -> Option<usize> {
    let name = name(&root.canonicalize().unwrap_or_else(|_| root.to_owned()));
    let (_, views) = name.rsplit_once('_')?;
    views.parse().ok().filter(|views| (1..=MAX_VIEWS).contains(views))
}
