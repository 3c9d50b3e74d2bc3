//! Sixteen pixels of a row at a time, as plain loops over arrays that compile to SIMD.

use crate::options::TILE;

use super::super::splat::{Splat, offset, unclamped_alpha};
use super::splats::Visible;

/// One value per pixel of a tile's row.
pub type Lanes = [f32; TILE];

/// Pixel centres of a tile's columns, relative to the tile's first pixel.
const CENTRES: Lanes = [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5, 15.5];

/// A splat along a row of pixels.
pub struct Row {
    /// Offsets of the pixels, w₀ and w₁.
    pub w: [Lanes; 2],
    /// α before the clamp at α_max.
    pub alpha: Lanes,
}

/// The splat over a row of pixels: `left` is the row's left edge, `y` the height of its pixel centres.
#[inline(always)]
pub fn row(splat: &Splat, left: f32, y: f32) -> Row {
    let mut row = Row { w: [[0.0; TILE]; 2], alpha: [0.0; TILE] };
    for i in 0..TILE {
        let w = offset(splat, left + CENTRES[i], y);
        row.w[0][i] = w.w0;
        row.w[1][i] = w.w1;
        row.alpha[i] = unclamped_alpha(splat, &w);
    }
    row
}

/// Splats that [`fetch`] copies at once.
pub const BATCH: usize = 64;

/// Copies the splats of `entries`, which are scattered over a large array, into `batch`. Independent loads overlap,
/// so that the latency of memory counts once per batch.
#[inline(always)]
pub fn fetch(splats: &[Visible], entries: &[u32], batch: &mut [Visible; BATCH]) {
    for (slot, &entry) in batch.iter_mut().zip(entries) {
        *slot = splats[entry as usize];
    }
}

/// The rows of a tile within the splat's reach, relative to the tile's first image row `top`.
#[inline(always)]
pub fn rows(visible: &Visible, top: usize) -> std::ops::Range<usize> {
    let first = (visible.rows.first as usize).max(top) - top;
    let end = (visible.rows.end as usize).min(top + TILE) - top;
    first..end
}
