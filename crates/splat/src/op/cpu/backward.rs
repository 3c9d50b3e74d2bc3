//! Gradients of one call: per pixel back to front, then per Gaussian through the projection.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::super::gradient::{Record, SplatGradient};
use super::super::inputs::{Inputs, Upstream, Wanted};
use super::super::job::Job;
use super::lanes::{BATCH, Lanes, fetch, row, rows};
use super::splats::Visible;
use super::{Scene, State, ViewState};
use crate::linear::Vec3;
use crate::options::{MIN_ALPHA, TILE};
use crate::projection::{FootprintGradient, project, project_vjp, to_camera};

/// Gaussians per task.
const CHUNK: usize = 2048;

/// Gradients in the shapes of the inputs; `None` for unwanted ones.
pub fn backward(
    scene: Scene,
    job: &Job,
    state: &State,
    upstream: &Upstream<&[f32]>,
    wanted: Wanted,
) -> Inputs<Option<Vec<f32>>> {
    let mut gradients = scene.with(wanted, |input, wanted| wanted.then(|| vec![0.0; input.len()]));
    let record = Record::new(wanted, job);
    if record.len() == 0 {
        return gradients;
    }
    let count = job.width * job.height;
    for (index, view) in state.views.iter().enumerate() {
        let Upstream { color, alpha, depth } = *upstream;
        let upstream = Upstream {
            color: color.map(|values| &values[3 * index * count..][..3 * count]),
            alpha: alpha.map(|values| &values[index * count..][..count]),
            depth: depth.map(|values| &values[index * count..][..count]),
        };
        let records = pixels(job, view, upstream, record);
        gather(scene, job, index, view, &records, record, &mut gradients);
    }
    gradients
}

/// One record of sums over pixels for each entry of the tiles' lists, in the order of the entries.
fn pixels(job: &Job, view: &ViewState, upstream: Upstream<&[f32]>, record: Record) -> Vec<f32> {
    let mut records = vec![0.0_f32; view.lists.len() * record.len()];
    let mut rest = records.as_mut_slice();
    let mut bands = Vec::with_capacity(job.tiles_y());
    for y in 0..job.tiles_y() {
        let tiles = y * job.tiles_x()..(y + 1) * job.tiles_x();
        let entries = view.lists.starts[tiles.end] - view.lists.starts[tiles.start];
        let (records, others) = rest.split_at_mut(entries as usize * record.len());
        rest = others;
        bands.push(Band { job, view, upstream, y, records, record });
    }
    let arch = Arch::new();
    bands.into_par_iter().for_each(|band| arch.dispatch(band));
    records
}

/// One row of tiles.
struct Band<'a> {
    job: &'a Job,
    view: &'a ViewState,
    upstream: Upstream<&'a [f32]>,
    y: usize,
    records: &'a mut [f32],
    record: Record,
}

/// A tile's pixels while splats are removed from them, back to front.
struct Pixels {
    /// Transmittance in front of the splat that was visited last.
    transmittance: [Lanes; TILE],
    /// Σ α_j T_j e_j over the splats behind (see [`crate::projection`]).
    behind: [Lanes; TILE],
    last: [[u32; TILE]; TILE],
    /// ∂L/∂(red, green, blue, alpha, depth).
    upstream: [[Lanes; TILE]; 5],
}

/// Sums over the pixels of one entry, lane by lane.
struct Sums {
    color: [Lanes; 3],
    alpha: Lanes,
    /// Σ g·w.
    first: [Lanes; 2],
    /// Σ g·w·wᵀ.
    second: [Lanes; 3],
    depth: Lanes,
}

impl WithSimd for Band<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _simd: S) {
        let colors_only = !self.record.geometry && !self.record.opacities;
        for x in 0..self.job.tiles_x() {
            match (colors_only, self.job.options.depth) {
                (true, _) => self.tile::<false, false>(x),
                (false, false) => self.tile::<true, false>(x),
                (false, true) => self.tile::<true, true>(x),
            }
        }
    }
}

impl Band<'_> {
    /// Without `SHAPE`, only gradients of colours are computed.
    #[inline(always)]
    fn tile<const SHAPE: bool, const DEPTH: bool>(&mut self, x: usize) {
        let tile = self.y * self.job.tiles_x() + x;
        let list = self.view.lists.tile(tile);
        if list.is_empty() {
            return;
        }
        let mut p = self.load::<SHAPE, DEPTH>(x);
        let visited = p.last.iter().flatten().copied().max().unwrap_or(0) as usize;
        let first =
            (self.view.lists.starts[tile] - self.view.lists.starts[self.y * self.job.tiles_x()]) as usize;
        let (left, top) = ((x * TILE) as f32, self.y * TILE);
        let max_alpha = self.job.options.max_alpha;
        let mut batch = [Visible::default(); BATCH];
        for (begin, entries) in (0..visited).step_by(BATCH).zip(list[..visited].chunks(BATCH)).rev() {
            fetch(&self.view.splats, entries, &mut batch);
            for (n, splat) in (begin..begin + entries.len()).zip(&batch).rev() {
                let mut sums = Sums {
                    color: [[0.0; TILE]; 3],
                    alpha: [0.0; TILE],
                    first: [[0.0; TILE]; 2],
                    second: [[0.0; TILE]; 3],
                    depth: [0.0; TILE],
                };
                for y in rows(splat, top) {
                    take_off::<SHAPE, DEPTH>(&mut p, &mut sums, splat, n as u32, left, top, y, max_alpha);
                }
                let at = (first + n) * self.record.len();
                write(&sums, splat, self.record, &mut self.records[at..at + self.record.len()]);
            }
        }
    }

    #[inline(always)]
    fn load<const SHAPE: bool, const DEPTH: bool>(&self, x: usize) -> Pixels {
        let mut p = Pixels {
            transmittance: [[1.0; TILE]; TILE],
            behind: [[0.0; TILE]; TILE],
            last: [[0; TILE]; TILE],
            upstream: [[[0.0; TILE]; TILE]; 5],
        };
        let width = self.job.width;
        let columns = TILE.min(width - x * TILE);
        for y in 0..TILE.min(self.job.height - self.y * TILE) {
            let first = (self.y * TILE + y) * width + x * TILE;
            p.transmittance[y][..columns].copy_from_slice(&self.view.transmittance[first..first + columns]);
            p.last[y][..columns].copy_from_slice(&self.view.last[first..first + columns]);
            if let Some(color) = self.upstream.color {
                let color = &color[3 * first..3 * (first + columns)];
                for (i, v) in color.chunks_exact(3).enumerate() {
                    for c in 0..3 {
                        p.upstream[c][y][i] = v[c];
                    }
                }
            }
            if SHAPE && let Some(alpha) = self.upstream.alpha {
                p.upstream[3][y][..columns].copy_from_slice(&alpha[first..first + columns]);
            }
            if DEPTH && let Some(depth) = self.upstream.depth {
                p.upstream[4][y][..columns].copy_from_slice(&depth[first..first + columns]);
            }
        }
        p
    }
}

/// Removes the splat, number `n` of the tile, from the pixels of row `y`, and adds the row's gradients to `sums`.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inner loop, inlined into its only caller")]
fn take_off<const SHAPE: bool, const DEPTH: bool>(
    p: &mut Pixels,
    sums: &mut Sums,
    visible: &Visible,
    n: u32,
    left: f32,
    top: usize,
    y: usize,
    max_alpha: f32,
) {
    let row = row(&visible.splat, left, (top + y) as f32 + 0.5);
    let (transmittance, behind, last) = (&mut p.transmittance[y], &mut p.behind[y], &p.last[y]);
    let [red, green, blue, opaque, deep] = &p.upstream;
    let [red, green, blue, opaque, deep] = [&red[y], &green[y], &blue[y], &opaque[y], &deep[y]];
    for i in 0..TILE {
        let alpha = row.alpha[i].min(max_alpha);
        let taken = (n < last[i]) & (alpha >= MIN_ALPHA);
        let alpha = if taken { alpha } else { 0.0 };
        let inverse = 1.0 / (1.0 - alpha);
        let t = transmittance[i] * inverse;
        transmittance[i] = t;
        let weight = alpha * t;
        sums.color[0][i] += weight * red[i];
        sums.color[1][i] += weight * green[i];
        sums.color[2][i] += weight * blue[i];
        if SHAPE {
            let mut e = visible.color[0] * red[i]
                + visible.color[1] * green[i]
                + visible.color[2] * blue[i]
                + opaque[i];
            if DEPTH {
                e += visible.splat.depth * deep[i];
                sums.depth[i] += weight * deep[i];
            }
            let v_alpha = t * e - behind[i] * inverse;
            behind[i] += weight * e;
            // A clamped α does not depend on the splat.
            let g = if row.alpha[i] < max_alpha { v_alpha * alpha } else { 0.0 };
            let (w_0, w_1) = (row.w[0][i], row.w[1][i]);
            let (g_0, g_1) = (g * w_0, g * w_1);
            sums.alpha[i] += g;
            sums.first[0][i] += g_0;
            sums.first[1][i] += g_1;
            sums.second[0][i] += g_0 * w_0;
            sums.second[1][i] += g_0 * w_1;
            sums.second[2][i] += g_1 * w_1;
        }
    }
}

#[inline(always)]
fn write(sums: &Sums, visible: &Visible, record: Record, out: &mut [f32]) {
    let sum = |is_kept: bool, lanes: &Lanes| {
        if !is_kept {
            return 0.0;
        }
        // The upper half is added to the lower half until one number is left: a fixed order that compiles to SIMD.
        let mut lanes = *lanes;
        let mut width = TILE / 2;
        while width > 0 {
            for i in 0..width {
                lanes[i] += lanes[i + width];
            }
            width /= 2;
        }
        lanes[0]
    };
    let [red, green, blue] = sums.color.each_ref().map(|lanes| sum(record.colors, lanes));
    let [r0, r1] = sums.first.each_ref().map(|lanes| sum(record.geometry, lanes));
    let [s00, s01, s11] = sums.second.each_ref().map(|lanes| sum(record.geometry, lanes));
    let gradient = SplatGradient {
        color: Vec3 { x: red, y: green, z: blue },
        opacity: sum(record.opacities, &sums.alpha) / visible.splat.opacity,
        footprint: FootprintGradient { r0, r1, s00, s01, s11, depth: sum(record.depth, &sums.depth) },
    };
    gradient.store(out, 0, 1, record);
}

/// Adds up the records of each Gaussian and applies the VJP of its projection to the sums.
fn gather(
    scene: Scene,
    job: &Job,
    index: usize,
    view: &ViewState,
    records: &[f32],
    record: Record,
    gradients: &mut Inputs<Option<Vec<f32>>>,
) {
    let mut splat_of = vec![u32::MAX; scene.len()];
    for (i, splat) in view.splats.iter().enumerate() {
        splat_of[splat.gaussian as usize] = i as u32;
    }
    let widths = Inputs { means: 3, rotations: 4, scales: 3, opacities: 1, colors: 3 };
    // No chunk for an unwanted gradient.
    let mut chunks = gradients.as_mut().with(widths, |gradient, width| {
        gradient.as_deref_mut().unwrap_or_default().chunks_mut(width * CHUNK)
    });
    let tasks: Vec<_> = splat_of
        .chunks(CHUNK)
        .map(|splats| (splats, chunks.as_mut().map(|chunks| chunks.next().unwrap_or_default())))
        .collect();
    let camera = &job.views[index];
    tasks.into_par_iter().for_each(|(splats, out)| {
        for (i, &at) in splats.iter().enumerate() {
            if at == u32::MAX {
                continue;
            }
            let splat = &view.splats[at as usize];
            let places = view.lists.first_place[at as usize] as usize
                ..view.lists.first_place[at as usize + 1] as usize;
            let mut sums = SplatGradient::zero();
            for &place in &view.lists.places[places] {
                sums.add(records, place as usize * record.len(), record);
            }
            add(out.colors, i, [sums.color.x, sums.color.y, sums.color.z]);
            add(out.opacities, i, [sums.opacity * splat.compensation]);
            if record.geometry {
                let gaussian = scene.gaussian(splat.gaussian as usize);
                let v_compensation =
                    if job.options.antialiased { sums.opacity * gaussian.opacity } else { 0.0 };
                let t = to_camera(camera, &gaussian.mean);
                let p = project(camera, &t, &gaussian.rotation, &gaussian.scale, job.options.blur);
                let v = project_vjp(camera, &p, &gaussian.scale, &sums.footprint, v_compensation);
                add(out.means, i, [v.mean.x, v.mean.y, v.mean.z]);
                add(out.rotations, i, [v.rotation.w, v.rotation.x, v.rotation.y, v.rotation.z]);
                add(out.scales, i, [v.scale.x, v.scale.y, v.scale.z]);
            }
        }
    });
}

/// Adds `values` to row `row`, if the gradient is wanted.
fn add<const N: usize>(out: &mut [f32], row: usize, values: [f32; N]) {
    if !out.is_empty() {
        out[N * row..N * (row + 1)].iter_mut().zip(values).for_each(|(o, v)| *o += v);
    }
}
