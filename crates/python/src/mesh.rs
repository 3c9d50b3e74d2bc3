//! One closed surface of Gaussians.

use std::path::PathBuf;
use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyByteArray;
use snapsnap::Failure;
use snapsnap_mesh::export::{self, Kind};
use snapsnap_mesh::fuse::{Options, fuse};

use crate::arrays::{Arrays, bytes, gaussians};
use crate::work::{run, unsuitable};

/// A textured or coloured triangle mesh.
#[pyclass(frozen)]
pub struct Mesh(Arc<snapsnap_mesh::mesh::Mesh>);

#[pymethods]
impl Mesh {
    /// Positions `[P,3]`.
    fn positions<'py>(&self, py: Python<'py>) -> Bound<'py, PyByteArray> {
        bytes(py, &Vec::from_iter(self.0.positions.iter().flat_map(|position| position.to_array())))
    }

    /// Colours of the positions `[P,3]`; empty with a texture.
    fn colors<'py>(&self, py: Python<'py>) -> Bound<'py, PyByteArray> {
        bytes(py, &Vec::from_iter(self.0.colors.iter().flat_map(|color| color.to_array())))
    }

    /// Texture coordinates of the faces' corners `[F,3,2]`; empty without a texture.
    fn texcoords<'py>(&self, py: Python<'py>) -> Bound<'py, PyByteArray> {
        let corners = self.0.faces.iter().filter_map(|face| face.texcoords).flatten();
        bytes(py, &Vec::from_iter(corners.flat_map(|row| self.0.texcoords[row as usize].to_array())))
    }

    /// Rows of the positions `[F,3]`, u32.
    fn faces<'py>(&self, py: Python<'py>) -> Bound<'py, PyByteArray> {
        let rows = self.0.faces.iter().flat_map(|face| face.positions);
        PyByteArray::new(py, &Vec::from_iter(rows.flat_map(u32::to_ne_bytes)))
    }

    /// Width, height and pixels of the texture.
    fn texture<'py>(&self, py: Python<'py>) -> Option<(u32, u32, Bound<'py, PyByteArray>)> {
        let texture = self.0.materials.first()?.texture.as_ref()?;
        Some((texture.width(), texture.height(), PyByteArray::new(py, texture.as_raw())))
    }

    /// Writes the file and its companions, each whole or not at all.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let mesh = Arc::clone(&self.0);
        run(py, move |_| match Kind::named(&path) {
            None => Err(Failure::file(&path, "is neither .glb nor .obj or .ply")),
            Some(_) => Ok(export::write(&mesh, &path)?),
        })
    }
}

/// Makes one closed surface of Gaussians.
#[pyfunction]
#[pyo3(signature = (arrays, *, faces, texture, device))]
pub fn mesh(py: Python<'_>, arrays: Arrays, faces: usize, texture: usize, device: String) -> PyResult<Mesh> {
    let mesh = run(py, move |check| {
        if texture != 0 && !(64..=16384).contains(&texture) {
            return Err(unsuitable("texture", "must be 0, or from 64 to 16384"));
        }
        let device = snapsnap::device::choose_for_one(&device)?;
        let options = Options { faces, texture, ..Options::default() };
        Ok(fuse(&gaussians(&arrays, &device)?.into(), options, &|_| check())?.mesh)
    })?;
    Ok(Mesh(Arc::new(mesh)))
}
