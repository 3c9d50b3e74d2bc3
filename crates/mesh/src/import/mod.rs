//! Scans from files: OBJ with MTL and textures, PLY with vertex colours or a texture, GLB.

mod glb;
mod obj;
mod ply;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::Vec3;
use image::{DynamicImage, RgbImage};
use snapsnap_base::quoted;

use crate::mesh::Mesh;
use crate::picture::decode;
use snapsnap_base::FileError;
use snapsnap_base::guarded;

/// Endings of the files that [`read`] understands, in lower case.
pub const EXTENSIONS: [&str; 3] = ["obj", "ply", "glb"];

/// Largest file that is read; the largest published scans take a few hundred megabytes.
const MAX_BYTES: u64 = 4 << 30;

/// Bytes that a texture may take once it is decoded: 8192×8192 pixels of red, green, blue and alpha in 16 bits each.
const MAX_TEXTURE: u64 = 512 << 20;
/// The same for all textures of a scan, as red, green and blue.
const MAX_TEXTURES: u64 = 1 << 30;

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
    let mut mesh = guarded(path, || reader(path))?;
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
    room: Room,
}

/// Bytes that are left for textures.
struct Room(u64);

impl Room {
    fn new() -> Self {
        Self(MAX_TEXTURES)
    }

    /// Decodes a texture with `decode`, which is told how many bytes it may take.
    fn fill(
        &mut self,
        decode: impl FnOnce(u64) -> Result<DynamicImage, FileError>,
    ) -> Result<Arc<RgbImage>, FileError> {
        let texture = match decode(MAX_TEXTURE.min(self.0)) {
            Err(FileError::Unsuitable { path, message }) if self.0 < MAX_TEXTURE => {
                let all = MAX_TEXTURES >> 20;
                let message = format!("{message} (all textures of a scan together may take {all} MiB)");
                return Err(FileError::Unsuitable { path, message });
            }
            decoded => decoded?.into_rgb8(),
        };
        self.0 = self.0.saturating_sub(texture.len() as u64);
        Ok(Arc::new(texture))
    }
}

impl<'a> Textures<'a> {
    fn of(owner: &'a Path) -> Self {
        Self { owner, loaded: HashMap::new(), room: Room::new() }
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
        let texture = self.room.fill(|most| decode(&path, most))?;
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
