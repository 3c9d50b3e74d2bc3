//! Writing of subjects.

use std::fs::{self, TryLockError};
use std::io;
use std::path::Path;

use rayon::prelude::*;
use snapsnap_base::{FileError, file, quoted};
use snapsnap_splat::{Camera, camera_file};

use super::{Folder, Layout, Split, files};
use snapsnap_mesh::view::View;

/// Folder of unfinished subjects in the data set's root.
pub(super) const UNFINISHED: &str = ".unfinished";

impl Folder {
    /// Whether the subject is complete: the last view has a file of every kind.
    pub fn has(&self, split: Split, subject: &str) -> bool {
        let last = self.description.views - 1;
        let person = self.person(Some(split), subject);
        self.kinds().iter().all(|kind| {
            let path = person.path(kind);
            let last = match *kind {
                "cameras" => path,
                "parm" => path.join(format!("{last}_extrinsic.npy")),
                _ => path.join(self.file_name(kind, last)),
            };
            last.is_file()
        })
    }

    /// Adds a subject from the source `origin`. `cameras` have the data set's resolution and pixel centres. `draw`
    /// renders a camera's view with pixel centres at +½; for `high_resolution` it is called again at twice the side.
    /// The subject appears when all files are written. Several runs may write into one data set at once: the result is
    /// false if another run is writing the subject.
    ///
    /// # Errors
    /// [`FileError::Write`]; [`FileError::Unsuitable`] for a name that is no file name, an empty view, or, in the
    /// authors' layout, a depth of half a metre or less.
    ///
    /// # Panics
    /// If the number or the size of the cameras differs from the set's views.
    pub fn write_subject(
        &self,
        split: Split,
        subject: &str,
        origin: &Path,
        cameras: &[Camera],
        draw: impl Fn(&Camera) -> View + Sync,
    ) -> Result<bool, FileError> {
        let description = &self.description;
        assert_eq!(cameras.len(), description.views, "cameras");
        let side = description.resolution;
        assert!(cameras.iter().all(|c| (c.width, c.height) == (side, side)), "a camera of another size");
        // Refuses names that lead to another folder, and hidden names.
        if subject.is_empty() || subject.starts_with('.') || subject.contains(['/', '\\']) {
            let message = format!("`{}` is no name of a subject", quoted(subject));
            return Err(FileError::unsuitable(origin, message));
        }
        let unfinished = self.root.join(UNFINISHED);
        fs::create_dir_all(&unfinished).map_err(FileError::write(&unfinished))?;
        let temporary = unfinished.join(format!("{split}-{subject}"));
        // The system releases the lock of a killed run.
        let mark = unfinished.join(format!("{split}-{subject}.lock"));
        let lock = fs::File::create(&mark).map_err(FileError::write(&mark))?;
        // Some file systems have no locks. Two runs may then write the same subject.
        if matches!(lock.try_lock(), Err(TryLockError::WouldBlock)) {
            return Ok(false);
        }
        let mark = file::unfinished_file(&mark);
        if self.has(split, subject) {
            mark.remove();
            return Ok(true);
        }
        // Files of a killed run.
        match fs::remove_dir_all(&temporary) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(FileError::write(&temporary)(e)),
            _ => {}
        }
        let guard = file::unfinished_folder(&temporary).map_err(FileError::write(&temporary))?;
        let made = self.write_into(&temporary, subject, origin, cameras, &draw);
        let made = made.and_then(|()| self.reveal(&temporary, split, subject));
        // The folder `.unfinished` stays, since other runs may use it.
        let _ = fs::remove_dir_all(&temporary);
        drop(guard);
        mark.remove();
        made.map(|()| true)
    }

    /// Removes the files of killed runs. Files of runs in progress stay.
    pub fn tidy(&self) {
        let unfinished = self.root.join(UNFINISHED);
        for mark in fs::read_dir(&unfinished).into_iter().flatten().flatten().map(|entry| entry.path()) {
            // The lock of a folder has the folder's name and the extension `lock`.
            if mark.extension().is_none_or(|extension| extension != "lock") {
                continue;
            }
            let Ok(lock) = fs::File::open(&mark) else { continue };
            // A run in progress holds its lock. This one is held until the folder is removed.
            if lock.try_lock().is_ok() {
                let _ = fs::remove_dir_all(mark.with_extension(""));
                let _ = fs::remove_file(mark);
            }
        }
        let _ = fs::remove_dir(unfinished);
    }

    /// Renders and writes every view into `folder`.
    fn write_into(
        &self,
        folder: &Path,
        subject: &str,
        origin: &Path,
        cameras: &[Camera],
        draw: &(impl Fn(&Camera) -> View + Sync),
    ) -> Result<(), FileError> {
        for kind in self.kinds().iter().filter(|kind| **kind != "cameras") {
            let path = folder.join(kind);
            fs::create_dir_all(&path).map_err(FileError::write(&path))?;
        }
        let views = cameras.par_iter().enumerate().map(|(view, camera)| {
            let drawn = draw(&self.exact_camera(camera));
            if drawn.depth.iter().all(|z| *z == 0.0) {
                return Err(FileError::unsuitable(origin, format!("view {view} sees nothing of {subject}")));
            }
            if self.description.layout == Layout::Authors
                && drawn.depth.iter().any(|z| *z > 0.0 && *z <= files::NEAREST)
            {
                let message = format!(
                    "view {view} has {subject} within half a metre, which the authors' layout cannot store"
                );
                return Err(FileError::unsuitable(origin, message));
            }
            let at = |kind: &str| folder.join(kind).join(self.file_name(kind, view));
            let picture = match self.description.layout {
                Layout::Authors => files::write_jpeg,
                Layout::Exact => files::write_rgba,
            };
            picture(&at("img"), &drawn)?;
            if self.description.high_resolution {
                let large = draw(&self.exact_camera(&camera.resized(2 * camera.width, 2 * camera.height)));
                picture(&folder.join("img").join(self.file_name("img", format_args!("{view}_hr"))), &large)?;
            }
            match self.description.layout {
                Layout::Authors => {
                    files::write_mask(&at("mask"), &drawn)?;
                    files::write_inverse_depth(&at("depth"), &drawn)?;
                    files::write_camera(&folder.join("parm"), view, camera)
                }
                Layout::Exact => {
                    let size = [drawn.height, drawn.width];
                    files::write_depth(&at("depth"), size, &drawn.depth)?;
                    if self.description.second_depth {
                        files::write_depth(&at("depth2"), size, &drawn.second)?;
                    }
                    Ok(())
                }
            }
        });
        // The error of the first failed view, in any order of the threads.
        views.collect::<Vec<_>>().into_iter().collect::<Result<(), _>>()?;
        if self.description.layout == Layout::Exact {
            camera_file::write(cameras, &folder.join("cameras"))?;
        }
        Ok(())
    }

    /// Moves a complete subject to its place, `img` last.
    fn reveal(&self, temporary: &Path, split: Split, subject: &str) -> Result<(), FileError> {
        let person = self.person(Some(split), subject);
        for kind in self.kinds().iter().rev() {
            let (from, to) = (temporary.join(kind), person.path(kind));
            let parent = to.parent().unwrap_or(&self.root);
            fs::create_dir_all(parent).map_err(FileError::write(parent))?;
            // A folder of an incomplete subject.
            if to.is_dir() {
                fs::remove_dir_all(&to).map_err(FileError::write(&to))?;
            }
            file::rename(&from, &to).map_err(FileError::write(&to))?;
        }
        Ok(())
    }

    /// The kinds of a subject's files, `img` first.
    pub(super) fn kinds(&self) -> &'static [&'static str] {
        match self.description.layout {
            Layout::Authors => &["img", "mask", "depth", "parm"],
            Layout::Exact if self.description.second_depth => &["img", "depth", "depth2", "cameras"],
            Layout::Exact => &["img", "depth", "cameras"],
        }
    }
}
