//! Projection of all Gaussians into one view, culling, and depth order.

use rayon::prelude::*;

use super::super::job::Job;
use super::super::splat::{Extent, FATES, Projected, Splat, VISIBLE, splat};
use super::Scene;
use crate::linear::load3;
use crate::projection::View;

/// Gaussians per task.
const CHUNK: usize = 4096;

/// A visible Gaussian of one view. One cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Visible {
    pub splat: Splat,
    pub color: [f32; 3],
    /// Rows of pixels within reach.
    pub rows: Extent,
    /// Number of tiles within reach.
    pub tiles: u32,
    /// Row of the Gaussian in the input.
    pub gaussian: u32,
    /// √(det Σ'_raw / det Σ') with antialiasing, else 1.
    pub compensation: f32,
}

/// The visible splats of `view`, front to back, ties in input order. Adds the number of Gaussians
/// of each fate to `fates`.
pub fn visible(scene: Scene, view: &View, job: &Job, fates: &mut [u64; FATES]) -> Vec<Visible> {
    let uniforms = job.uniforms(scene.len());
    let chunks: Vec<(Vec<Visible>, [u64; FATES])> = (0..scene.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let mut splats = Vec::with_capacity(CHUNK);
            let mut fates = [0; FATES];
            for g in chunk * CHUNK..((chunk + 1) * CHUNK).min(scene.len()) {
                let color = load3(scene.colors, 3 * g);
                let Projected { splat, compensation, rows, tiles, fate } =
                    splat(view, &scene.gaussian(g), &color, &uniforms, job.options.antialiased);
                fates[fate as usize] += 1;
                if fate == VISIBLE {
                    let color = [color.x, color.y, color.z];
                    splats.push(Visible { splat, color, rows, tiles, gaussian: g as u32, compensation });
                }
            }
            (splats, fates)
        })
        .collect();
    for (_, part) in &chunks {
        fates.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
    }
    // Positive floats sort like their bits; the position in the low half keeps ties in input order.
    let mut order: Vec<u64> = Vec::with_capacity(chunks.iter().map(|(splats, _)| splats.len()).sum());
    for (chunk, (splats, _)) in chunks.iter().enumerate() {
        let position = |i: usize| (chunk * CHUNK + i) as u64;
        order.extend(
            splats.iter().enumerate().map(|(i, s)| u64::from(s.splat.depth.to_bits()) << 32 | position(i)),
        );
    }
    order.par_sort_unstable();
    let at = |key: &u64| {
        let position = (key & 0xFFFF_FFFF) as usize;
        chunks[position / CHUNK].0[position % CHUNK]
    };
    order.par_iter().map(at).collect()
}
