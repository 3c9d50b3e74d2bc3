//! Writing of subjects.

use std::fs::{self, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use snapsnap_base::file;
use snapsnap_base::quoted;
use snapsnap_splat::{Camera, cameras};

use super::{Folder, Layout, Split, files};
use snapsnap_base::FileError;
use snapsnap_mesh::view::View;

/// Refuses names that lead elsewhere than to a subject's own folders, or to hidden ones.
fn check_name(subject: &str) -> Result<(), String> {
    if subject.is_empty() || subject.starts_with('.') || subject.contains(['/', '\\']) {
        return Err(format!("`{}` is no name of a subject", quoted(subject)));
    }
    Ok(())
}

/// Subjects in the making, in the data set's root.
pub(super) const UNFINISHED: &str = ".unfinished";

/// What became of a subject that was to be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Made {
    /// It is there now, or another run has made it meanwhile.
    Whole,
    /// Another run is making it at this moment.
    Elsewhere,
}

impl Folder {
    /// Whether the subject is there, whole: every kind of file, up to the last view.
    pub fn has(&self, split: Split, subject: &str) -> bool {
        let last = self.description.views - 1;
        self.kinds().into_iter().all(|kind| match kind {
            "cameras" => self.split_path(Some(split)).join(kind).join(format!("{subject}.json")).is_file(),
            "parm" => self.path(Some(split), kind, subject).join(format!("{last}_extrinsic.npy")).is_file(),
            _ => self.path(Some(split), kind, subject).join(self.file_name(kind, last)).is_file(),
        })
    }

    /// Adds a subject, made of the file `origin`: `draw` gives what each of `cameras` (pixel centres at +½, side of the set) sees. The subject
    /// appears when everything is written; runs that work on one data set leave each other's subjects alone.
    ///
    /// # Errors
    /// [`FileError::Write`]; [`FileError::Unsuitable`] if a camera sees nothing, or, in the authors' layout,
    /// something within half a metre.
    ///
    /// # Panics
    /// If there are more or fewer cameras than the set has views, or one of another size.
    pub fn write_subject(
        &self,
        split: Split,
        subject: &str,
        origin: &Path,
        cameras: &[Camera],
        draw: impl Fn(&Camera) -> View + Sync,
    ) -> Result<Made, FileError> {
        let description = &self.description;
        assert_eq!(cameras.len(), description.views, "cameras");
        let side = description.resolution;
        assert!(cameras.iter().all(|c| (c.width, c.height) == (side, side)), "a camera of another size");
        check_name(subject).map_err(|problem| FileError::unsuitable(origin, problem))?;
        let unfinished = self.root.join(UNFINISHED);
        fs::create_dir_all(&unfinished).map_err(FileError::write(&unfinished))?;
        let temporary = unfinished.join(format!("{split}-{subject}"));
        // The system frees the lock of a run that was killed.
        let mark = unfinished.join(format!("{split}-{subject}.lock"));
        let lock = fs::File::create(&mark).map_err(FileError::write(&mark))?;
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => return Ok(Made::Elsewhere),
            // Some file systems know no locks: nothing keeps two runs apart there.
            Err(TryLockError::Error(_)) | Ok(()) => {}
        }
        let mark = file::unfinished_file(&mark);
        if self.has(split, subject) {
            mark.remove();
            return Ok(Made::Whole);
        }
        // Left by a run that was killed.
        match fs::remove_dir_all(&temporary) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(FileError::write(&temporary)(e)),
            _ => {}
        }
        let guard = file::unfinished_folder(&temporary).map_err(FileError::write(&temporary))?;
        let made = self.write_into(&temporary, subject, origin, cameras, &draw);
        let made = made.and_then(|()| self.reveal(&temporary, split, subject));
        // Whether it went well or not, nothing stays. Other runs may be at work beside it: the folder around is theirs too.
        let _ = fs::remove_dir_all(&temporary);
        drop(guard);
        mark.remove();
        made.map(|()| Made::Whole)
    }

    /// Removes what runs leave that were killed; what another run is at work on stays.
    pub fn tidy(&self) {
        let unfinished = self.root.join(UNFINISHED);
        for mark in fs::read_dir(&unfinished).into_iter().flatten().flatten().map(|entry| entry.path()) {
            let is_mark = mark.extension().is_some_and(|extension| extension == "lock");
            // Held by whoever is at work; the system frees those of the dead.
            let Ok(lock) = fs::File::open(&mark) else { continue };
            // Held until what it marks is gone.
            if is_mark && lock.try_lock().is_ok() {
                let _ = fs::remove_dir_all(mark.with_extension(""));
                let _ = fs::remove_file(&mark);
            }
        }
        let _ = fs::remove_dir(unfinished);
    }

    /// Draws and writes every view below `folder`.
    fn write_into(
        &self,
        folder: &Path,
        subject: &str,
        origin: &Path,
        cameras: &[Camera],
        draw: &(impl Fn(&Camera) -> View + Sync),
    ) -> Result<(), FileError> {
        for kind in self.kinds() {
            let path = folder.join(kind);
            fs::create_dir_all(&path).map_err(FileError::write(&path))?;
        }
        let views = cameras.par_iter().enumerate().map(|(view, camera)| {
            let drawn = draw(&self.exact_camera(camera));
            if drawn.depth.iter().all(|z| *z == 0.0) {
                return Err(FileError::unsuitable(origin, format!("view {view} sees nothing of {subject}")));
            }
            if self.description.layout == Layout::Authors && drawn.depth.iter().any(|z| *z > 0.0 && *z <= files::NEAREST)
            {
                let message = format!(
                    "view {view} sees {subject} within half a metre, for which the authors' layout has no number"
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
                Layout::Exact => files::write_depth(&at("depth"), &drawn),
            }
        });
        // The first view's problem is told, whichever was found first.
        views.collect::<Vec<_>>().into_iter().collect::<Result<(), _>>()?;
        if self.description.layout == Layout::Exact {
            let path = folder.join("cameras").join(format!("{subject}.json"));
            cameras::write(cameras, &path)?;
        }
        Ok(())
    }

    /// Moves a finished subject to its place, `img` last.
    fn reveal(&self, temporary: &Path, split: Split, subject: &str) -> Result<(), FileError> {
        let mut kinds = self.kinds();
        kinds.reverse();
        for kind in kinds {
            let (from, to): (PathBuf, PathBuf) = match kind {
                "cameras" => {
                    let name = format!("{subject}.json");
                    (temporary.join(kind).join(&name), self.split_path(Some(split)).join(kind).join(name))
                }
                _ => (temporary.join(kind), self.path(Some(split), kind, subject)),
            };
            let parent = to.parent().unwrap_or(&self.root);
            fs::create_dir_all(parent).map_err(FileError::write(parent))?;
            // A run that was killed in between left it, or a part of it was removed: the subject was not whole.
            if to.is_dir() {
                fs::remove_dir_all(&to).map_err(FileError::write(&to))?;
            }
            fs::rename(&from, &to).map_err(FileError::write(&to))?;
        }
        Ok(())
    }

    /// What a subject consists of, `img` first.
    pub(super) fn kinds(&self) -> Vec<&'static str> {
        match self.description.layout {
            Layout::Authors => vec!["img", "mask", "depth", "parm"],
            Layout::Exact => vec!["img", "depth", "cameras"],
        }
    }
}
