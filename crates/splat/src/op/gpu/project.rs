//! From Gaussians to the sorted lists of the tiles.

use cubecl::prelude::*;

use super::super::job::{MAX_MAGNITUDE, MIN_QUATERNION, RADIUS_MARGIN};
use crate::options::{MIN_ALPHA, TILE};
use crate::vjp::{Mat3, Quat, Vec3, View, footprint, project, span, to_camera};

/// f32 per splat: u, v, l₀, k, l₁, opacity after antialiasing, depth, squared radius.
pub const SPLAT: usize = 8;
/// u32 per splat: first and last tile row (`first | last << 16`), how many tiles it reaches, number of its first
/// intersection.
pub const REACH: usize = 3;
/// f32 per camera.
pub const VIEW: usize = 23;
/// Key of a culled Gaussian: behind all others.
const CULLED: u32 = 0xFFFF_FFFF;
/// No tile.
const NONE: u32 = 0xFFFF_FFFF;
/// Numbers in the statistics: visible, near, outside, transparent, degenerate, invalid, and the intersections in three
/// limbs of 10 bits and more, lowest first.
pub const STATISTICS: usize = 9;
const UNITS: usize = 256;

/// A camera in the order that [`load_view()`] reads.
pub fn view_numbers(v: &View) -> [f32; VIEW] {
    let Mat3 { r0, r1, r2 } = v.rotation;
    [
        r0.x,
        r0.y,
        r0.z,
        r1.x,
        r1.y,
        r1.z,
        r2.x,
        r2.y,
        r2.z,
        v.centre.x,
        v.centre.y,
        v.centre.z,
        v.centre_rest.x,
        v.centre_rest.y,
        v.centre_rest.z,
        v.fx,
        v.fy,
        v.cx,
        v.cy,
        v.x_min,
        v.x_max,
        v.y_min,
        v.y_max,
    ]
}

/// Three consecutive numbers.
#[cube]
pub fn load3(values: &[f32], at: usize) -> Vec3 {
    Vec3 { x: values[at], y: values[at + 1], z: values[at + 2] }
}

/// A quaternion.
#[cube]
pub fn load_quat(values: &[f32], at: usize) -> Quat {
    Quat { w: values[at], x: values[at + 1], y: values[at + 2], z: values[at + 3] }
}

/// Camera number `index`.
#[cube]
pub fn load_view(views: &[f32], index: usize) -> View {
    let at = index * comptime!(VIEW);
    View {
        rotation: Mat3 { r0: load3(views, at), r1: load3(views, at + 3), r2: load3(views, at + 6) },
        centre: load3(views, at + 9),
        centre_rest: load3(views, at + 12),
        fx: views[at + 15],
        fy: views[at + 16],
        cx: views[at + 17],
        cy: views[at + 18],
        x_min: views[at + 19],
        x_max: views[at + 20],
        y_min: views[at + 21],
        y_max: views[at + 22],
    }
}

/// Whether a number is finite and not huge; by its bits, because shader compilers may assume that no NaN exists.
#[cube]
fn in_range(v: f32) -> bool {
    v.to_bits() & 0x7FFF_FFFFu32 <= comptime!(MAX_MAGNITUDE.to_bits())
}

#[cube]
fn in_range3(v: &Vec3) -> bool {
    in_range(v.x) && in_range(v.y) && in_range(v.z)
}

/// First and last tile along one axis with a pixel centre between `low` and `high`: `first | last << 16`, or [`NONE`].
#[cube]
fn tiles_between(low: f32, high: f32, side: u32) -> u32 {
    let first = (low - 0.5).max(0.0).ceil();
    let last = (high - 0.5).min(f32::cast_from(side) - 1.0).floor();
    let mut packed = comptime!(NONE).runtime();
    if first <= last {
        let tile = comptime!(TILE as u32);
        packed = (u32::cast_from(first) / tile) | ((u32::cast_from(last) / tile) << 16u32);
    }
    packed
}

/// The region where a splat's α can reach 1/255.
#[derive(CubeType, Clone, Copy)]
struct Ellipse {
    u: f32,
    v: f32,
    l0: f32,
    k: f32,
    l1: f32,
    radius_squared: f32,
}

/// The tiles that the ellipse reaches in tile row `y`, packed as by [`tiles_between()`].
#[cube]
fn tiles_in_row(s: &Ellipse, y: u32, width: u32, height: u32) -> u32 {
    let tile = comptime!(TILE as u32);
    let top = f32::cast_from(y * tile) + 0.5 - s.v;
    let bottom = f32::cast_from((y * tile + tile - 1u32).min(height - 1u32)) + 0.5 - s.v;
    let reached = span(s.l0, s.k, s.l1, s.radius_squared, top, bottom);
    tiles_between(s.u + reached.left, s.u + reached.right, width)
}

/// Projects every Gaussian into every view: `splats` `[V·N, SPLAT]`, `reach` `[V·N, REACH]` (without the last),
/// `keys` `[V·N]` (depth, or [`CULLED`]); adds to `statistics`.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn project_all(
    means: &[f32],
    rotations: &[f32],
    scales: &[f32],
    opacities: &[f32],
    colors: &[f32],
    views: &[f32],
    splats: &mut [f32],
    reach: &mut [u32],
    keys: &mut [u32],
    statistics: &[Atomic<u32>],
    n: usize,
    total: usize,
    width: u32,
    height: u32,
    near: f32,
    blur: f32,
    #[comptime] antialiased: bool,
) {
    let mut fates = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let mut tiles = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let unit = UNIT_POS as usize;
    // Which statistic this Gaussian counts for; beyond all of them where there is none.
    let mut fate = comptime!(STATISTICS as u32).runtime();
    let mut count = 0u32;
    if ABSOLUTE_POS < total {
        let g = ABSOLUTE_POS % n;
        let view = load_view(views, ABSOLUTE_POS / n);
        let mean = load3(means, 3 * g);
        let q = load_quat(rotations, 4 * g);
        let scale = load3(scales, 3 * g);
        let opacity = opacities[g];
        let at = ABSOLUTE_POS * comptime!(SPLAT);
        let reach_at = ABSOLUTE_POS * comptime!(REACH);
        let finite = in_range3(&mean)
            && in_range(q.w)
            && in_range(q.x)
            && in_range(q.y)
            && in_range(q.z)
            && in_range3(&scale)
            && in_range(opacity)
            && in_range3(&load3(colors, 3 * g));
        fate = 5u32;
        let mut key = comptime!(CULLED).runtime();
        if finite {
            let t = to_camera(&view, &mean);
            let square = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
            fate = 4u32;
            if in_range3(&t) {
                if t.z <= near {
                    fate = 1u32;
                } else if square >= comptime!(MIN_QUATERNION) {
                    let p = project(&view, &t, &q, &scale, blur);
                    let f = footprint(&view, &p);
                    let fits = f.determinant > 0.0
                        && f.l0 > 0.0
                        && f.l1 > 0.0
                        && in_range(f.determinant)
                        && in_range(f.u)
                        && in_range(f.v)
                        && in_range(f.k)
                        && in_range(f.sigma_x)
                        && in_range(f.sigma_y)
                        && in_range(1.0 / f.l1);
                    if fits {
                        let mut visible = opacity;
                        if comptime!(antialiased) {
                            visible *= f.compensation;
                        }
                        fate = 3u32;
                        if visible >= comptime!(MIN_ALPHA) {
                            let radius_squared =
                                2.0 * (visible / comptime!(MIN_ALPHA)).ln() + comptime!(RADIUS_MARGIN);
                            splats[at] = f.u;
                            splats[at + 1] = f.v;
                            splats[at + 2] = f.l0;
                            splats[at + 3] = f.k;
                            splats[at + 4] = f.l1;
                            splats[at + 5] = visible;
                            splats[at + 6] = t.z;
                            splats[at + 7] = radius_squared;
                            let extent = radius_squared.sqrt() * f.sigma_y;
                            let rows = tiles_between(f.v - extent, f.v + extent, height);
                            fate = 2u32;
                            if rows != comptime!(NONE) {
                                reach[reach_at] = rows;
                                let ellipse =
                                    Ellipse { u: f.u, v: f.v, l0: f.l0, k: f.k, l1: f.l1, radius_squared };
                                for y in rows & 0xFFFFu32..(rows >> 16u32) + 1u32 {
                                    let row = tiles_in_row(&ellipse, y, width, height);
                                    if row != comptime!(NONE) {
                                        count += (row >> 16u32) - (row & 0xFFFFu32) + 1u32;
                                    }
                                }
                                if count > 0u32 {
                                    fate = 0u32;
                                    key = t.z.to_bits();
                                }
                            }
                        }
                    }
                }
            }
        }
        reach[reach_at + 1] = count;
        keys[ABSOLUTE_POS] = key;
    }
    fates[unit] = fate;
    tiles[unit] = count;
    sync_cube();
    if UNIT_POS < 6u32 {
        let mut same = 0u32;
        for i in 0..comptime!(UNITS) {
            if fates[i] == UNIT_POS {
                same += 1u32;
            }
        }
        if same > 0u32 {
            statistics[unit].fetch_add(same);
        }
    }
    if UNIT_POS == 6u32 {
        // At most 256 · 2²² and exact; three limbs of 10 bits keep the sum over all cubes exact too.
        let mut sum = 0u32;
        for i in 0..comptime!(UNITS) {
            sum += tiles[i];
        }
        statistics[6].fetch_add(sum & 0x3FFu32);
        statistics[7].fetch_add((sum >> 10u32) & 0x3FFu32);
        statistics[8].fetch_add(sum >> 20u32);
    }
}

/// Tile counts in depth order: `sorted[i]` is that of `order[i]`.
#[cube(launch)]
pub fn sort_counts(reach: &[u32], order: &[u32], sorted: &mut [u32], total: usize) {
    if ABSOLUTE_POS < total {
        sorted[ABSOLUTE_POS] = reach[order[ABSOLUTE_POS] as usize * comptime!(REACH) + 1];
    }
}

/// One intersection per splat and tile, splats front to back: its tile (counted over all views) and its splat.
///
/// A splat has as many places as [`project_all()`] counted. Should this kernel be compiled to round differently, it fills
/// what is left with a tile that does not exist rather than touch another splat's places.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn emit(
    splats: &[f32],
    order: &[u32],
    offsets: &[u32],
    reach: &mut [u32],
    tile_of: &mut [u32],
    splat_of: &mut [u32],
    n: usize,
    total: usize,
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles: u32,
    all_tiles: u32,
) {
    if ABSOLUTE_POS >= total {
        terminate!();
    }
    let splat = order[ABSOLUTE_POS] as usize;
    let at = splat * comptime!(REACH);
    if reach[at + 1] > 0u32 {
        let mut next = offsets[ABSOLUTE_POS];
        let end = offsets[ABSOLUTE_POS + 1];
        reach[at + 2] = next;
        let first_tile = (splat / n) as u32 * tiles;
        let rows = reach[at];
        let s = splat * comptime!(SPLAT);
        let ellipse = Ellipse {
            u: splats[s],
            v: splats[s + 1],
            l0: splats[s + 2],
            k: splats[s + 3],
            l1: splats[s + 4],
            radius_squared: splats[s + 7],
        };
        for y in rows & 0xFFFFu32..(rows >> 16u32) + 1u32 {
            let row = tiles_in_row(&ellipse, y, width, height);
            if row != comptime!(NONE) {
                for x in row & 0xFFFFu32..(row >> 16u32) + 1u32 {
                    if next < end {
                        tile_of[next as usize] = first_tile + y * tiles_x + x;
                        splat_of[next as usize] = splat as u32;
                        next += 1u32;
                    }
                }
            }
        }
        while next < end {
            tile_of[next as usize] = all_tiles;
            splat_of[next as usize] = splat as u32;
            next += 1u32;
        }
    }
}

/// From intersections sorted by tile: the splat of each, and where each tile's list starts and ends. `starts` and
/// `ends` are zero before.
#[cube(launch)]
pub fn lists(
    sorted_tiles: &[u32],
    slots: &[u32],
    splat_of: &[u32],
    entries: &mut [u32],
    starts: &mut [u32],
    ends: &mut [u32],
    intersections: usize,
) {
    let i = ABSOLUTE_POS;
    if i >= intersections {
        terminate!();
    }
    let tile = sorted_tiles[i];
    entries[i] = splat_of[slots[i] as usize];
    let mut first = true;
    if i > 0 {
        first = sorted_tiles[i - 1] != tile;
    }
    if first {
        starts[tile as usize] = i as u32;
    }
    let mut last = true;
    if i + 1 < intersections {
        last = sorted_tiles[i + 1] != tile;
    }
    if last {
        ends[tile as usize] = i as u32 + 1u32;
    }
}
