//! Projection of all Gaussians into one view, culling, and depth order.

use std::ops::RangeInclusive;

use rayon::prelude::*;

use super::super::job::{Counts, Job, MAX_MAGNITUDE, MIN_QUATERNION, RADIUS_MARGIN};
use super::Scene;
use crate::options::{MIN_ALPHA, TILE};
use crate::vjp::{Projection, Quat, Vec3, View, footprint, project, span, to_camera};

/// Gaussians per task.
const CHUNK: usize = 4096;

/// A visible Gaussian as the tiles and pixels of one view see it. One cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Centre, pixels.
    pub u: f32,
    pub v: f32,
    /// Factors of Σ'⁻¹ (see [`crate::vjp`]).
    pub l0: f32,
    pub k: f32,
    pub l1: f32,
    /// Opacity after antialiasing.
    pub opacity: f32,
    pub color: [f32; 3],
    /// t_z, metres.
    pub depth: f32,
    /// Squared radius, in standard deviations, beyond which α < 1/255.
    pub radius_squared: f32,
    /// First and last pixel row within reach.
    pub rows: [u16; 2],
    /// How many tiles it reaches.
    pub tiles: u32,
    /// Row of the Gaussian in the input.
    pub gaussian: u32,
    /// √(det Σ'_raw / det Σ') with antialiasing, else 1.
    pub compensation: f32,
}

impl Splat {
    /// The rows of tiles that it reaches.
    #[inline]
    pub fn tile_rows(&self) -> RangeInclusive<usize> {
        usize::from(self.rows[0]) / TILE..=usize::from(self.rows[1]) / TILE
    }

    /// The tiles of one row that it reaches: first and last, over the columns of pixel centres that its ellipse holds
    /// within that row.
    #[inline]
    pub fn tiles_in_row(&self, y: usize, job: &Job) -> Option<RangeInclusive<usize>> {
        let first = (y * TILE) as f32 + 0.5 - self.v;
        let last = (y * TILE + TILE - 1).min(job.height - 1) as f32 + 0.5 - self.v;
        let span = span(self.l0, self.k, self.l1, self.radius_squared, first, last);
        let left = (self.u + span.left - 0.5).max(0.0).ceil();
        let right = (self.u + span.right - 0.5).min((job.width - 1) as f32).floor();
        (left <= right).then_some(left as usize / TILE..=right as usize / TILE)
    }

    fn count_tiles(&self, job: &Job) -> u32 {
        let rows = self.tile_rows().filter_map(|y| self.tiles_in_row(y, job));
        rows.map(|tiles| (tiles.end() - tiles.start() + 1) as u32).sum()
    }
}

enum Cull {
    Near,
    Outside,
    Transparent,
    Degenerate,
    Invalid,
}

/// The visible splats of `view`, front to back, ties in input order. Adds what was culled to `counts`.
pub fn visible(scene: Scene, view: &View, job: &Job, counts: &mut Counts) -> Vec<Splat> {
    let chunks: Vec<(Vec<Splat>, Counts)> = (0..scene.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let mut splats = Vec::with_capacity(CHUNK);
            let mut counts = Counts::default();
            for g in chunk * CHUNK..((chunk + 1) * CHUNK).min(scene.len()) {
                match splat(scene, g, view, job) {
                    Ok(splat) => splats.push(splat),
                    Err(Cull::Near) => counts.near += 1,
                    Err(Cull::Outside) => counts.outside += 1,
                    Err(Cull::Transparent) => counts.transparent += 1,
                    Err(Cull::Degenerate) => counts.degenerate += 1,
                    Err(Cull::Invalid) => counts.invalid += 1,
                }
            }
            (splats, counts)
        })
        .collect();
    for (splats, c) in &chunks {
        counts.visible += splats.len() as u64;
        counts.near += c.near;
        counts.outside += c.outside;
        counts.transparent += c.transparent;
        counts.degenerate += c.degenerate;
        counts.invalid += c.invalid;
    }
    // Positive floats order like their bits; the position in the low half keeps ties in input order.
    let mut order: Vec<u64> = Vec::with_capacity(chunks.iter().map(|(splats, _)| splats.len()).sum());
    for (chunk, (splats, _)) in chunks.iter().enumerate() {
        let position = |i: usize| (chunk * CHUNK + i) as u64;
        order
            .extend(splats.iter().enumerate().map(|(i, s)| u64::from(s.depth.to_bits()) << 32 | position(i)));
    }
    order.par_sort_unstable();
    let at = |key: &u64| {
        let position = (key & 0xFFFF_FFFF) as usize;
        chunks[position / CHUNK].0[position % CHUNK]
    };
    order.par_iter().map(at).collect()
}

fn three(values: &[f32], g: usize) -> [f32; 3] {
    [values[3 * g], values[3 * g + 1], values[3 * g + 2]]
}

fn vec3([x, y, z]: [f32; 3]) -> Vec3 {
    Vec3 { x, y, z }
}

/// Mean, rotation and scale of Gaussian `g`.
pub fn parameters(scene: &Scene, g: usize) -> (Vec3, Quat, Vec3) {
    let q = &scene.rotations[4 * g..4 * g + 4];
    let rotation = Quat { w: q[0], x: q[1], y: q[2], z: q[3] };
    (vec3(three(scene.means, g)), rotation, vec3(three(scene.scales, g)))
}

/// Projection of Gaussian `g`, which [`visible`] accepted.
pub fn projection(scene: &Scene, g: usize, view: &View, job: &Job) -> Projection {
    let (mean, rotation, scale) = parameters(scene, g);
    project(view, &to_camera(view, &mean), &rotation, &scale, job.blur)
}

fn splat(scene: Scene, g: usize, view: &View, job: &Job) -> Result<Splat, Cull> {
    let (mean, q, scale) = parameters(&scene, g);
    let color = three(scene.colors, g);
    let opacity = scene.opacities[g];
    let in_range = |v: f32| v.abs() <= MAX_MAGNITUDE;
    let numbers = [mean.x, mean.y, mean.z, q.w, q.x, q.y, q.z, scale.x, scale.y, scale.z, opacity];
    if !(numbers.iter().all(|&v| in_range(v)) && color.iter().all(|&v| in_range(v))) {
        return Err(Cull::Invalid);
    }
    let t = to_camera(view, &mean);
    if !(in_range(t.x) && in_range(t.y) && in_range(t.z)) {
        return Err(Cull::Degenerate);
    }
    if t.z <= job.near {
        return Err(Cull::Near);
    }
    if q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z < MIN_QUATERNION {
        return Err(Cull::Degenerate);
    }
    let p = project(view, &t, &q, &scale, job.blur);
    let f = footprint(view, &p);
    let sizes = [f.u, f.v, f.k, f.sigma_x, f.sigma_y, 1.0 / f.l1];
    if !(f.determinant > 0.0 && f.l0 > 0.0 && f.l1 > 0.0 && sizes.iter().all(|&v| in_range(v))) {
        return Err(Cull::Degenerate);
    }
    let compensation = if job.antialiased { f.compensation } else { 1.0 };
    let opacity = opacity * compensation;
    if opacity < MIN_ALPHA {
        return Err(Cull::Transparent);
    }
    let radius_squared = 2.0 * (opacity / MIN_ALPHA).ln() + RADIUS_MARGIN;
    let radius = radius_squared.sqrt();
    let rows = reach(f.v, radius * f.sigma_y, job.height).ok_or(Cull::Outside)?;
    let mut splat = Splat {
        u: f.u,
        v: f.v,
        l0: f.l0,
        k: f.k,
        l1: f.l1,
        opacity,
        color,
        depth: t.z,
        radius_squared,
        rows,
        tiles: 0,
        gaussian: g as u32,
        compensation,
    };
    splat.tiles = splat.count_tiles(job);
    if splat.tiles > 0 { Ok(splat) } else { Err(Cull::Outside) }
}

/// First and last pixel whose centre lies within `extent` of `centre`, in an image of `side` pixels.
fn reach(centre: f32, extent: f32, side: usize) -> Option<[u16; 2]> {
    let first = (centre - extent - 0.5).max(0.0).ceil();
    let last = (centre + extent - 0.5).min((side - 1) as f32).floor();
    (first <= last).then_some([first as u16, last as u16])
}
