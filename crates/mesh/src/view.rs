//! Views of a mesh: colour, coverage and depth by a z-buffer rasteriser.
//!
//! * A pixel's coverage is the share of its samples, on a regular grid, that lie inside a triangle; triangles that share
//!   an edge share no sample and leave none out, because edges are decided in whole numbers (1/240 pixel) by the top-left
//!   rule.
//! * A pixel's colour is the coverage-weighted mean of its visible surfaces, over black. Each surface is shaded once per
//!   pixel, at the middle of the samples that see it, with textures filtered to the pixel's size.
//! * Depth is exact: where the ray through the pixel's centre (at +½) meets the plane of the nearest triangle there.

mod shade;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use snapsnap_splat::Camera;

use crate::mesh::{Mesh, MeshError};
pub use shade::Lights;
use shade::{Shader, Surface};

/// Whole numbers per pixel that vertices are rounded to; grids of 1 to 6 samples per axis fall on them.
const SUBPIXELS: i64 = 240;
/// Side of the squares of pixels that are drawn in parallel.
const TILE: usize = 32;
/// Vertices nearer to the camera than this, in metres, make their triangles invisible: nothing is clipped.
const NEAR: f64 = 1e-3;
/// Vertices further outside the image than this, in pixels, do too.
const FAR_OUTSIDE: f64 = 1e6;
/// No triangle.
const NONE: u32 = u32::MAX;

/// How to draw.
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// Samples per pixel along each axis, 1 to 6.
    pub samples: usize,
    /// Where the light comes from.
    pub lights: Lights,
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self { samples: 3, lights: Lights::default() }
    }
}

/// One picture of a mesh.
#[derive(Debug, Clone)]
pub struct View {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[H,W]` red, green, blue in [0, 1], over black: already multiplied by `alpha`.
    pub color: Vec<[f32; 3]>,
    /// `[H,W]` coverage in [0, 1].
    pub alpha: Vec<f32>,
    /// `[H,W]` metres along the optical axis at the pixel's centre; 0 where the centre sees nothing.
    pub depth: Vec<f32>,
}

/// A triangle on the screen.
struct Triangle {
    /// Corners in units of 1/[`SUBPIXELS`] pixel, so ordered that the inside has positive edge functions.
    corners: [[i64; 2]; 3],
    /// 1/z = plane · (u, v, 1) at pixel coordinates (u, v).
    plane: DVec3,
    /// First and last pixel column and row that it may touch.
    columns: [usize; 2],
    rows: [usize; 2],
    face: u32,
}

/// A mesh made ready to be drawn from many sides.
pub struct Renderer<'a>(Surface<'a>);

impl<'a> Renderer<'a> {
    /// Prepares normals and textures.
    ///
    /// # Errors
    /// [`MeshError`] if the mesh cannot be drawn.
    pub fn new(mesh: &'a Mesh) -> Result<Self, MeshError> {
        mesh.check()?;
        Ok(Self(Surface::new(mesh)))
    }

    /// The mesh as `camera` sees it. Surfaces are seen from both sides.
    ///
    /// # Panics
    /// If `options.samples` is not 1 to 6.
    pub fn draw(&self, camera: &Camera, options: &ViewOptions) -> View {
        draw(&self.0, camera, options)
    }
}

fn draw(surface: &Surface, camera: &Camera, options: &ViewOptions) -> View {
    assert!((1..=6).contains(&options.samples), "{} samples per axis", options.samples);
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mesh = surface.mesh;
    let corners: Vec<DVec3> =
        mesh.positions.par_iter().map(|p| camera.world_to_camera.apply(p.as_dvec3())).collect();
    let triangles: Vec<Triangle> = (0..mesh.faces.len())
        .into_par_iter()
        .filter_map(|face| {
            triangle(mesh.faces[face].positions.map(|row| corners[row as usize]), face, camera)
        })
        .collect();

    let tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
    let mut lists: Vec<Vec<u32>> = vec![Vec::new(); tiles[0] * tiles[1]];
    for (index, t) in (0..).zip(&triangles) {
        for y in t.rows[0] / TILE..=t.rows[1] / TILE {
            for x in t.columns[0] / TILE..=t.columns[1] / TILE {
                lists[y * tiles[0] + x].push(index);
            }
        }
    }

    let shader = Shader { surface, camera, corners: &corners, lights: &options.lights };
    let drawn: Vec<Option<View>> = lists
        .par_iter()
        .enumerate()
        .map(|(tile, list)| {
            let (left, top) = (tile % tiles[0] * TILE, tile / tiles[0] * TILE);
            let size = [TILE.min(width - left), TILE.min(height - top)];
            (!list.is_empty())
                .then(|| Tile::new([left, top], size, options.samples).draw(list, &triangles, &shader))
        })
        .collect();

    let pixels = width * height;
    let mut view = View {
        width,
        height,
        color: vec![[0.0; 3]; pixels],
        alpha: vec![0.0; pixels],
        depth: vec![0.0; pixels],
    };
    for (tile, drawn) in drawn.iter().enumerate() {
        let Some(drawn) = drawn else { continue };
        let (left, top) = (tile % tiles[0] * TILE, tile / tiles[0] * TILE);
        for y in 0..drawn.height {
            let (to, from) = ((top + y) * width + left, y * drawn.width);
            view.color[to..to + drawn.width].copy_from_slice(&drawn.color[from..from + drawn.width]);
            view.alpha[to..to + drawn.width].copy_from_slice(&drawn.alpha[from..from + drawn.width]);
            view.depth[to..to + drawn.width].copy_from_slice(&drawn.depth[from..from + drawn.width]);
        }
    }
    view
}

/// The triangle on the screen; `None` if it is not to be seen.
fn triangle(corners: [DVec3; 3], face: usize, camera: &Camera) -> Option<Triangle> {
    if corners.iter().any(|c| c.z < NEAR) {
        return None;
    }
    let screen = corners.map(|c| camera.focal * DVec2::new(c.x, c.y) / c.z + camera.principal_point);
    if screen.iter().any(|s| s.abs().max_element() > FAR_OUTSIDE) {
        return None;
    }
    let mut rounded = screen.map(|s| {
        let s = (s * SUBPIXELS as f64).round();
        [s.x as i64, s.y as i64]
    });
    let [a, b, c] = rounded;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if area == 0 {
        return None;
    }
    if area < 0 {
        rounded.swap(1, 2);
    }
    let range = |axis: usize, side: usize| {
        let low = rounded.iter().map(|r| r[axis]).min()?.div_euclid(SUBPIXELS).max(0);
        let high = rounded.iter().map(|r| r[axis]).max()?.div_euclid(SUBPIXELS).min(side as i64 - 1);
        (low <= high).then_some([low as usize, high as usize])
    };
    let columns = range(0, camera.width as usize)?;
    let rows = range(1, camera.height as usize)?;
    // A point z·d on the plane through p with normal n has z = n·p/n·d, d = ((u − cx)/fx, (v − cy)/fy, 1).
    let n = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
    let distance = n.dot(corners[0]);
    if distance == 0.0 {
        return None;
    }
    let (f, c) = (camera.focal, camera.principal_point);
    let (x, y) = (n.x / f.x, n.y / f.y);
    let plane = DVec3::new(x, y, n.z - x * c.x - y * c.y) / distance;
    Some(Triangle { corners: rounded, plane, columns, rows, face: face as u32 })
}

/// Samples of a square of pixels.
struct Tile {
    /// First column and row.
    origin: [usize; 2],
    /// Columns and rows.
    size: [usize; 2],
    /// Places of the samples within a pixel, in 1/[`SUBPIXELS`]; the last is the centre, which counts for depth alone.
    places: Vec<[i64; 2]>,
    /// For each pixel and place: the nearest triangle and its 1/z.
    nearest: Vec<(f64, u32)>,
}

impl Tile {
    fn new(origin: [usize; 2], size: [usize; 2], samples: usize) -> Self {
        let place = |i: usize| (2 * i as i64 + 1) * SUBPIXELS / (2 * samples as i64);
        let mut places: Vec<[i64; 2]> =
            (0..samples * samples).map(|i| [place(i % samples), place(i / samples)]).collect();
        places.push([SUBPIXELS / 2; 2]);
        let nearest = vec![(0.0, NONE); size[0] * size[1] * places.len()];
        Self { origin, size, places, nearest }
    }

    fn draw(mut self, list: &[u32], triangles: &[Triangle], shader: &Shader) -> View {
        for &index in list {
            self.add(index, &triangles[index as usize]);
        }
        let pixels = self.size[0] * self.size[1];
        let mut view = View {
            width: self.size[0],
            height: self.size[1],
            color: vec![[0.0; 3]; pixels],
            alpha: vec![0.0; pixels],
            depth: vec![0.0; pixels],
        };
        let count = self.places.len();
        for (pixel, seen) in self.nearest.chunks_exact(count).enumerate() {
            let (inverse_depth, centre) = seen[count - 1];
            if centre != NONE {
                view.depth[pixel] = (1.0 / inverse_depth) as f32;
            }
            let corner = DVec2::new(
                (self.origin[0] + pixel % self.size[0]) as f64,
                (self.origin[1] + pixel / self.size[0]) as f64,
            );
            self.shade(&seen[..count - 1], corner, triangles, shader, &mut view, pixel);
        }
        view
    }

    /// Marks the samples inside the triangle that it is nearest to.
    fn add(&mut self, index: u32, t: &Triangle) {
        let clip = |range: [usize; 2], axis: usize| {
            let first = range[0].max(self.origin[axis]);
            let last = range[1].min(self.origin[axis] + self.size[axis] - 1);
            first..=last
        };
        // Edge function of edge i at (x, y), minus one where points on the edge belong to the neighbour: inside is ≥ 0.
        let edges: [[i64; 3]; 3] = std::array::from_fn(|i| {
            let (from, to) = (t.corners[i], t.corners[(i + 1) % 3]);
            let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
            // With y down and positive area, top edges run right and left edges run up.
            let owned = (dy == 0 && dx > 0) || dy < 0;
            [-dy, dx, dy * from[0] - dx * from[1] - i64::from(!owned)]
        });
        for y in clip(t.rows, 1) {
            for x in clip(t.columns, 0) {
                let pixel = (y - self.origin[1]) * self.size[0] + x - self.origin[0];
                let (px, py) = (x as i64 * SUBPIXELS, y as i64 * SUBPIXELS);
                let count = self.places.len();
                let seen = &mut self.nearest[pixel * count..(pixel + 1) * count];
                for (place, nearest) in self.places.iter().zip(seen) {
                    let (sx, sy) = (px + place[0], py + place[1]);
                    if edges.iter().all(|[a, b, c]| a * sx + b * sy + c >= 0) {
                        let (u, v) = (sx as f64 / SUBPIXELS as f64, sy as f64 / SUBPIXELS as f64);
                        let inverse_depth = t.plane.dot(DVec3::new(u, v, 1.0));
                        if inverse_depth > nearest.0 {
                            *nearest = (inverse_depth, index);
                        }
                    }
                }
            }
        }
    }

    /// Colour and coverage of one pixel from the samples that see something.
    fn shade(
        &self,
        seen: &[(f64, u32)],
        corner: DVec2,
        triangles: &[Triangle],
        shader: &Shader,
        view: &mut View,
        pixel: usize,
    ) {
        let mut color = glam::Vec3::ZERO;
        let mut covered = 0;
        for (i, &(_, index)) in seen.iter().enumerate() {
            if index == NONE {
                continue;
            }
            covered += 1;
            // Each triangle at its first sample, for all of its samples.
            if seen[..i].iter().any(|&(_, other)| other == index) {
                continue;
            }
            let mut middle = DVec2::ZERO;
            let mut weight = 0;
            for (place, _) in self.places.iter().zip(seen).filter(|(_, s)| s.1 == index) {
                middle += DVec2::new(place[0] as f64, place[1] as f64);
                weight += 1;
            }
            let t = &triangles[index as usize];
            let at = corner + middle / (f64::from(weight) * SUBPIXELS as f64);
            color += weight as f32 * shader.color(t.face as usize, at, t.plane);
        }
        view.color[pixel] = (color / seen.len() as f32).to_array();
        view.alpha[pixel] = covered as f32 / seen.len() as f32;
    }
}

#[cfg(test)]
mod tests;
