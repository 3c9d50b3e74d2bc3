//! OBJ with materials and textures.

use std::collections::HashMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::Vec3;
use snapsnap_base::FileError;
use snapsnap_base::file::write_whole;

use super::png;
use crate::mesh::Mesh;

/// Writes `mesh` to `path`, and its materials and textures under the same name beside it. The OBJ is written last.
/// Vertex colours without textures get no white material, which would hide them in many programs.
///
/// # Errors
/// [`FileError::Write`].
pub fn write(mesh: &Mesh, path: &Path) -> Result<(), FileError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(FileError::write(folder))?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let is_white = mesh.materials.iter().all(|m| m.texture.is_none() && m.color == Vec3::ONE);
    let is_plain = !mesh.colors.is_empty() && is_white;
    let mut materials = String::new();
    let mut textures = HashMap::new();
    for (row, material) in mesh.materials.iter().enumerate() {
        let [r, g, b] = material.color.to_array();
        materials += &format!("newmtl m{row}\nKd {r} {g} {b}\n");
        if let Some(texture) = &material.texture {
            let count = textures.len();
            let file = textures.entry(Arc::as_ptr(texture)).or_insert_with(|| texture_beside(path, count));
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            materials += &format!("map_Kd {name}\n");
            let bytes = png(texture).map_err(FileError::write(file))?;
            write_whole(file, |out| out.write_all(&bytes)).map_err(FileError::write(file))?;
        }
    }
    let file = path.with_extension("mtl");
    if !is_plain {
        write_whole(&file, |out| out.write_all(materials.as_bytes())).map_err(FileError::write(&file))?;
    }
    let normals = mesh.normals();
    write_whole(path, |out| {
        if !is_plain {
            writeln!(out, "mtllib {stem}.mtl")?;
        }
        for (row, p) in mesh.positions.iter().enumerate() {
            write!(out, "v {} {} {}", p.x, p.y, p.z)?;
            match mesh.colors.get(row) {
                Some(c) => writeln!(out, " {} {} {}", c.x, c.y, c.z)?,
                None => writeln!(out)?,
            }
        }
        for n in &normals {
            // A vertex of degenerate faces has no normal.
            let n = if *n == Vec3::ZERO { Vec3::Y } else { *n };
            writeln!(out, "vn {} {} {}", n.x, n.y, n.z)?;
        }
        for t in &mesh.texcoords {
            writeln!(out, "vt {} {}", t.x, t.y)?;
        }
        let mut material = u32::MAX;
        for face in &mesh.faces {
            if face.material != material && !is_plain {
                material = face.material;
                writeln!(out, "usemtl m{material}")?;
            }
            let [a, b, c] = face.positions.map(|row| row + 1);
            match face.texcoords.map(|t| t.map(|row| row + 1)) {
                Some([s, t, u]) => writeln!(out, "f {a}/{s}/{a} {b}/{t}/{b} {c}/{u}/{c}")?,
                None => writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?,
            }
        }
        Ok(())
    })
    .map_err(FileError::write(path))
}

/// Path of the texture with this number.
pub fn texture_beside(path: &Path, number: usize) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{number}.png"))
}
