//! Bilinear resize of planes: every input row is stretched once, every output row blends two stretched ones.

use rayon::prelude::*;

/// Where the samples of one target position are: lower index, upper index, weight of the upper.
pub type Tap = (usize, usize, f32);

/// Planes `[count, rows, columns]` → `[count, down.len(), across.len()]`.
pub fn resize(planes: &[f32], [rows, columns]: [usize; 2], down: &[Tap], across: &[Tap]) -> Vec<f32> {
    let count = planes.len() / (rows * columns);
    let mut out = vec![0.0_f32; count * down.len() * across.len()];
    out.par_chunks_mut(down.len() * across.len()).zip(planes.par_chunks(rows * columns)).for_each(
        |(out, plane)| {
            // The two stretched rows in use, and which they are.
            let mut held = [usize::MAX; 2];
            let mut stretched = [vec![0.0; across.len()], vec![0.0; across.len()]];
            for (out, &(low, high, weight)) in out.chunks_exact_mut(across.len()).zip(down) {
                for row in [low, high] {
                    // Neighbouring rows differ in parity, so they never share a slot.
                    if held[row % 2] != row {
                        held[row % 2] = row;
                        stretch(&plane[row * columns..(row + 1) * columns], across, &mut stretched[row % 2]);
                    }
                }
                let (a, b) = (&stretched[low % 2], &stretched[high % 2]);
                for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
                    *out = a + (b - a) * weight;
                }
            }
        },
    );
    out
}

fn stretch(row: &[f32], across: &[Tap], out: &mut [f32]) {
    for (out, &(low, high, weight)) in out.iter_mut().zip(across) {
        *out = row[low] + (row[high] - row[low]) * weight;
    }
}
