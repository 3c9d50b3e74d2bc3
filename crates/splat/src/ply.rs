//! 3D Gaussian PLY files in the layout of the INRIA viewer. Written: binary little-endian, SH degree 0. Read: whatever
//! follows that layout.

pub mod header;
mod read;

use std::io::{self, Write};
use std::path::Path;

use burn::tensor::Tensor;

use crate::file::write_whole;
use crate::{Gaussians, SplatError, sh};

pub use read::{Loaded, read};

/// Properties of one vertex, in INRIA's order. No `f_rest_*`: every known viewer reads a missing band as zero, and 45
/// zero floats would triple the file (SNAPSNAP §13.3, fix 17).
pub const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];

/// Opacities are written as logits; f32 saturates to ±∞ at 0 and 1, so they are kept this far away from both.
const OPACITY_MARGIN: f32 = 1e-6;
/// Scales are written as logarithms; a scale that underflowed to 0 is written as this many metres.
const MIN_SCALE: f32 = 1e-10;

/// Writes `gaussians` to `path`, whole or not at all.
///
/// `rgb` is stored as `(rgb − ½) / `[`sh::C0`], opacity as its logit, scales as natural logarithms, quaternions as
/// (w, x, y, z).
///
/// # Errors
/// [`SplatError::NotFinite`] for a NaN or an infinity in the tensors, [`SplatError::Write`] if the disk says no; in
/// both cases `path` is left as it was.
pub fn write(gaussians: &Gaussians, path: &Path) -> Result<(), SplatError> {
    let means = rows(&gaussians.means, "means")?;
    let colors = rows(&gaussians.colors, "colors")?;
    let opacities = rows(&gaussians.opacities.clone().unsqueeze_dim::<2>(1), "opacities")?;
    let scales = rows(&gaussians.scales, "scales")?;
    let rotations = rows(&gaussians.rotations, "rotations")?;

    let vertices = (0..gaussians.len()).flat_map(|i| {
        let three = |v: &[f32]| [v[3 * i], v[3 * i + 1], v[3 * i + 2]];
        let opacity = opacities[i].clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        let logit = (opacity / (1.0 - opacity)).ln();
        let mut vertex = [0.0_f32; PROPERTIES.len()];
        vertex[0..3].copy_from_slice(&three(&means));
        vertex[6..9].copy_from_slice(&three(&colors).map(|c| (c - 0.5) / sh::C0));
        vertex[9] = logit;
        vertex[10..13].copy_from_slice(&three(&scales).map(|s| s.max(MIN_SCALE).ln()));
        vertex[13..17].copy_from_slice(&rotations[4 * i..4 * i + 4]);
        vertex
    });
    save(path, gaussians.len(), vertices)
        .map_err(|source| SplatError::Write { path: path.to_owned(), source })
}

fn save(path: &Path, count: usize, values: impl Iterator<Item = f32>) -> io::Result<()> {
    write_whole(path, |out| {
        writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}")?;
        for property in PROPERTIES {
            writeln!(out, "property float {property}")?;
        }
        writeln!(out, "end_header")?;
        for value in values {
            out.write_all(&value.to_le_bytes())?;
        }
        Ok(())
    })
}

fn rows(tensor: &Tensor<2>, field: &'static str) -> Result<Vec<f32>, SplatError> {
    let columns = tensor.dims()[1];
    let values: Vec<f32> =
        tensor.to_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line");
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => Err(SplatError::NotFinite { field, index: at / columns }),
        None => Ok(values),
    }
}
