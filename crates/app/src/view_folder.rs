//! A folder of rendered views: `000.png`, `001.png`, … and their cameras, `cameras.json`.

use std::path::{Path, PathBuf};

use image::RgbImage;
use snapsnap_base::file;
use snapsnap_splat::{Camera, camera_file};

use crate::failure::Failure;
use crate::output::{check_folder, is_same_file, make_folder, place, remove};
use crate::pictures::write_png;

/// Name of the file of cameras.
pub const CAMERAS: &str = "cameras.json";

/// An output folder of a number of views.
pub struct ViewFolder {
    pub path: PathBuf,
    views: usize,
    /// Whether the folder's cameras are an input of the command. They are not replaced then.
    pub keeps_cameras: bool,
}

impl ViewFolder {
    /// Refuses paths that are no writable folder. `given` is the file of the command's cameras.
    pub fn new(path: &Path, views: usize, given: Option<&Path>) -> Result<Self, Failure> {
        check_folder(path)?;
        let keeps_cameras = given.is_some_and(|given| is_same_file(given, &path.join(CAMERAS)));
        Ok(Self { path: path.to_owned(), views, keeps_cameras })
    }

    /// Names of the files that will be written.
    fn names(&self) -> impl Iterator<Item = String> {
        let cameras = (!self.keeps_cameras).then(|| CAMERAS.to_owned());
        (0..self.views).map(name).chain(cameras)
    }

    /// Existing files that will be replaced.
    pub fn replaced(&self) -> Vec<PathBuf> {
        self.names().map(|name| self.path.join(name)).filter(|path| path.symlink_metadata().is_ok()).collect()
    }

    /// Refuses another output with the path of one of the files.
    pub fn check_apart(&self, other: &Path) -> Result<(), Failure> {
        let name = other.file_name().unwrap_or_default().to_string_lossy();
        let is_taken = name == CAMERAS || self.names().any(|own| own == name);
        if is_taken && place(other) == place(&self.path.join(&*name)) {
            return Err(Failure::file(other, "is given for two outputs"));
        }
        Ok(())
    }

    /// Makes the folder. Removes older cameras with their pictures, since a folder with cameras must contain all of their
    /// pictures and no others.
    pub fn begin(&self) -> Result<(), Failure> {
        make_folder(&self.path)?;
        if self.keeps_cameras {
            return Ok(());
        }
        // A link to the file stays.
        let cameras = file::target_of(&self.path.join(CAMERAS));
        // Pictures of older cameras that no new picture replaces.
        let older = camera_file::read(&cameras).map_or(0, |older| older.len());
        (self.views..older).try_for_each(|view| remove(&self.path.join(name(view))))?;
        remove(&cameras)
    }

    pub fn write(&self, view: usize, picture: &RgbImage) -> Result<(), Failure> {
        write_png(&self.path.join(name(view)), picture)
    }

    /// Writes the cameras, after all pictures.
    pub fn finish(&self, views: &[Camera]) -> Result<(), Failure> {
        if self.keeps_cameras {
            return Ok(());
        }
        Ok(camera_file::write(views, &self.path.join(CAMERAS))?)
    }
}

/// Name of a view's picture.
fn name(view: usize) -> String {
    format!("{view:03}.png")
}
