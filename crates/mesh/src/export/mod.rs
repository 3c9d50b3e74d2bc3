//! Export of meshes: OBJ with materials and textures, binary PLY with vertex colours, binary glTF 2.0, and STL and 3MF
//! for printers.

mod glb;
mod obj;
mod print;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{ImageFormat, RgbImage};
use snapsnap_base::{FileError, file};

use crate::mesh::{Mesh, bytes};

pub use glb::{Clip, Joint, Skin, glb_bytes};
pub use obj::write as write_obj;

/// File formats of a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Wavefront OBJ, with materials and textures in separate files.
    Obj,
    /// Binary PLY with vertex colours, without textures.
    Ply,
    /// Binary glTF 2.0, textures inside.
    Glb,
    /// Binary STL in millimetres, z up, without colours.
    Stl,
    /// 3MF in millimetres, z up, without colours.
    ThreeMf,
}

impl Kind {
    /// The format of the extension of `path`, if it is known.
    pub fn named(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "obj" => Some(Self::Obj),
            "ply" => Some(Self::Ply),
            "glb" => Some(Self::Glb),
            "stl" => Some(Self::Stl),
            "3mf" => Some(Self::ThreeMf),
            _ => None,
        }
    }

    /// Whether the format can hold a texture.
    pub fn has_texture(self) -> bool {
        matches!(self, Self::Obj | Self::Glb)
    }
}

/// Writes `mesh` to `path` in the format of the extension, GLB by default. Each file is written as a whole or not at
/// all, an OBJ after its textures and materials.
///
/// # Errors
/// [`FileError::Write`]; [`FileError::Unsuitable`] for a texture in a PLY.
pub fn write(mesh: &Mesh, path: &Path) -> Result<(), FileError> {
    let kind = Kind::named(path).unwrap_or(Kind::Glb);
    if kind == Kind::Obj {
        return obj::write(mesh, path);
    }
    if kind == Kind::Ply && mesh.materials.iter().any(|material| material.texture.is_some()) {
        let message = "a PLY has vertex colours and no texture: write a .glb or .obj";
        return Err(FileError::unsuitable(path, message));
    }
    file::write_whole(path, |out| match kind {
        Kind::Ply => write_ply(mesh, out),
        Kind::Stl => print::write_stl(mesh, out),
        Kind::ThreeMf => print::write_3mf(mesh, out),
        Kind::Glb | Kind::Obj => out.write_all(&glb_bytes(mesh, None)?),
    })
    .map_err(FileError::write(path))
}

/// Writes a binary PLY of triangles with vertex colours.
fn write_ply(mesh: &Mesh, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}", mesh.positions.len())?;
    ["x", "y", "z"].iter().try_for_each(|axis| writeln!(out, "property float {axis}"))?;
    if !mesh.colors.is_empty() {
        write!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\n")?;
    }
    let faces = mesh.faces.len();
    writeln!(out, "element face {faces}\nproperty list uchar int vertex_indices\nend_header")?;
    for (row, p) in mesh.positions.iter().enumerate() {
        p.to_array().iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
        if let Some(color) = mesh.colors.get(row) {
            out.write_all(&bytes(*color))?;
        }
    }
    for face in &mesh.faces {
        out.write_all(&[3])?;
        for row in face.positions {
            let row = i32::try_from(row).map_err(io::Error::other)?;
            out.write_all(&row.to_le_bytes())?;
        }
    }
    Ok(())
}

/// Additional files that [`write()`] writes for a mesh with one texture, or without one.
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
