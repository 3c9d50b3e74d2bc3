//! `--turntable`: views of the result from all sides.

use std::path::{Path, PathBuf};
use std::slice;

use image::RgbImage;
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::commands::render::MAX_INTERSECTIONS;
use crate::failure::Failure;
use crate::output::write;
use crate::pictures::{gif, picture, sheet, write_png};
use crate::progress::Progress;
use crate::view_folder::ViewFolder;

/// Side of the pictures.
const SIZE: u32 = 512;
/// Views of an animation or a folder, and frames per second of an animation.
const FRAMES: usize = 40;
pub const FRAMES_PER_SECOND: u32 = 20;
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
                ViewFolder::new(path, FRAMES, None).map(Self::Folder)
            }
            Some("gif") => Ok(Self::Gif(path.to_owned())),
            Some("png") => Ok(Self::Sheet(path.to_owned())),
            _ => {
                let message = "a turntable is a .gif, a .png or a folder (a name without an ending)";
                Err(Failure::Input(format!("--turntable {}: {message}", path.display())))
            }
        }
    }

    /// Output files; of a folder only the existing ones.
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
        let done = Progress::counted("views");
        let pictures = views(&gaussians.clone().into(), &orbit, &RenderOptions::inria(), &done)?;
        drop(done);
        match self {
            Self::Gif(path) => write(path, &gif(&pictures, FRAMES_PER_SECOND)?),
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

/// The pictures of an animation of a file's Gaussians. `done` is called with the numbers of finished and of all
/// pictures. Refuses scenes that would take far longer than a person's.
pub fn all_around(scene: &Loaded, done: &dyn Fn(usize, usize)) -> Result<Vec<RgbImage>, Failure> {
    let options = RenderOptions { max_intersections: MAX_INTERSECTIONS, ..RenderOptions::inria() };
    views(scene, &Camera::orbit(FRAMES, SIZE, SIZE), &options, done)
}

fn views(
    scene: &Loaded,
    cameras: &[Camera],
    options: &RenderOptions,
    done: &dyn Fn(usize, usize),
) -> Result<Vec<RgbImage>, Failure> {
    let view = |(i, camera)| {
        let rendered = render(&scene.seen_by(camera)?, slice::from_ref(camera), options)?;
        picture(&rendered.color).inspect(|_| done(i + 1, cameras.len()))
    };
    cameras.iter().enumerate().map(view).collect()
}
