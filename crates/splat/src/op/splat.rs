//! A Gaussian in one view: culling, the tiles that it reaches, its α at a pixel.
//!
//! Like [`crate::projection`], the functions are compiled twice from this one source: as plain Rust for the CPU and,
//! through CubeCL's `#[cube]`, into the GPU kernels.

use cubecl::CubeTypeMut;
use cubecl::prelude::*;

use super::twofold::exp;
use crate::linear::{Quat, Vec3, load3};
use crate::options::{MIN_ALPHA, TILE};
use crate::projection::{Footprint, View, footprint, project, span, to_camera};

/// Values beyond this are treated like infinities: their products leave the range of f32.
const MAX_MAGNITUDE: f32 = 1e18;
/// Least |q|² of a quaternion that defines a rotation.
const MIN_QUATERNION: f32 = 1e-12;
/// Margin of [`Splat::radius_squared`]. Without it, rounding would cut off pixels whose α is just above [`MIN_ALPHA`].
/// It suffices for needles of 4,000 pixels.
const RADIUS_MARGIN: f32 = 1e-2;

/// The numbers of a projected Gaussian that blending reads.
#[derive(CubeType, Clone, Copy, Debug, Default)]
pub struct Splat {
    /// Centre, pixels.
    pub u: f32,
    pub v: f32,
    /// Factors of Σ'⁻¹ (see [`crate::projection`]).
    pub l0: f32,
    pub k: f32,
    pub l1: f32,
    /// Opacity after antialiasing.
    pub opacity: f32,
    /// t_z, metres.
    pub depth: f32,
    /// Squared radius in squared standard deviations, beyond which α < 1/255.
    pub radius_squared: f32,
}

/// Sizes and constants of a call.
#[derive(CubeType, CubeLaunch)]
pub struct Uniforms {
    /// Number of Gaussians.
    pub n: usize,
    /// Number of views.
    pub views: usize,
    /// Width of an image, pixels.
    pub width: u32,
    /// Height of an image, pixels.
    pub height: u32,
    /// Tiles in a row of tiles.
    pub tiles_x: u32,
    /// Tiles of a view.
    pub tiles: u32,
    /// Near plane, metres.
    pub near: f32,
    /// Variance that is added to every projected Gaussian, square pixels.
    pub blur: f32,
    /// Clamp of α.
    pub max_alpha: f32,
}

/// Parameters of a Gaussian.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Gaussian {
    pub mean: Vec3,
    pub rotation: Quat,
    pub scale: Vec3,
    pub opacity: f32,
}

/// Gaussian number `g` of arrays `[N,3]`, `[N,4]`, `[N,3]`, `[N]`.
#[cube]
pub fn gaussian(means: &[f32], rotations: &[f32], scales: &[f32], opacities: &[f32], g: usize) -> Gaussian {
    let at = 4 * g;
    Gaussian {
        mean: load3(means, 3 * g),
        rotation: Quat { w: rotations[at], x: rotations[at + 1], y: rotations[at + 2], z: rotations[at + 3] },
        scale: load3(scales, 3 * g),
        opacity: opacities[g],
    }
}

/// The numbers from `first` to `end` − 1.
#[derive(CubeType, CubeTypeMut, Clone, Copy, Debug, Default)]
pub struct Extent {
    pub first: u32,
    pub end: u32,
}

/// A splat and its tiles, or the reason why the Gaussian is culled.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Projected {
    /// Meaningless if the Gaussian is culled.
    pub splat: Splat,
    /// √(det Σ'_raw / det Σ') with antialiasing, else 1.
    pub compensation: f32,
    /// Rows of pixels within reach.
    pub rows: Extent,
    /// Number of tiles within reach; 0 if the Gaussian is culled.
    pub tiles: u32,
    /// [`VISIBLE`], or the reason of the culling.
    pub fate: u32,
}

/// The Gaussian reaches the centre of a pixel.
pub const VISIBLE: u32 = 0;
/// The depth t_z is at most `near`.
pub const NEAR: u32 = 1;
/// No centre of a pixel is within reach.
pub const OUTSIDE: u32 = 2;
/// Opacity below 1/255.
pub const TRANSPARENT: u32 = 3;
/// |q|² is below 1e-12, or a projected quantity is beyond ±1e18, or a determinant is not positive.
pub const DEGENERATE: u32 = 4;
/// A parameter that is not finite, or beyond ±1e18.
pub const INVALID: u32 = 5;
/// Number of values of [`Projected::fate`].
pub const FATES: usize = 6;

/// Whether a number is finite and not huge, by its bits: shader compilers may assume that there is no NaN.
#[cube]
fn in_range(value: f32) -> bool {
    value.to_bits() & 0x7FFF_FFFFu32 <= comptime!(MAX_MAGNITUDE.to_bits())
}

#[cube]
fn in_range3(values: &Vec3) -> bool {
    in_range(values.x) && in_range(values.y) && in_range(values.z)
}

#[cube]
fn is_valid(gaussian: &Gaussian, color: &Vec3) -> bool {
    let q = &gaussian.rotation;
    in_range3(&gaussian.mean)
        && in_range(q.w)
        && in_range(q.x)
        && in_range(q.y)
        && in_range(q.z)
        && in_range3(&gaussian.scale)
        && in_range(gaussian.opacity)
        && in_range3(color)
}

#[cube]
fn has_rotation(q: &Quat) -> bool {
    q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z >= comptime!(MIN_QUATERNION)
}

#[cube]
fn is_sound(f: &Footprint) -> bool {
    f.determinant > 0.0
        && f.l0 > 0.0
        && f.l1 > 0.0
        && in_range(f.determinant)
        && in_range(f.u)
        && in_range(f.v)
        && in_range(f.k)
        && in_range(f.sigma_x)
        && in_range(f.sigma_y)
        && in_range(1.0 / f.l1)
}

/// Projects a Gaussian into a view, or culls it.
#[cube]
pub fn splat(
    view: &View,
    gaussian: &Gaussian,
    color: &Vec3,
    uniforms: &Uniforms,
    #[comptime] antialiased: bool,
) -> Projected {
    // Everything is computed before the tests: the numbers of a culled Gaussian may be NaN, and nothing reads them.
    let t = to_camera(view, &gaussian.mean);
    let p = project(view, &t, &gaussian.rotation, &gaussian.scale, uniforms.blur);
    let f = footprint(view, &p);
    let mut compensation = 1.0f32;
    if comptime!(antialiased) {
        compensation = f.compensation;
    }
    let opacity = gaussian.opacity * compensation;
    let radius_squared = 2.0 * (opacity / comptime!(MIN_ALPHA)).ln() + comptime!(RADIUS_MARGIN);
    let splat = Splat { u: f.u, v: f.v, l0: f.l0, k: f.k, l1: f.l1, opacity, depth: t.z, radius_squared };

    // Only the first failing test is counted.
    let mut fate = comptime!(VISIBLE).runtime();
    if !is_valid(gaussian, color) {
        fate = comptime!(INVALID).runtime();
    } else if !in_range3(&t) {
        fate = comptime!(DEGENERATE).runtime();
    } else if t.z <= uniforms.near {
        fate = comptime!(NEAR).runtime();
    } else if !has_rotation(&gaussian.rotation) || !is_sound(&f) {
        fate = comptime!(DEGENERATE).runtime();
    } else if opacity < comptime!(MIN_ALPHA) {
        fate = comptime!(TRANSPARENT).runtime();
    }
    let mut rows = Extent { first: 0u32, end: 0u32 };
    let mut tiles = 0u32;
    if fate == comptime!(VISIBLE) {
        let half_height = radius_squared.sqrt() * f.sigma_y;
        rows = pixels_between(f.v - half_height, f.v + half_height, uniforms.height);
        let tile_rows = tiles_of(&rows);
        for y in tile_rows.first..tile_rows.end {
            let row = tiles_in_row(&splat, y, uniforms);
            tiles += row.end - row.first;
        }
        if tiles == 0u32 {
            fate = comptime!(OUTSIDE).runtime();
        }
    }
    Projected { splat, compensation, rows, tiles, fate }
}

/// The pixels of an axis of `side` pixels whose centres are between `low` and `high`.
#[cube]
fn pixels_between(low: f32, high: f32, side: u32) -> Extent {
    let first = (low - 0.5).max(0.0).ceil();
    let last = (high - 0.5).min(side as f32 - 1.0).floor();
    let any = first <= last;
    Extent { first: select(any, first as u32, 0u32), end: select(any, last as u32 + 1u32, 0u32) }
}

/// The tiles that contain the pixels.
#[cube]
#[allow(clippy::manual_div_ceil, reason = "CubeCL has no `div_ceil`")]
pub fn tiles_of(pixels: &Extent) -> Extent {
    let tile = comptime!(TILE as u32);
    Extent { first: pixels.first / tile, end: (pixels.end + tile - 1u32) / tile }
}

/// The tiles within reach in tile row `y`: the tiles of the pixels that the splat's ellipse covers within the row.
#[cube]
pub fn tiles_in_row(splat: &Splat, y: u32, uniforms: &Uniforms) -> Extent {
    let tile = comptime!(TILE as u32);
    let top = (y * tile) as f32 + 0.5 - splat.v;
    let bottom = (y * tile + tile - 1u32).min(uniforms.height - 1u32) as f32 + 0.5 - splat.v;
    let reached = span(splat.l0, splat.k, splat.l1, splat.radius_squared, top, bottom);
    tiles_of(&pixels_between(splat.u + reached.left, splat.u + reached.right, uniforms.width))
}

/// Offset of a pixel from a splat's centre in standard deviations, w = F·d (see [`crate::projection`]).
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Offset {
    pub w0: f32,
    pub w1: f32,
}

/// Offset of the point (`x`, `y`) of the image.
#[cube]
#[inline(always)]
pub fn offset(splat: &Splat, x: f32, y: f32) -> Offset {
    let dx = x - splat.u;
    let dy = y - splat.v;
    Offset { w0: splat.l0 * dx, w1: splat.l1 * (dy + splat.k * dx) }
}

/// o·exp(−½|w|²): the splat's α before the clamp at α_max.
#[cube]
#[inline(always)]
pub fn unclamped_alpha(splat: &Splat, w: &Offset) -> f32 {
    splat.opacity * exp((w.w0 * w.w0 + w.w1 * w.w1) * -0.5f32)
}

/// Number of f32 that a splat takes in a buffer.
pub const SPLAT: usize = 8;

#[cube]
impl Splat {
    /// Reads splat number `index` of a buffer.
    pub fn load(splats: &[f32], index: usize) -> Splat {
        let at = index * comptime!(SPLAT);
        Splat {
            u: splats[at],
            v: splats[at + 1],
            l0: splats[at + 2],
            k: splats[at + 3],
            l1: splats[at + 4],
            opacity: splats[at + 5],
            depth: splats[at + 6],
            radius_squared: splats[at + 7],
        }
    }

    /// Writes splat number `index` of a buffer.
    pub fn store(&self, splats: &mut [f32], index: usize) {
        let at = index * comptime!(SPLAT);
        splats[at] = self.u;
        splats[at + 1] = self.v;
        splats[at + 2] = self.l0;
        splats[at + 3] = self.k;
        splats[at + 4] = self.l1;
        splats[at + 5] = self.opacity;
        splats[at + 6] = self.depth;
        splats[at + 7] = self.radius_squared;
    }
}
