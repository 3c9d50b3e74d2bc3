//! Binary PLY of triangles with vertex colours.

use std::io::{self, Write};
use std::path::Path;

use snapsnap_base::FileError;
use snapsnap_base::file::write_whole;

use crate::mesh::{Mesh, bytes};

pub fn write(mesh: &Mesh, path: &Path) -> Result<(), FileError> {
    if mesh.materials.iter().any(|material| material.texture.is_some()) {
        let message = "a PLY has vertex colours and no texture: write a .glb or .obj";
        return Err(FileError::unsuitable(path, message));
    }
    write_whole(path, |out| {
        writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}", mesh.positions.len())?;
        ["x", "y", "z"].iter().try_for_each(|axis| writeln!(out, "property float {axis}"))?;
        if !mesh.colors.is_empty() {
            write!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\n")?;
        }
        writeln!(
            out,
            "element face {}\nproperty list uchar int vertex_indices\nend_header",
            mesh.faces.len()
        )?;
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
    })
    .map_err(FileError::write(path))
}
