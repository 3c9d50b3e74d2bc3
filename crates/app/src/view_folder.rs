//! A folder of rendered views: `000.png`, `001.png`, … and the `cameras.json` that they were seen from.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use image::RgbImage;
use snapsnap_base::file;
use snapsnap_splat::{Camera, cameras};

use crate::commands::is_same_file;
use crate::failure::Failure;
use crate::pictures::{make_folder, write_png};

/// Name of the cameras beside the pictures.
const CAMERAS: &str = "cameras.json";

/// A folder that so many views are to be written into.
pub struct ViewFolder {
    path: PathBuf,
    views: usize,
    /// The cameras beside the pictures are an input, and stay as they are.
    keeps_cameras: bool,
}

impl ViewFolder {
    /// Refuses a path that is no folder or that nothing can be written into; `given` are the cameras that the command was
    /// given.
    pub fn new(path: &Path, views: usize, given: Option<&Path>) -> Result<Self, Failure> {
        if path.exists() && !path.is_dir() {
            return Err(Failure::Input(format!("{}: exists and is no folder", path.display())));
        }
        check_writable(path).map_err(|e| Failure::cannot_write(path, &e))?;
        let keeps_cameras = given.is_some_and(|given| is_same_file(given, &path.join(CAMERAS)));
        Ok(Self { path: path.to_owned(), views, keeps_cameras })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn names(&self) -> impl Iterator<Item = String> {
        let cameras = (!self.keeps_cameras).then(|| CAMERAS.to_owned());
        (0..self.views).map(name).chain(cameras)
    }

    /// Files that are there already and will be replaced; a folder that is yet to be made holds nothing to lose.
    pub fn replaced(&self) -> Vec<PathBuf> {
        self.names().map(|name| self.path.join(name)).filter(|path| path.symlink_metadata().is_ok()).collect()
    }

    /// Refuses another output that would be one of these files.
    pub fn check_apart(&self, other: &Path) -> Result<(), Failure> {
        let parent = other.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let name = other.file_name().unwrap_or_default().to_string_lossy();
        if is_same_folder(parent, &self.path) && (name == CAMERAS || self.names().any(|own| own == name)) {
            return Err(Failure::Input(format!("{}: is given for two outputs", other.display())));
        }
        Ok(())
    }

    /// Makes the folder. Where there are cameras, there are all of their pictures: those of an older render go first.
    pub fn begin(&self) -> Result<(), Failure> {
        make_folder(&self.path)?;
        if self.keeps_cameras {
            return Ok(());
        }
        // A link stays, as it does when it is written through.
        let path = file::target_of(&self.path.join(CAMERAS));
        match fs::remove_file(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(Failure::cannot_write(&path, &e)),
            _ => Ok(()),
        }
    }

    /// Writes one view.
    pub fn write(&self, view: usize, picture: &RgbImage) -> Result<(), Failure> {
        write_png(&self.path.join(name(view)), picture)
    }

    /// Writes the cameras, when all pictures are there.
    pub fn finish(&self, views: &[Camera]) -> Result<(), Failure> {
        if self.keeps_cameras {
            return Ok(());
        }
        Ok(cameras::write(views, &self.path.join(CAMERAS))?)
    }
}

/// Name of a view's picture.
fn name(view: usize) -> String {
    format!("{view:03}.png")
}

/// Whether files can be made in the folder, or, if it is yet to be made, in the nearest one around it.
fn check_writable(folder: &Path) -> io::Result<()> {
    let there = folder.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
    if !there.is_dir() {
        return Err(io::Error::new(
            io::ErrorKind::NotADirectory,
            format!("{} is no folder", there.display()),
        ));
    }
    tempfile::tempfile_in(there).map(drop)
}

/// Whether two paths lead to one folder, which need not be there yet.
fn is_same_folder(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => a.components().eq(b.components()),
    }
}
