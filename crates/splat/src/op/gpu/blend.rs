//! Front-to-back compositing, one cube of 16×16 units per tile.

use cubecl::prelude::*;

use crate::linear::{Vec3, load3, store3};
use crate::op::job::channels;
use crate::op::splat::{SPLAT, Splat, Uniforms, offset, unclamped_alpha};
use crate::options::{MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Units of a cube: the pixels of a tile.
pub const UNITS: usize = TILE * TILE;

/// One list of splats per tile and view, front to back, in one buffer.
#[derive(CubeType, CubeLaunch)]
pub struct TileLists {
    /// Splat of each entry.
    pub entries: Box<[u32]>,
    /// First entry of each tile.
    pub starts: Box<[u32]>,
    /// The entry after the last of each tile.
    pub ends: Box<[u32]>,
}

/// The pixel of a unit.
#[derive(CubeType, Clone, Copy)]
pub struct Pixel {
    /// Centre, pixels.
    pub x: f32,
    pub y: f32,
    /// Whether it lies in the image.
    pub inside: bool,
    /// Number among the pixels of all views.
    pub index: usize,
}

/// The pixel of unit `unit` in the tile of this cube.
#[cube]
pub fn pixel_of_unit(unit: u32, uniforms: &Uniforms) -> Pixel {
    let tile = CUBE_POS as u32 % uniforms.tiles;
    let x = tile % uniforms.tiles_x * comptime!(TILE as u32) + unit % comptime!(TILE as u32);
    let y = tile / uniforms.tiles_x * comptime!(TILE as u32) + unit / comptime!(TILE as u32);
    let row = CUBE_POS as u32 / uniforms.tiles * uniforms.height + y;
    Pixel {
        x: f32::cast_from(x) + 0.5,
        y: f32::cast_from(y) + 0.5,
        inside: x < uniforms.width && y < uniforms.height,
        index: row as usize * uniforms.width as usize + x as usize,
    }
}

/// Writes the image `[V,H,W,C]` and, with `keep`, each pixel's final transmittance and one more than the index, in its
/// tile's list, of the last splat that the pixel took (0 for none).
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn blend(
    splats: &[f32],
    colors: &[f32],
    lists: &TileLists,
    image: &mut [f32],
    transmittance: &mut [f32],
    last: &mut [u32],
    uniforms: &Uniforms,
    #[comptime] depth: bool,
    #[comptime] keep: bool,
) {
    if CUBE_POS >= uniforms.tiles as usize * uniforms.views {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let pixel = pixel_of_unit(UNIT_POS, uniforms);
    let mut batch_splats = Shared::<[f32]>::new_slice(comptime!(UNITS * SPLAT));
    let mut batch_colors = Shared::<[f32]>::new_slice(comptime!(UNITS * 3));
    let open_pixels = Shared::<[Atomic<u32>]>::new_slice(1usize);

    let mut open = pixel.inside;
    let mut t = 1.0f32;
    let mut color = Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 };
    let mut deep = 0.0f32;
    let mut taken = 0u32;

    let start = lists.starts[CUBE_POS] as usize;
    let end = lists.ends[CUBE_POS] as usize;
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
            let entry = lists.entries[batch + unit] as usize;
            Splat::load(splats, entry).store(&mut batch_splats, unit);
            store3(&mut batch_colors, 3 * unit, &load3(colors, entry % uniforms.n * 3));
        }
        any_open = workgroup_uniform_load_atomic::<u32>(&open_pixels[0]);
        let count = (end - batch).min(comptime!(UNITS));
        let mut i = 0usize;
        while i < count && open {
            let splat = Splat::load(&batch_splats, i);
            let w = offset(&splat, pixel.x, pixel.y);
            let alpha = unclamped_alpha(&splat, &w).min(uniforms.max_alpha);
            if alpha >= comptime!(MIN_ALPHA) {
                let next = t * (1.0 - alpha);
                if next < comptime!(MIN_TRANSMITTANCE) {
                    open = false;
                } else {
                    let share = alpha * t;
                    let splat_color = load3(&batch_colors, 3 * i);
                    color.x += share * splat_color.x;
                    color.y += share * splat_color.y;
                    color.z += share * splat_color.z;
                    if comptime!(depth) {
                        deep += share * splat.depth;
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

    if pixel.inside {
        let at = pixel.index * comptime!(channels(depth));
        image[at] = color.x;
        image[at + 1] = color.y;
        image[at + 2] = color.z;
        image[at + 3] = 1.0 - t;
        if comptime!(depth) {
            image[at + 4] = deep;
        }
        if comptime!(keep) {
            transmittance[pixel.index] = t;
            last[pixel.index] = taken;
        }
    }
}
