//! Export of meshes: OBJ with materials and textures, binary PLY with vertex colours, binary glTF 2.0.

mod glb;
mod obj;
mod ply;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{ImageFormat, RgbImage};
use snapsnap_base::FileError;

use crate::mesh::Mesh;

pub use glb::glb_bytes;
pub use obj::write_obj;

/// Kinds of files for a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Wavefront OBJ, its materials and textures beside it.
    Obj,
    /// Binary PLY with vertex colours, without textures.
    Ply,
    /// Binary glTF 2.0, textures inside.
    Glb,
}

impl Kind {
    /// The kind that the extension of `path` names, if any.
    pub fn named(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "obj" => Some(Self::Obj),
            "ply" => Some(Self::Ply),
            "glb" => Some(Self::Glb),
            _ => None,
        }
    }
}

/// Writes `mesh` to `path` as the kind that its extension names, or else as GLB. Each file is written as a whole or not at
/// all. An OBJ comes after its pictures and materials.
///
/// # Errors
/// [`FileError::Write`]; [`FileError::Unsuitable`] for a texture in a PLY.
pub fn write(mesh: &Mesh, path: &Path) -> Result<(), FileError> {
    match Kind::named(path) {
        Some(Kind::Obj) => write_obj(mesh, path),
        Some(Kind::Ply) => ply::write(mesh, path),
        Some(Kind::Glb) | None => glb::write(mesh, path),
    }
}

/// The files that [`write()`] writes beside `path` for a mesh of one material.
pub fn companions(path: &Path, textured: bool) -> Vec<PathBuf> {
    if Kind::named(path) != Some(Kind::Obj) {
        return Vec::new();
    }
    let texture = textured.then(|| obj::texture_beside(path, 0));
    [Some(path.with_extension("mtl")), texture].into_iter().flatten().collect()
}

fn png(texture: &Arc<RgbImage>) -> io::Result<Vec<u8>> {
    let mut bytes = io::Cursor::new(Vec::new());
    texture.write_to(&mut bytes, ImageFormat::Png).map_err(io::Error::other)?;
    Ok(bytes.into_inner())
}
