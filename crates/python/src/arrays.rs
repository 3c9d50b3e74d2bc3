//! Gaussians as the bytes of five arrays, their files, and cameras as JSON.

use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyByteArray;
use snapsnap::Failure;
use snapsnap_ops::host;
use snapsnap_splat::scene::{Kind, Stored};
use snapsnap_splat::{Camera, Gaussians, camera_file};

use crate::work::{run, unsuitable};

/// Means, rotations, scales, opacities and colours of f32 in the machine's order.
pub type Arrays = [PyBackedBytes; 5];
/// The same arrays on their way to Python.
pub type Made<'py> = [Bound<'py, PyByteArray>; 5];

/// The numbers in an array's bytes.
pub fn floats(bytes: &[u8]) -> Vec<f32> {
    let number = |bytes: &[u8]| f32::from_ne_bytes(bytes.try_into().expect("four bytes"));
    bytes.chunks_exact(4).map(number).collect()
}

/// An array's bytes.
pub fn bytes<'py>(py: Python<'py>, values: &[f32]) -> Bound<'py, PyByteArray> {
    let raw: Vec<u8> = values.iter().flat_map(|value| value.to_ne_bytes()).collect();
    PyByteArray::new(py, &raw)
}

/// A tensor of an array's bytes with `columns` columns.
pub fn tensor(bytes: &[u8], columns: usize, device: &Device) -> Tensor<2> {
    let values = floats(bytes);
    let rows = values.len() / columns;
    Tensor::from_data(TensorData::new(values, [rows, columns]), device)
}

/// The Gaussians of five arrays.
pub fn gaussians(arrays: &Arrays, device: &Device) -> Result<Gaussians, Failure> {
    let [means, rotations, scales, opacities, colors] = arrays;
    let of = |bytes: &PyBackedBytes, columns| tensor(bytes, columns, device);
    let opacities = of(opacities, 1).squeeze_dim(1);
    Ok(Gaussians::new(of(means, 3), of(rotations, 4), of(scales, 3), opacities, of(colors, 3))?)
}

/// The numbers of a set of Gaussians, in the order of [`Arrays`].
pub fn numbers(gaussians: &Gaussians) -> [Vec<f32>; 5] {
    let Gaussians { means, rotations, scales, opacities, colors } = gaussians.clone();
    [host(means), host(rotations), host(scales), host(opacities), host(colors)]
}

/// The Gaussians of a file, and its SH degree.
#[pyfunction]
pub fn read(py: Python<'_>, path: PathBuf) -> PyResult<(Made<'_>, usize)> {
    let (arrays, degree) = run(py, move |_| {
        let (stored, _) = snapsnap::drawable(&path)?;
        Ok((numbers(&stored.load(&Device::flex()).gaussians), stored.degree()))
    })?;
    Ok((arrays.map(|values| bytes(py, &values)), degree))
}

/// Writes a file of Gaussians, whole or not at all.
#[pyfunction]
pub fn write(py: Python<'_>, path: PathBuf, arrays: Arrays, y_down: bool) -> PyResult<()> {
    run(py, move |_| {
        let Some(kind) = Kind::named(&path) else {
            return Err(Failure::file(&path, "is neither .ply nor .spz, .glb or .sog"));
        };
        if y_down && kind != Kind::Ply {
            return Err(unsuitable("y_down", "is for PLYs: viewers know the axes of other files"));
        }
        let stored = Stored::of(&gaussians(&arrays, &Device::flex())?)?;
        Ok(stored.write(if y_down { Kind::YDown } else { kind }, &path)?)
    })
}

/// The cameras of a render's argument: JSON of a list, or the path of a file.
pub fn cameras(text: Option<&str>, path: Option<&Path>) -> Result<Vec<Camera>, Failure> {
    Ok(match (text, path) {
        (_, Some(path)) => camera_file::read_any(path, None),
        (text, None) => camera_file::parse(Path::new("cameras"), text.unwrap_or_default()),
    }?)
}

/// Cameras around a standing person, as JSON.
#[pyfunction]
pub fn orbit(views: usize, width: u32, height: u32) -> String {
    camera_file::to_json(&Camera::orbit(views, width, height))
}
