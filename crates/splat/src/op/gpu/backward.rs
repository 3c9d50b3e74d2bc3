//! Gradients: per tile back to front into one record per intersection, then per Gaussian through its projection.
//!
//! No float is ever added atomically: every intersection has a place of its own, and each sum runs in a fixed order.
//!
//! An *intersection* is a pair of a splat and a tile that it reaches; its *slot* is its number, in the order in which
//! `emit` writes them. An *entry* is a place in the depth-sorted lists of the tiles. A *record* has the sums of one
//! intersection over the tile's pixels. [`pixels()`] proceeds in rounds of [`ROUND`] splats, the farthest first, in
//! three steps: each unit computes the terms of its pixel for all splats of the round; [`SHARERS`] units per splat
//! add up [`SHARE`] pixels each; one unit per number of a record adds up these partial sums.

use cubecl::CubeTypeMut;
use cubecl::prelude::*;

use super::blend::{Pixel, TileLists, UNITS, pixel_of_unit};
use super::project::{Parameters, Reach, load_view};
use crate::linear::{Quat, Vec3, add3, dot, load3, store3};
use crate::op::gradient::{Record, SplatGradient};
use crate::op::inputs::Wanted;
use crate::op::job::channels;
use crate::op::splat::{Splat, Uniforms, offset, unclamped_alpha};
use crate::options::MIN_ALPHA;
use crate::projection::{GaussianGradient, footprint, project, project_vjp, to_camera};

/// Splats that a cube visits between two barriers.
const ROUND: usize = 8;
/// Units that sum the gradients of one splat together.
const SHARERS: usize = UNITS / ROUND;
/// Pixels that each of these units sums.
const SHARE: usize = UNITS / SHARERS;

/// ∂L/∂ of the outputs at a pixel.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
struct Upstream {
    color: Vec3,
    alpha: f32,
    depth: f32,
}

/// A pixel between two splats, while they are visited back to front.
#[derive(CubeType, Clone, Copy)]
struct BackToFront {
    /// Transmittance in front of the splat that was visited last.
    transmittance: f32,
    /// Σ α_j T_j e_j over the splats behind (see [`crate::projection`]).
    sum: f32,
}

/// Terms of one splat at one pixel.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
struct PixelTerms {
    /// α·T.
    blend_weight: f32,
    /// g = (∂L/∂α)·α, the gradient of the power −½|w|²; zero where α is clamped.
    v_power: f32,
}

#[cube]
impl BackToFront {
    /// Visits the next splat towards the camera. `e` is e_j in [`crate::projection`].
    fn step_past(&mut self, unclamped_alpha: f32, e: f32, max_alpha: f32) -> PixelTerms {
        let alpha = unclamped_alpha.min(max_alpha);
        let inverse = 1.0 / (1.0 - alpha);
        self.transmittance *= inverse;
        let blend_weight = alpha * self.transmittance;
        let v_alpha = self.transmittance * e - self.sum * inverse;
        self.sum += blend_weight * e;
        // A clamped α does not depend on the splat.
        PixelTerms { blend_weight, v_power: select(unclamped_alpha < max_alpha, v_alpha * alpha, 0.0f32) }
    }
}

/// Fills `records` `[intersections, record.len()]` from `upstream` `[V,H,W,C]`. `splats` `[V·N,8]`, `colors` `[N,3]`,
/// `slots` has the slot of each entry; `transmittance` `[V·H·W]` is behind all splats;
/// `list_ends` `[V·H·W]` is one more than the place, in the tile's list, of the last splat that a pixel blended.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn pixels(
    splats: &[f32],
    colors: &[f32],
    lists: &TileLists,
    slots: &[u32],
    transmittance: &[f32],
    list_ends: &[u32],
    upstream: &[f32],
    records: &mut [f32],
    uniforms: &Uniforms,
    #[comptime] depth: bool,
    #[comptime] record: Record,
) {
    if CUBE_POS >= uniforms.tiles as usize * uniforms.views {
        terminate!();
    }
    let shape = comptime!(record.geometry || record.opacities);
    let unit = UNIT_POS as usize;
    let pixel = pixel_of_unit(UNIT_POS, uniforms);
    // Per splat of a round and pixel: its terms. Per pixel: upstream colour and depth. Per splat and sharer: sums.
    let mut blend_weights = Shared::<[f32]>::new_slice(comptime!(ROUND * UNITS));
    let mut v_powers = Shared::<[f32]>::new_slice(comptime!(if shape { ROUND * UNITS } else { 1 }));
    let mut upstreams = Shared::<[f32]>::new_slice(comptime!(4 * UNITS));
    let mut sums = Shared::<[f32]>::new_slice(comptime!(record.len() * UNITS));

    let mut visit = BackToFront { transmittance: 1.0f32, sum: 0.0f32 };
    let mut list_end = 0u32;
    let mut own = Upstream { color: Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 }, alpha: 0.0f32, depth: 0.0f32 };
    if pixel.inside {
        own = load_upstream(upstream, &pixel, depth);
        list_end = list_ends[pixel.index];
        visit.transmittance = transmittance[pixel.index];
    }
    upstreams[unit] = own.color.x;
    upstreams[comptime!(UNITS) + unit] = own.color.y;
    upstreams[comptime!(2 * UNITS) + unit] = own.color.z;
    upstreams[comptime!(3 * UNITS) + unit] = own.depth;
    let visited = largest(list_end) as usize;
    let start = lists.starts[CUBE_POS] as usize;
    clear(records, slots, start + visited, lists.ends[CUBE_POS] as usize, record);

    let mut rest = visited;
    while rest > 0 {
        // Step 1: splats rest−1, rest−2, … at the pixel of each unit.
        for j in 0..comptime!(ROUND) {
            let mut terms = PixelTerms { blend_weight: 0.0f32, v_power: 0.0f32 };
            if j < rest {
                let index = rest - 1 - j;
                if (index as u32) < list_end {
                    let entry = lists.entries[start + index] as usize;
                    let splat = Splat::load(splats, entry);
                    let w = offset(&splat, pixel.x, pixel.y);
                    let alpha = unclamped_alpha(&splat, &w);
                    if alpha.min(uniforms.max_alpha) >= comptime!(MIN_ALPHA) {
                        let mut e = 0.0f32;
                        if comptime!(shape) {
                            let color = load3(colors, entry % uniforms.n * 3);
                            e = dot(&color, &own.color) + own.alpha;
                            if comptime!(depth) {
                                e += splat.depth * own.depth;
                            }
                        }
                        terms = visit.step_past(alpha, e, uniforms.max_alpha);
                    }
                }
            }
            blend_weights[j * comptime!(UNITS) + unit] = terms.blend_weight;
            if comptime!(shape) {
                v_powers[j * comptime!(UNITS) + unit] = terms.v_power;
            }
        }
        sync_cube();

        // Step 2: SHARERS units for each splat of the round, SHARE pixels for each unit.
        let in_round = unit / comptime!(SHARERS);
        let mut gradient = SplatGradient::zero();
        if in_round < rest {
            let splat = Splat::load(splats, lists.entries[start + rest - 1 - in_round] as usize);
            let first = in_round * comptime!(UNITS);
            for i in 0..comptime!(SHARE) {
                let at = i * comptime!(SHARERS) + unit % comptime!(SHARERS);
                let blend_weight = blend_weights[first + at];
                if comptime!(record.colors) {
                    gradient.color.x += blend_weight * upstreams[at];
                    gradient.color.y += blend_weight * upstreams[comptime!(UNITS) + at];
                    gradient.color.z += blend_weight * upstreams[comptime!(2 * UNITS) + at];
                }
                if comptime!(record.depth) {
                    gradient.footprint.depth += blend_weight * upstreams[comptime!(3 * UNITS) + at];
                }
                if comptime!(shape) {
                    let v_power = v_powers[first + at];
                    if comptime!(record.opacities) {
                        gradient.opacity += v_power;
                    }
                    // The sums r and S (see `crate::projection`).
                    if comptime!(record.geometry) {
                        let other = pixel_of_unit(at as u32, uniforms);
                        let w = offset(&splat, other.x, other.y);
                        let g_0 = v_power * w.w0;
                        let g_1 = v_power * w.w1;
                        gradient.footprint.r0 += g_0;
                        gradient.footprint.r1 += g_1;
                        gradient.footprint.s00 += g_0 * w.w0;
                        gradient.footprint.s01 += g_0 * w.w1;
                        gradient.footprint.s11 += g_1 * w.w1;
                    }
                }
            }
            gradient.opacity /= splat.opacity;
        }
        gradient.store(&mut sums, unit, UNITS, record);
        sync_cube();

        // Step 3: one unit per number of the records.
        let len = comptime!(record.len());
        if unit < comptime!(ROUND * record.len()) {
            let splat = unit / len;
            let number = unit % len;
            if splat < rest {
                let mut sum = 0.0f32;
                for i in 0..comptime!(SHARERS) {
                    sum += sums[number * comptime!(UNITS) + splat * comptime!(SHARERS) + i];
                }
                records[slots[start + rest - 1 - splat] as usize * len + number] = sum;
            }
        }
        rest -= rest.min(comptime!(ROUND));
    }
}

#[cube]
fn load_upstream(upstream: &[f32], pixel: &Pixel, #[comptime] has_depth: bool) -> Upstream {
    let at = pixel.index * comptime!(channels(has_depth));
    let mut depth = 0.0f32;
    if comptime!(has_depth) {
        depth = upstream[at + 4];
    }
    Upstream { color: load3(upstream, at), alpha: upstream[at + 3], depth }
}

/// The largest value of all units, by a tree reduction; every unit gets the same number. All units have passed a
/// barrier afterwards.
#[cube]
fn largest(value: u32) -> u32 {
    let mut values = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let unit = UNIT_POS as usize;
    values[unit] = value;
    sync_cube();
    let mut half = comptime!(UNITS / 2).runtime();
    while half > 0 {
        if unit < half {
            values[unit] = values[unit].max(values[unit + half]);
        }
        sync_cube();
        half /= 2;
    }
    workgroup_uniform_load(&values[0])
}

/// Zeroes the records of the entries from `first` to `end` − 1, which no pixel blended.
#[cube]
fn clear(records: &mut [f32], slots: &[u32], first: usize, end: usize, #[comptime] record: Record) {
    let len = comptime!(record.len());
    let mut entry = first + UNIT_POS as usize;
    while entry < end {
        for i in 0..len {
            records[slots[entry] as usize * len + i] = 0.0f32;
        }
        entry += comptime!(UNITS);
    }
}

/// Adds up the records of each Gaussian over its tiles and views, and applies the VJP of its projection. Buffers of
/// unwanted gradients have one number, which is not written.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn gather(
    parameters: &Parameters,
    views: &[f32],
    reach: &[u32],
    records: &[f32],
    v_means: &mut [f32],
    v_rotations: &mut [f32],
    v_scales: &mut [f32],
    v_opacities: &mut [f32],
    v_colors: &mut [f32],
    uniforms: &Uniforms,
    #[comptime] antialiased: bool,
    #[comptime] record: Record,
    #[comptime] wanted: Wanted,
) {
    let g = ABSOLUTE_POS;
    if g >= uniforms.n {
        terminate!();
    }
    let gaussian = parameters.load(g);
    let mut v_color = Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 };
    let mut v_opacity = 0.0f32;
    let mut total = GaussianGradient {
        mean: Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 },
        rotation: Quat { w: 0.0f32, x: 0.0f32, y: 0.0f32, z: 0.0f32 },
        scale: Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 },
    };
    for index in 0..uniforms.views {
        let reach = Reach::load(reach, index * uniforms.n + g);
        if reach.tiles > 0u32 {
            let mut sums = SplatGradient::zero();
            for slot in reach.first..reach.first + reach.tiles {
                sums.add(records, slot as usize * comptime!(record.len()), record);
            }
            add3(&mut v_color, &sums.color);
            let mut v_opacity_here = sums.opacity;
            if comptime!(record.geometry || antialiased) {
                let view = load_view(views, index);
                let t = to_camera(&view, &gaussian.mean);
                let p = project(&view, &t, &gaussian.rotation, &gaussian.scale, uniforms.blur);
                let mut v_compensation = 0.0f32;
                if comptime!(antialiased) {
                    v_compensation = v_opacity_here * gaussian.opacity;
                    v_opacity_here *= footprint(&view, &p).compensation;
                }
                if comptime!(record.geometry) {
                    let v = project_vjp(&view, &p, &gaussian.scale, &sums.footprint, v_compensation);
                    add3(&mut total.mean, &v.mean);
                    total.rotation.w += v.rotation.w;
                    total.rotation.x += v.rotation.x;
                    total.rotation.y += v.rotation.y;
                    total.rotation.z += v.rotation.z;
                    add3(&mut total.scale, &v.scale);
                }
            }
            v_opacity += v_opacity_here;
        }
    }
    // A record may have the opacity only because the geometry's gradient needs it.
    if comptime!(wanted.colors) {
        store3(v_colors, 3 * g, &v_color);
    }
    if comptime!(wanted.opacities) {
        v_opacities[g] = v_opacity;
    }
    if comptime!(wanted.means) {
        store3(v_means, 3 * g, &total.mean);
    }
    if comptime!(wanted.rotations) {
        v_rotations[4 * g] = total.rotation.w;
        v_rotations[4 * g + 1] = total.rotation.x;
        v_rotations[4 * g + 2] = total.rotation.y;
        v_rotations[4 * g + 3] = total.rotation.z;
    }
    if comptime!(wanted.scales) {
        store3(v_scales, 3 * g, &total.scale);
    }
}
