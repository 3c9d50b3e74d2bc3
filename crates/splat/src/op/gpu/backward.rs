//! Gradients: per tile back to front into one record per intersection, then per Gaussian through its projection.
//!
//! No float is ever added atomically: every intersection has a place of its own, and each sum runs in a fixed order.

use cubecl::prelude::*;

use super::blend::UNITS;
use super::channels;
use super::project::{REACH, SPLAT, load_quat, load_view, load3};
use crate::op::job::{Record, Wanted};
use crate::options::{MIN_ALPHA, TILE};
use crate::vjp::{FootprintGradient, project, project_vjp, to_camera};

/// Splats that a cube visits between two barriers.
const ROUND: usize = 8;
/// Units that share the sums of one splat, and pixels of each.
const SHARERS: usize = UNITS / ROUND;
const SHARE: usize = UNITS / SHARERS;

/// Fills `records` `[intersections, record.len()]` from `upstream` `[V,H,W,C]`.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn pixels(
    splats: &[f32],
    colors: &[f32],
    background: &[f32],
    entries: &[u32],
    slots: &[u32],
    starts: &[u32],
    ends: &[u32],
    transmittance: &[f32],
    last: &[u32],
    upstream: &[f32],
    records: &mut [f32],
    n: usize,
    tiles_x: usize,
    tiles: usize,
    all_tiles: usize,
    width: usize,
    height: usize,
    max_alpha: f32,
    #[comptime] depth_channel: bool,
    #[comptime] record: Record,
) {
    if CUBE_POS >= all_tiles {
        terminate!();
    }
    let len = comptime!(record.len());
    let shape = comptime!(record.geometry || record.opacities);
    let unit = UNIT_POS as usize;
    let tile = CUBE_POS % tiles;
    let left = tile % tiles_x * comptime!(TILE);
    let top = tile / tiles_x * comptime!(TILE);
    let x = left + unit % comptime!(TILE);
    let y = top + unit / comptime!(TILE);
    let px = f32::cast_from(x as u32) + 0.5;
    let py = f32::cast_from(y as u32) + 0.5;

    let mut weights = Shared::<[f32]>::new_slice(comptime!(ROUND * UNITS));
    let mut powers = Shared::<[f32]>::new_slice(comptime!(if shape { ROUND * UNITS } else { 1 }));
    let mut tints = Shared::<[f32]>::new_slice(comptime!(4 * UNITS));
    let mut sums = Shared::<[f32]>::new_slice(comptime!(len * UNITS));
    let mut furthest = Shared::<[u32]>::new_slice(comptime!(UNITS));

    let mut t = 1.0f32;
    let mut behind = 0.0f32;
    let mut taken = 0u32;
    let mut red = 0.0f32;
    let mut green = 0.0f32;
    let mut blue = 0.0f32;
    let mut opaque = 0.0f32;
    let mut deep = 0.0f32;
    if x < width && y < height {
        let pixel = (CUBE_POS / tiles * height + y) * width + x;
        let channels = comptime!(channels(depth_channel));
        t = transmittance[pixel];
        taken = last[pixel];
        red = upstream[pixel * channels];
        green = upstream[pixel * channels + 1];
        blue = upstream[pixel * channels + 2];
        opaque = upstream[pixel * channels + 3];
        if comptime!(depth_channel) {
            deep = upstream[pixel * channels + 4];
        }
        behind = t * (background[0] * red + background[1] * green + background[2] * blue);
    }
    tints[unit] = red;
    tints[comptime!(UNITS) + unit] = green;
    tints[comptime!(2 * UNITS) + unit] = blue;
    tints[comptime!(3 * UNITS) + unit] = deep;
    furthest[unit] = taken;
    sync_cube();
    // How many splats of the list any pixel took. A tree, so that all units end with the same number.
    let mut half = comptime!(UNITS / 2).runtime();
    while half > 0 {
        if unit < half {
            furthest[unit] = furthest[unit].max(furthest[unit + half]);
        }
        sync_cube();
        half /= 2;
    }
    let visited = workgroup_uniform_load(&furthest[0]) as usize;
    let start = starts[CUBE_POS] as usize;
    let end = ends[CUBE_POS] as usize;

    // Splats behind them have no gradient.
    let mut unseen = start + visited + unit;
    while unseen < end {
        for i in 0..len {
            records[slots[unseen] as usize * len + i] = 0.0f32;
        }
        unseen += comptime!(UNITS);
    }

    let mut rest = visited;
    while rest > 0 {
        // Splats rest−1, rest−2, …: one unit per pixel.
        for j in 0..comptime!(ROUND) {
            let mut weight = 0.0f32;
            let mut power = 0.0f32;
            if j < rest {
                let index = rest - 1 - j;
                if (index as u32) < taken {
                    let splat = entries[start + index] as usize;
                    let at = splat * comptime!(SPLAT);
                    let dx = px - splats[at];
                    let dy = py - splats[at + 1];
                    let p = splats[at + 2] * dx;
                    let q = splats[at + 4] * (dy + splats[at + 3] * dx);
                    let full = splats[at + 5] * ((p * p + q * q) * -0.5f32).exp();
                    let alpha = full.min(max_alpha);
                    if alpha >= comptime!(MIN_ALPHA) {
                        let inverse = 1.0 / (1.0 - alpha);
                        t *= inverse;
                        weight = alpha * t;
                        if comptime!(shape) {
                            let color = splat % n * 3;
                            let mut e = colors[color] * red
                                + colors[color + 1] * green
                                + colors[color + 2] * blue
                                + opaque;
                            if comptime!(depth_channel) {
                                e += splats[at + 6] * deep;
                            }
                            let v_alpha = t * e - behind * inverse;
                            behind += weight * e;
                            // Where α is clamped it does not depend on the splat.
                            if full < max_alpha {
                                power = v_alpha * alpha;
                            }
                        }
                    }
                }
            }
            weights[j * comptime!(UNITS) + unit] = weight;
            if comptime!(shape) {
                powers[j * comptime!(UNITS) + unit] = power;
            }
        }
        sync_cube();

        // The same splats: SHARERS units each, a share of the pixels per unit.
        let own = unit / comptime!(SHARERS);
        let sharer = unit % comptime!(SHARERS);
        let mut v_red = 0.0f32;
        let mut v_green = 0.0f32;
        let mut v_blue = 0.0f32;
        let mut v_power = 0.0f32;
        let mut r_0 = 0.0f32;
        let mut r_1 = 0.0f32;
        let mut s_00 = 0.0f32;
        let mut s_01 = 0.0f32;
        let mut s_11 = 0.0f32;
        let mut v_depth = 0.0f32;
        if own < rest {
            let at = entries[start + rest - 1 - own] as usize * comptime!(SPLAT);
            let u = splats[at];
            let v = splats[at + 1];
            let l0 = splats[at + 2];
            let k = splats[at + 3];
            let l1 = splats[at + 4];
            for i in 0..comptime!(SHARE) {
                let pixel = i * comptime!(SHARERS) + sharer;
                let weight = weights[own * comptime!(UNITS) + pixel];
                if comptime!(record.colors) {
                    v_red += weight * tints[pixel];
                    v_green += weight * tints[comptime!(UNITS) + pixel];
                    v_blue += weight * tints[comptime!(2 * UNITS) + pixel];
                }
                if comptime!(record.depth) {
                    v_depth += weight * tints[comptime!(3 * UNITS) + pixel];
                }
                if comptime!(shape) {
                    let g = powers[own * comptime!(UNITS) + pixel];
                    v_power += g;
                    if comptime!(record.geometry) {
                        let dx = f32::cast_from((left + pixel % comptime!(TILE)) as u32) + 0.5 - u;
                        let dy = f32::cast_from((top + pixel / comptime!(TILE)) as u32) + 0.5 - v;
                        let w_0 = l0 * dx;
                        let w_1 = l1 * (dy + k * dx);
                        r_0 += g * w_0;
                        r_1 += g * w_1;
                        s_00 += g * w_0 * w_0;
                        s_01 += g * w_0 * w_1;
                        s_11 += g * w_1 * w_1;
                    }
                }
            }
            if comptime!(record.opacities) {
                v_power /= splats[at + 5];
            }
        }
        if comptime!(record.colors) {
            sums[unit] = v_red;
            sums[comptime!(UNITS) + unit] = v_green;
            sums[comptime!(2 * UNITS) + unit] = v_blue;
        }
        if comptime!(record.opacities) {
            sums[comptime!(record.opacity_at() * UNITS) + unit] = v_power;
        }
        if comptime!(record.geometry) {
            let at = comptime!(record.geometry_at() * UNITS) + unit;
            sums[at] = r_0;
            sums[at + comptime!(UNITS)] = r_1;
            sums[at + comptime!(2 * UNITS)] = s_00;
            sums[at + comptime!(3 * UNITS)] = s_01;
            sums[at + comptime!(4 * UNITS)] = s_11;
        }
        if comptime!(record.depth) {
            sums[comptime!(record.depth_at() * UNITS) + unit] = v_depth;
        }
        sync_cube();

        // One unit per number of the records.
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

/// Adds up the records of each Gaussian over its tiles and views, and takes them through its projection. What is not
/// wanted has buffers of one number that are left alone.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn gather(
    means: &[f32],
    rotations: &[f32],
    scales: &[f32],
    opacities: &[f32],
    views: &[f32],
    reach: &[u32],
    records: &[f32],
    v_means: &mut [f32],
    v_rotations: &mut [f32],
    v_scales: &mut [f32],
    v_opacities: &mut [f32],
    v_colors: &mut [f32],
    n: usize,
    view_count: usize,
    blur: f32,
    #[comptime] antialiased: bool,
    #[comptime] record: Record,
    #[comptime] wanted: Wanted,
) {
    let g = ABSOLUTE_POS;
    if g >= n {
        terminate!();
    }
    let len = comptime!(record.len());
    let mut mean_x = 0.0f32;
    let mut mean_y = 0.0f32;
    let mut mean_z = 0.0f32;
    let mut rotation_w = 0.0f32;
    let mut rotation_x = 0.0f32;
    let mut rotation_y = 0.0f32;
    let mut rotation_z = 0.0f32;
    let mut scale_x = 0.0f32;
    let mut scale_y = 0.0f32;
    let mut scale_z = 0.0f32;
    let mut v_opacity = 0.0f32;
    let mut red = 0.0f32;
    let mut green = 0.0f32;
    let mut blue = 0.0f32;
    for index in 0..view_count {
        let at = (index * n + g) * comptime!(REACH);
        let count = reach[at + 1] as usize;
        if count > 0 {
            let first = reach[at + 2] as usize;
            let mut v_visible = 0.0f32;
            let mut r0 = 0.0f32;
            let mut r1 = 0.0f32;
            let mut s00 = 0.0f32;
            let mut s01 = 0.0f32;
            let mut s11 = 0.0f32;
            let mut depth = 0.0f32;
            for slot in first..first + count {
                let r = slot * len;
                if comptime!(record.colors) {
                    red += records[r];
                    green += records[r + 1];
                    blue += records[r + 2];
                }
                if comptime!(record.opacities) {
                    v_visible += records[r + comptime!(record.opacity_at())];
                }
                if comptime!(record.geometry) {
                    let r = r + comptime!(record.geometry_at());
                    r0 += records[r];
                    r1 += records[r + 1];
                    s00 += records[r + 2];
                    s01 += records[r + 3];
                    s11 += records[r + 4];
                }
                if comptime!(record.depth) {
                    depth += records[r + comptime!(record.depth_at())];
                }
            }
            if comptime!(record.geometry || antialiased) {
                let view = load_view(views, index);
                let scale = load3(scales, 3 * g);
                let t = to_camera(&view, &load3(means, 3 * g));
                let p = project(&view, &t, &load_quat(rotations, 4 * g), &scale, blur);
                let mut compensation = 0.0f32;
                if comptime!(antialiased) {
                    compensation = v_visible * opacities[g];
                    v_visible *= crate::vjp::footprint(&view, &p).compensation;
                }
                if comptime!(record.geometry) {
                    let gradient = FootprintGradient { r0, r1, s00, s01, s11, depth, compensation };
                    let r = project_vjp(&view, &p, &scale, &gradient);
                    mean_x += r.mean.x;
                    mean_y += r.mean.y;
                    mean_z += r.mean.z;
                    rotation_w += r.rotation.w;
                    rotation_x += r.rotation.x;
                    rotation_y += r.rotation.y;
                    rotation_z += r.rotation.z;
                    scale_x += r.scale.x;
                    scale_y += r.scale.y;
                    scale_z += r.scale.z;
                }
            }
            v_opacity += v_visible;
        }
    }
    if comptime!(record.colors) {
        v_colors[3 * g] = red;
        v_colors[3 * g + 1] = green;
        v_colors[3 * g + 2] = blue;
    }
    if comptime!(wanted.opacities) {
        v_opacities[g] = v_opacity;
    }
    if comptime!(wanted.means) {
        v_means[3 * g] = mean_x;
        v_means[3 * g + 1] = mean_y;
        v_means[3 * g + 2] = mean_z;
    }
    if comptime!(wanted.rotations) {
        v_rotations[4 * g] = rotation_w;
        v_rotations[4 * g + 1] = rotation_x;
        v_rotations[4 * g + 2] = rotation_y;
        v_rotations[4 * g + 3] = rotation_z;
    }
    if comptime!(wanted.scales) {
        v_scales[3 * g] = scale_x;
        v_scales[3 * g + 1] = scale_y;
        v_scales[3 * g + 2] = scale_z;
    }
}

/// ∂L/∂background of each image row: `rows` `[V·H, 3]`.
#[cube(launch)]
pub fn background_rows(
    transmittance: &[f32],
    upstream: &[f32],
    rows: &mut [f32],
    count: usize,
    width: usize,
    channels: usize,
) {
    let row = ABSOLUTE_POS;
    if row >= count {
        terminate!();
    }
    let mut red = 0.0f32;
    let mut green = 0.0f32;
    let mut blue = 0.0f32;
    for x in 0..width {
        let pixel = row * width + x;
        let t = transmittance[pixel];
        red += t * upstream[pixel * channels];
        green += t * upstream[pixel * channels + 1];
        blue += t * upstream[pixel * channels + 2];
    }
    rows[3 * row] = red;
    rows[3 * row + 1] = green;
    rows[3 * row + 2] = blue;
}

/// Sum over the rows.
#[cube(launch)]
pub fn background_sum(rows: &[f32], out: &mut [f32], count: usize) {
    if ABSOLUTE_POS < 3 {
        let mut sum = 0.0f32;
        for row in 0..count {
            sum += rows[3 * row + ABSOLUTE_POS];
        }
        out[ABSOLUTE_POS] = sum;
    }
}
