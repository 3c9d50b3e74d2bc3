//! Writing of subjects.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use snapsnap_splat::{Camera, cameras, file};

use super::{Folder, Layout, Split, files};
use crate::DataError;
use crate::view::View;

/// Subjects in the making, in the data set's root.
const UNFINISHED: &str = ".unfinished";

impl Folder {
    /// Whether the subject is there, whole.
    pub fn has(&self, split: Split, subject: &str) -> bool {
        self.path(Some(split), "img", subject).is_dir()
    }

    /// Adds a subject: `draw` gives what each of `cameras` (pixel centres at +½, side of the set) sees. The subject
    /// appears when everything is written.
    ///
    /// # Errors
    /// [`DataError::Write`].
    ///
    /// # Panics
    /// If there are more or fewer cameras than the set has views, or one of another size.
    pub fn write_subject(
        &self,
        split: Split,
        subject: &str,
        cameras: &[Camera],
        draw: impl Fn(&Camera) -> View + Sync,
    ) -> Result<(), DataError> {
        let description = &self.description;
        assert_eq!(cameras.len(), description.views, "cameras");
        let side = description.resolution;
        assert!(cameras.iter().all(|c| (c.width, c.height) == (side, side)), "a camera of another size");
        let unfinished = self.root.join(UNFINISHED);
        let temporary = unfinished.join(format!("{split}-{subject}"));
        // Left by a run that was killed.
        match fs::remove_dir_all(&temporary) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(DataError::write(&temporary)(e)),
            _ => {}
        }
        let guard = file::unfinished_folder(&temporary).map_err(DataError::write(&temporary))?;
        let made = self.write_into(&temporary, subject, cameras, &draw);
        let made = made.and_then(|()| self.reveal(&temporary, split, subject));
        // Whether it went well or not, nothing stays; others may still be at work beside it.
        let _ = fs::remove_dir_all(&temporary);
        let _ = fs::remove_dir(&unfinished);
        drop(guard);
        made
    }

    /// Draws and writes every view below `folder`.
    fn write_into(
        &self,
        folder: &Path,
        subject: &str,
        cameras: &[Camera],
        draw: &(impl Fn(&Camera) -> View + Sync),
    ) -> Result<(), DataError> {
        for kind in self.kinds() {
            let path = folder.join(kind);
            fs::create_dir_all(&path).map_err(DataError::write(&path))?;
        }
        cameras.par_iter().enumerate().try_for_each(|(view, camera)| {
            let drawn = draw(&self.exact_camera(camera));
            let picture = |suffix: &str, drawn: &View| match self.description.layout {
                Layout::Authors => {
                    files::write_jpeg(&folder.join("img").join(format!("{view}{suffix}.jpg")), drawn)
                }
                Layout::Exact => {
                    files::write_rgba(&folder.join("img").join(format!("{view}{suffix}.png")), drawn)
                }
            };
            picture("", &drawn)?;
            if self.description.high_resolution {
                picture(
                    "_hr",
                    &draw(&self.exact_camera(&camera.resized(2 * camera.width, 2 * camera.height))),
                )?;
            }
            let depth = folder.join("depth");
            match self.description.layout {
                Layout::Authors => {
                    files::write_mask(&folder.join("mask").join(format!("{view}.png")), &drawn)?;
                    files::write_inverse_depth(&depth.join(format!("{view}.png")), &drawn)?;
                    files::write_camera(&folder.join("parm"), view, camera)
                }
                Layout::Exact => files::write_depth(&depth.join(format!("{view}.npz")), &drawn),
            }
        })?;
        if self.description.layout == Layout::Exact {
            let path = folder.join("cameras").join(format!("{subject}.json"));
            cameras::write(cameras, &path).map_err(|e| DataError::splat(&path, e))?;
        }
        Ok(())
    }

    /// Moves a finished subject to its place, `img` last.
    fn reveal(&self, temporary: &Path, split: Split, subject: &str) -> Result<(), DataError> {
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
            fs::create_dir_all(parent).map_err(DataError::write(parent))?;
            // A run that was killed in between left it; without `img` nobody has seen it.
            if to.is_dir() {
                fs::remove_dir_all(&to).map_err(DataError::write(&to))?;
            }
            fs::rename(&from, &to).map_err(DataError::write(&to))?;
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
