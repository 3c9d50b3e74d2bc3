//! `.splat`: 32 bytes a Gaussian, in no container (github.com/antimatter15/splat).

use std::io::Read;

use crate::sh;
use crate::stored::{Problem, Stored, logit};

/// Bytes of a Gaussian: a centre and scales in f32, red, green, blue and opacity, and a quaternion (w, x, y, z).
const BYTES: usize = 32;

/// Reads a file of `length` bytes.
pub(crate) fn read(mut input: impl Read, length: u64) -> Result<Stored, Problem> {
    if !length.is_multiple_of(BYTES as u64) {
        return Err(format!("{length} bytes; a .splat has {BYTES} for each Gaussian").into());
    }
    let mut bytes = Vec::new();
    input.read_to_end(&mut bytes)?;
    let float =
        |at: usize, row: &[u8]| f32::from_le_bytes(row[4 * at..4 * at + 4].try_into().expect("four bytes"));
    let column = |of: &dyn Fn(&[u8]) -> f32| bytes.chunks_exact(BYTES).map(of).collect::<Vec<f32>>();
    let mut columns = Vec::new();
    columns.extend((0..3).map(|axis| column(&|row| float(axis, row))));
    columns.extend((28..32).map(|at| column(&|row| (f32::from(row[at]) - 128.0) / 128.0)));
    columns.extend((3..6).map(|axis| column(&|row| float(axis, row).ln())));
    columns.push(column(&|row| logit(f32::from(row[27]) / 255.0)));
    columns.extend((24..27).map(|at| column(&|row| (f32::from(row[at]) / 255.0 - 0.5) / sh::C0)));
    Ok(Stored { coefficients: 1, columns })
}
