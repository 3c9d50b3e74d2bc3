//! 3D Gaussian PLY files in the layout of the INRIA viewer. Binary little-endian files are written; ASCII and binary
//! files are read.

pub mod body;
pub mod header;
mod read;

use std::io::{self, Write};

use crate::stored::Stored;

pub use crate::stored::Problem;
pub(crate) use read::read;

/// Properties of one vertex of SH degree 0, in INRIA's order; higher degrees add `f_rest_*` after `f_dc_2`. Missing
/// degrees are not written: every known viewer reads them as zero, and 45 zeros would triple the file.
const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];
/// Number of properties before `f_rest_0`.
const BEFORE_REST: usize = 9;

/// Comment of files whose world has y down, as in INRIA's datasets. The reader of this crate turns the Gaussians back.
pub(crate) const Y_DOWN: &str = "axes: y down";

/// Writes a binary PLY, with a comment if there is one.
pub(crate) fn write(stored: &Stored, comment: Option<&str>, out: &mut impl Write) -> io::Result<()> {
    let rest = stored.columns.len() - Stored::COLUMNS.len();
    let of = |name: &&str| {
        let at = Stored::COLUMNS.iter().position(|column| column == name);
        // Normals have no column and are written as 0.
        ((*name).to_owned(), at.map(|at| stored.columns[at].as_slice()))
    };
    let mut properties: Vec<(String, Option<&[f32]>)> = PROPERTIES.iter().map(of).collect();
    let bands =
        (0..rest).map(|i| (format!("f_rest_{i}"), Some(&stored.columns[Stored::COLUMNS.len() + i][..])));
    properties.splice(BEFORE_REST..BEFORE_REST, bands);

    writeln!(out, "ply\nformat binary_little_endian 1.0")?;
    if let Some(comment) = comment {
        writeln!(out, "comment {comment}")?;
    }
    writeln!(out, "element vertex {}", stored.len())?;
    for (name, _) in &properties {
        writeln!(out, "property float {name}")?;
    }
    writeln!(out, "end_header")?;
    for i in 0..stored.len() {
        for (_, column) in &properties {
            out.write_all(&column.map_or(0.0, |column| column[i]).to_le_bytes())?;
        }
    }
    Ok(())
}
