//! Export of meshes: OBJ with materials and textures, binary PLY with vertex colours, binary glTF 2.0.

mod glb;
mod obj;
mod ply;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
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
/// all. An OBJ comes after its pictures and materials. `offset` is the place of the mesh's origin in the world, metres. Far from the
/// world's origin f32 is too coarse for positions, so that an OBJ and a PLY then contain f64, and a GLB moves its node.
///
/// # Errors
/// [`FileError::Write`]; [`FileError::Unsuitable`] for a texture in a PLY.
pub fn write(mesh: &Mesh, offset: DVec3, path: &Path) -> Result<(), FileError> {
    match Kind::named(path) {
        Some(Kind::Obj) => obj::write(mesh, offset, path),
        Some(Kind::Ply) => ply::write(mesh, offset, path),
        Some(Kind::Glb) | None => glb::write(mesh, offset, path),
    }
}

/// The files that [`write()`] writes beside `path` for a mesh with one texture, or with colours of positions.
pub fn companions(path: &Path, textured: bool) -> Vec<PathBuf> {
    match Kind::named(path) {
        Some(Kind::Obj) if textured => vec![path.with_extension("mtl"), obj::texture_beside(path, 0)],
        _ => Vec::new(),
    }
}

fn png(texture: &Arc<RgbImage>) -> io::Result<Vec<u8>> {
    let mut bytes = io::Cursor::new(Vec::new());
    texture.write_to(&mut bytes, ImageFormat::Png).map_err(io::Error::other)?;
    Ok(bytes.into_inner())
}
