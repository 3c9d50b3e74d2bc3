//! From Gaussians to the sorted lists of the tiles.

use cubecl::prelude::*;

use crate::linear::{Mat3, load3};
use crate::op::splat::{
    Extent, FATES, Gaussian, Splat, Uniforms, VISIBLE, gaussian, splat, tiles_in_row, tiles_of,
};
use crate::projection::View;

/// f32 of a camera in a buffer.
const VIEW: usize = size_of::<View>() / 4;
/// u32 of a splat's [`Reach`] in a buffer.
pub const REACH: usize = 4;
/// Key of a culled Gaussian: behind all others.
const CULLED: u32 = 0xFFFF_FFFF;
/// Numbers of the statistics: the Gaussians of each fate, and the intersections in three limbs of 10 bits and more,
/// lowest first.
pub const STATISTICS: usize = FATES + 3;
const UNITS: usize = 256;

/// Buffers of the parameters of the Gaussians.
#[derive(CubeType, CubeLaunch)]
pub struct Parameters {
    means: Box<[f32]>,
    rotations: Box<[f32]>,
    scales: Box<[f32]>,
    opacities: Box<[f32]>,
}

#[cube]
impl Parameters {
    /// Gaussian number `g`.
    pub fn load(&self, g: usize) -> Gaussian {
        gaussian(&self.means, &self.rotations, &self.scales, &self.opacities, g)
    }
}

/// Camera number `index`; its numbers have the order of the fields of [`View`].
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

/// The tiles and intersections of a splat.
#[derive(CubeType, Clone, Copy)]
pub struct Reach {
    /// Rows of tiles.
    rows: Extent,
    /// Number of tiles, which is the number of intersections.
    pub tiles: u32,
    /// Number of its first intersection; set by [`emit()`].
    pub first: u32,
}

#[cube]
impl Reach {
    /// Reads number `index` of a buffer.
    pub fn load(reach: &[u32], index: usize) -> Reach {
        let at = index * comptime!(REACH);
        let rows = Extent { first: reach[at], end: reach[at + 1] };
        Reach { rows, tiles: reach[at + 2], first: reach[at + 3] }
    }

    fn store(&self, reach: &mut [u32], index: usize) {
        let at = index * comptime!(REACH);
        reach[at] = self.rows.first;
        reach[at + 1] = self.rows.end;
        reach[at + 2] = self.tiles;
        reach[at + 3] = self.first;
    }
}

/// Projects every Gaussian into every view: `splats` `[V·N, SPLAT]`, `reach` `[V·N, REACH]` (without `first`), `keys`
/// `[V·N]` (depth, or [`CULLED`]); adds to `statistics`.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn project_all(
    parameters: &Parameters,
    colors: &[f32],
    views: &[f32],
    splats: &mut [f32],
    reach: &mut [u32],
    keys: &mut [u32],
    statistics: &[Atomic<u32>],
    uniforms: &Uniforms,
    #[comptime] antialiased: bool,
) {
    let i = ABSOLUTE_POS;
    // Units beyond the last Gaussian count for no fate.
    let mut fate = comptime!(FATES as u32).runtime();
    let mut tiles = 0u32;
    if i < uniforms.n * uniforms.views {
        let g = i % uniforms.n;
        let view = load_view(views, i / uniforms.n);
        let gaussian = parameters.load(g);
        let color = load3(colors, 3 * g);
        let projected = splat(&view, &gaussian, &color, uniforms, antialiased);
        fate = projected.fate;
        tiles = projected.tiles;
        projected.splat.store(splats, i);
        Reach { rows: tiles_of(&projected.rows), tiles, first: 0u32 }.store(reach, i);
        keys[i] = select(fate == comptime!(VISIBLE), projected.splat.depth.to_bits(), comptime!(CULLED));
    }
    count(fate, tiles, statistics);
}

/// Adds the fates and tiles of all units of a cube to the statistics.
#[cube]
fn count(fate: u32, tiles: u32, statistics: &[Atomic<u32>]) {
    let mut fates = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let mut all_tiles = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let unit = UNIT_POS as usize;
    fates[unit] = fate;
    all_tiles[unit] = tiles;
    sync_cube();
    if unit < comptime!(FATES) {
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
    if unit == comptime!(FATES) {
        // At most 256 · 2²² and exact; three limbs of 10 bits keep the sum over all cubes exact too.
        let mut sum = 0u32;
        for i in 0..comptime!(UNITS) {
            sum += all_tiles[i];
        }
        statistics[comptime!(FATES)].fetch_add(sum & 0x3FFu32);
        statistics[comptime!(FATES + 1)].fetch_add((sum >> 10u32) & 0x3FFu32);
        statistics[comptime!(FATES + 2)].fetch_add(sum >> 20u32);
    }
}

/// Tile counts in depth order: `sorted[i]` is the tile count of splat `order[i]`.
#[cube(launch)]
pub fn sort_counts(reach: &[u32], order: &[u32], sorted: &mut [u32], total: usize) {
    if ABSOLUTE_POS < total {
        sorted[ABSOLUTE_POS] = Reach::load(reach, order[ABSOLUTE_POS] as usize).tiles;
    }
}

/// One intersection per splat and tile, splats front to back: its tile (counted over all views) and its splat.
///
/// A splat has as many places as [`project_all()`] counted. If the compiler makes this kernel round differently, the
/// kernel fills the remaining places with a tile that does not exist and never writes the places of other splats.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
pub fn emit(
    splats: &[f32],
    order: &[u32],
    offsets: &[u32],
    reach: &mut [u32],
    tile_of: &mut [u32],
    splat_of: &mut [u32],
    uniforms: &Uniforms,
) {
    if ABSOLUTE_POS >= uniforms.n * uniforms.views {
        terminate!();
    }
    let index = order[ABSOLUTE_POS] as usize;
    let mut own = Reach::load(&*reach, index);
    if own.tiles > 0u32 {
        let mut next = offsets[ABSOLUTE_POS];
        let end = offsets[ABSOLUTE_POS + 1];
        own.first = next;
        own.store(reach, index);
        let first_tile = (index / uniforms.n) as u32 * uniforms.tiles;
        let splat = Splat::load(splats, index);
        for y in own.rows.first..own.rows.end {
            let row = tiles_in_row(&splat, y, uniforms);
            for x in row.first..row.end {
                if next < end {
                    tile_of[next as usize] = first_tile + y * uniforms.tiles_x + x;
                    splat_of[next as usize] = index as u32;
                    next += 1u32;
                }
            }
        }
        while next < end {
            tile_of[next as usize] = uniforms.tiles * uniforms.views as u32;
            splat_of[next as usize] = index as u32;
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
