//! `--turntable`: the result seen from all around.

use std::path::{Path, PathBuf};

use snapsnap_splat::{Camera, Gaussians, RenderOptions, cameras, render};

use crate::failure::Failure;
use crate::pictures::{make_folder, picture, sheet, write_gif, write_png};
use crate::progress::Progress;

/// Side of the pictures.
const SIZE: u32 = 512;
/// Views of an animation or a folder; two seconds.
const FRAMES: usize = 40;
const FRAMES_PER_SECOND: u32 = 20;
/// Views of a sheet, and how many side by side.
const SHEET: usize = 8;
const SHEET_COLUMNS: u32 = 4;

enum Form {
    Gif,
    Sheet,
    Folder,
}

/// Where and in what form.
pub struct Turntable {
    path: PathBuf,
    form: Form,
}

/// Whether `path` names a picture file rather than a folder.
pub fn is_file(path: &Path) -> bool {
    path.extension().is_some() && !path.is_dir()
}

impl Turntable {
    /// The form that the path's ending asks for.
    pub fn new(path: &Path) -> Result<Self, Failure> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        let form = match ending.as_deref() {
            _ if !is_file(path) => Form::Folder,
            Some("gif") => Form::Gif,
            Some("png") => Form::Sheet,
            _ => {
                let message = "a turntable is a .gif, a .png or a folder (a name without an ending)";
                return Err(Failure::Input(format!("--turntable {}: {message}", path.display())));
            }
        };
        if matches!(form, Form::Folder) && path.exists() && !path.is_dir() {
            return Err(Failure::Input(format!("--turntable {}: exists and is no folder", path.display())));
        }
        Ok(Self { path: path.to_owned(), form })
    }

    /// Renders `gaussians` (world frame) and writes the pictures.
    pub fn write(&self, gaussians: &Gaussians, quiet: bool) -> Result<(), Failure> {
        let count = if matches!(self.form, Form::Sheet) { SHEET } else { FRAMES };
        let orbit = Camera::orbit(count, SIZE, SIZE);
        let options = RenderOptions::inria();
        let progress = Progress::steps(quiet, count, "views");
        let mut pictures = Vec::with_capacity(count);
        for (i, camera) in orbit.iter().enumerate() {
            let rendered = render(gaussians, std::slice::from_ref(camera), &options)?;
            pictures.push(picture(&rendered.color)?);
            progress.step(i + 1, count, "views");
        }
        match self.form {
            Form::Gif => write_gif(&self.path, &pictures, FRAMES_PER_SECOND),
            Form::Sheet => write_png(&self.path, &sheet(&pictures, SHEET_COLUMNS)),
            Form::Folder => {
                make_folder(&self.path)?;
                for (i, picture) in pictures.iter().enumerate() {
                    write_png(&self.path.join(format!("{i:03}.png")), picture)?;
                }
                Ok(cameras::write(&orbit, &self.path.join("cameras.json"))?)
            }
        }
    }
}
