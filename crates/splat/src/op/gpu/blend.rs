//! Front-to-back compositing, one cube of 16×16 units per tile.

use cubecl::prelude::*;

use super::channels;
use super::project::SPLAT;
use crate::options::{MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Units of a cube: the pixels of a tile.
pub const UNITS: usize = TILE * TILE;

/// Image `[V,H,W,C]` and, where `keep`, each pixel's final transmittance and one more than the index of the last splat
/// that it took in its tile's list (0 for none).
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn blend(
    splats: &[f32],
    colors: &[f32],
    background: &[f32],
    entries: &[u32],
    starts: &[u32],
    ends: &[u32],
    image: &mut [f32],
    transmittance: &mut [f32],
    last: &mut [u32],
    n: usize,
    tiles_x: usize,
    tiles: usize,
    all_tiles: usize,
    width: usize,
    height: usize,
    max_alpha: f32,
    #[comptime] depth: bool,
    #[comptime] keep: bool,
) {
    if CUBE_POS >= all_tiles {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let tile = CUBE_POS % tiles;
    let x = tile % tiles_x * comptime!(TILE) + unit % comptime!(TILE);
    let y = tile / tiles_x * comptime!(TILE) + unit / comptime!(TILE);
    let px = f32::cast_from(x as u32) + 0.5;
    let py = f32::cast_from(y as u32) + 0.5;
    let inside = x < width && y < height;

    let mut shapes = Shared::<[f32]>::new_slice(comptime!(UNITS * SPLAT));
    let mut tints = Shared::<[f32]>::new_slice(comptime!(UNITS * 3));
    let open_pixels = Shared::<[Atomic<u32>]>::new_slice(1usize);

    let mut open = inside;
    let mut t = 1.0f32;
    let mut red = 0.0f32;
    let mut green = 0.0f32;
    let mut blue = 0.0f32;
    let mut deep = 0.0f32;
    let mut taken = 0u32;

    let start = starts[CUBE_POS] as usize;
    let end = ends[CUBE_POS] as usize;
    let mut batch = start;
    let mut any_open = 1u32;
    while batch < end && any_open > 0u32 {
        if unit == 0 {
            open_pixels[0].store(0u32);
        }
        sync_cube();
        if open {
            open_pixels[0].store(1u32);
        }
        if batch + unit < end {
            let splat = entries[batch + unit] as usize;
            for i in 0..comptime!(SPLAT) {
                shapes[unit * comptime!(SPLAT) + i] = splats[splat * comptime!(SPLAT) + i];
            }
            for i in 0..3usize {
                tints[unit * 3 + i] = colors[splat % n * 3 + i];
            }
        }
        any_open = workgroup_uniform_load_atomic::<u32>(&open_pixels[0]);
        let count = (end - batch).min(comptime!(UNITS));
        let mut i = 0usize;
        while i < count && open {
            let at = i * comptime!(SPLAT);
            let dx = px - shapes[at];
            let dy = py - shapes[at + 1];
            let p = shapes[at + 2] * dx;
            let q = shapes[at + 4] * (dy + shapes[at + 3] * dx);
            let alpha = (shapes[at + 5] * ((p * p + q * q) * -0.5f32).exp()).min(max_alpha);
            if alpha >= comptime!(MIN_ALPHA) {
                let next = t * (1.0 - alpha);
                if next < comptime!(MIN_TRANSMITTANCE) {
                    open = false;
                } else {
                    let weight = alpha * t;
                    red += weight * tints[i * 3];
                    green += weight * tints[i * 3 + 1];
                    blue += weight * tints[i * 3 + 2];
                    if comptime!(depth) {
                        deep += weight * shapes[at + 6];
                    }
                    t = next;
                    taken = (batch - start + i) as u32 + 1u32;
                }
            }
            i += 1;
        }
        sync_cube();
        batch += comptime!(UNITS);
    }

    if inside {
        let pixel = (CUBE_POS / tiles * height + y) * width + x;
        let channels = comptime!(channels(depth));
        image[pixel * channels] = red + t * background[0];
        image[pixel * channels + 1] = green + t * background[1];
        image[pixel * channels + 2] = blue + t * background[2];
        image[pixel * channels + 3] = 1.0 - t;
        if comptime!(depth) {
            image[pixel * channels + 4] = deep;
        }
        if comptime!(keep) {
            transmittance[pixel] = t;
            last[pixel] = taken;
        }
    }
}
