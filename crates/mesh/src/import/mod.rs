//! Scans from files: OBJ with MTL and textures, PLY with vertex colours or a texture, GLB.

mod glb;
mod obj;
mod ply;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::Vec3;
use image::RgbImage;
use snapsnap_splat::quoted;

use crate::FileError;
use crate::mesh::Mesh;
use crate::picture::decode;

/// Endings of the files that [`read`] understands, in lower case.
pub const EXTENSIONS: [&str; 3] = ["obj", "ply", "glb"];

/// Largest file that is read; the largest published scans take a few hundred megabytes.
const MAX_BYTES: u64 = 4 << 30;

/// Reads a scan. Positions are as in the file; positions that several vertices share are made one, so that shading is
/// smooth across the seams of textures.
///
/// # Errors
/// [`FileError`] for a file or texture that is missing, damaged, absurdly large or in another format, and for a mesh
/// that cannot be drawn: no triangle, NaN, faces that refer to nothing.
pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let reader = match extension.as_str() {
        "obj" => obj::read,
        "ply" => ply::read,
        "glb" => glb::read,
        _ => return Err(FileError::unsuitable(path, "is no scan: expected a file .obj, .ply or .glb")),
    };
    let metadata = fs::metadata(path).map_err(FileError::read(path))?;
    if !metadata.is_file() {
        return Err(FileError::unsuitable(path, "is no regular file"));
    }
    if metadata.len() > MAX_BYTES {
        let message = format!("has {} bytes, more than {MAX_BYTES}", metadata.len());
        return Err(FileError::unsuitable(path, message));
    }
    let mut mesh = reader(path)?;
    mesh.check().map_err(|e| FileError::unsuitable(path, e))?;
    // Files differ in what the brightest value of a colour is.
    if mesh.colors.iter().any(|c| c.max_element() > 2.0) {
        mesh.colors.iter_mut().for_each(|c| *c /= 255.0);
    }
    mesh.colors.iter_mut().for_each(|c| *c = c.clamp(Vec3::ZERO, Vec3::ONE));
    mesh.weld();
    Ok(mesh)
}

/// Textures of one scan, each decoded once.
struct Textures<'a> {
    /// The file that names them.
    owner: &'a Path,
    loaded: HashMap<PathBuf, Arc<RgbImage>>,
}

impl<'a> Textures<'a> {
    fn of(owner: &'a Path) -> Self {
        Self { owner, loaded: HashMap::new() }
    }

    /// The texture that the scan calls `name`. Scans travel: a path of another machine is looked for beside the scan.
    fn load(&mut self, name: &str) -> Result<Arc<RgbImage>, FileError> {
        let path = beside(self.owner, name).ok_or_else(|| {
            let message = format!("its texture `{}` is missing", quoted(name));
            FileError::unsuitable(self.owner, message)
        })?;
        if let Some(texture) = self.loaded.get(&path) {
            return Ok(texture.clone());
        }
        let texture = Arc::new(decode(&path)?.into_rgb8());
        self.loaded.insert(path, texture.clone());
        Ok(texture)
    }
}

/// The existing file that `owner` calls `name`: relative to its folder, or, failing that, of that name in its folder.
fn beside(owner: &Path, name: &str) -> Option<PathBuf> {
    let folder = owner.parent().unwrap_or(Path::new(""));
    let slashes = name.replace('\\', "/");
    let last = slashes.rsplit('/').next().unwrap_or_default();
    [name, &slashes, last].iter().map(|name| folder.join(name)).find(|path| path.is_file())
}
