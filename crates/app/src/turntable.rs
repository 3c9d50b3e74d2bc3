//! `--turntable`: views of the result from all sides.

use std::path::{Path, PathBuf};
use std::slice;

use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::failure::Failure;
use crate::pictures::{picture, sheet, write_gif, write_png};
use crate::progress::Progress;
use crate::view_folder::ViewFolder;

/// Side of the pictures.
const SIZE: u32 = 512;
/// Views of an animation or a folder, and frames per second of an animation.
const FRAMES: usize = 40;
const FRAMES_PER_SECOND: u32 = 20;
/// Views and columns of a sheet.
const SHEET: usize = 8;
const SHEET_COLUMNS: u32 = 4;

/// Path and form of a turntable.
pub enum Turntable {
    /// An animation.
    Gif(PathBuf),
    /// Views side by side.
    Sheet(PathBuf),
    /// A picture of each view.
    Folder(ViewFolder),
}

impl Turntable {
    /// The form follows from the path's extension.
    pub fn new(path: &Path) -> Result<Self, Failure> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match ending.as_deref() {
            ending if ending.is_none() || path.is_dir() => {
                Ok(Self::Folder(ViewFolder::new(path, FRAMES, None)?))
            }
            Some("gif") => Ok(Self::Gif(path.to_owned())),
            Some("png") => Ok(Self::Sheet(path.to_owned())),
            _ => {
                let message = "a turntable is a .gif, a .png or a folder (a name without an ending)";
                Err(Failure::Input(format!("--turntable {}: {message}", path.display())))
            }
        }
    }

    /// Output files, without those that a folder does not contain yet.
    pub fn outputs(&self) -> Vec<PathBuf> {
        match self {
            Self::Gif(path) | Self::Sheet(path) => vec![path.clone()],
            Self::Folder(folder) => folder.replaced(),
        }
    }

    /// Refuses another output with the path of one of the files.
    pub fn check_apart(&self, other: &Path) -> Result<(), Failure> {
        if let Self::Folder(folder) = self { folder.check_apart(other) } else { Ok(()) }
    }

    /// Renders `gaussians` (world frame) and writes the pictures.
    pub fn write(&self, gaussians: &Gaussians) -> Result<(), Failure> {
        let count = if matches!(self, Self::Sheet(_)) { SHEET } else { FRAMES };
        let orbit = Camera::orbit(count, SIZE, SIZE);
        let options = RenderOptions::inria();
        let pictures = Progress::over(orbit.iter(), "views")
            .map(|camera| picture(&render(gaussians, slice::from_ref(camera), &options)?.color))
            .collect::<Result<Vec<_>, Failure>>()?;
        match self {
            Self::Gif(path) => write_gif(path, &pictures, FRAMES_PER_SECOND),
            Self::Sheet(path) => write_png(path, &sheet(&pictures, SHEET_COLUMNS)),
            Self::Folder(folder) => {
                folder.begin()?;
                for (i, picture) in pictures.iter().enumerate() {
                    folder.write(i, picture)?;
                }
                folder.finish(&orbit)
            }
        }
    }
}
