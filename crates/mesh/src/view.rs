//! Views of a mesh: colour, coverage and depth by a z-buffer rasteriser.
//!
//! * A pixel's coverage is the share of its samples, on a regular grid, that lie inside a triangle. Triangles with a
//!   common edge neither share nor miss a sample, because vertices are rounded to 1/240 pixel and edges follow the
//!   top-left rule.
//! * A pixel's colour is the coverage-weighted mean of its visible surfaces, over black. Each surface is shaded once
//!   per pixel, at the middle of its samples, with textures filtered to the pixel's size.
//! * Depth is exact: the ray through the pixel's centre (at +½) meets the plane of the nearest triangle there.

mod light;
mod occlusion;
mod shade;

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use glam::{DVec2, DVec3, Vec3};
use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use snapsnap_splat::Camera;

use crate::mesh::{Face, Mesh, MeshError};
pub use light::{Lamp, Light, Lights, Surroundings};
use occlusion::Occlusion;
use shade::{Lit, Pyramid, Shader};

/// Steps per pixel to which vertices are rounded. Samples of grids of 1 to 6 per axis lie on whole steps.
const SUBPIXELS: i64 = 240;
/// Rows of pixels in a band; bands are drawn in parallel.
const BAND: usize = 8;
/// Near plane in metres. Triangles with a nearer vertex are left out, not clipped.
const NEAR: f64 = 1e-3;
/// Largest pixel coordinate of a vertex. Triangles with a vertex beyond it are left out.
const FAR_OUTSIDE: f64 = 1e6;
/// Smallest distance along a ray between two surfaces that count as separate, metres.
const LEAST_GAP: f64 = 0.004;
/// No triangle.
const NONE: u32 = u32::MAX;

/// Options of [`Renderer::draw`].
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// Samples per pixel along each axis, 1 to 6.
    pub samples: usize,
    /// Light of the scene.
    pub light: Light,
    /// Whether [`View::second`] is rendered.
    pub second: bool,
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self { samples: 3, light: Light::default(), second: false }
    }
}

/// One picture of a mesh.
#[derive(Debug, Clone)]
pub struct View {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[H,W]` red, green, blue in [0, 1], premultiplied by `alpha`.
    pub color: Vec<[f32; 3]>,
    /// `[H,W]` coverage in [0, 1].
    pub alpha: Vec<f32>,
    /// `[H,W]` metres along the optical axis at the pixel's centre; 0 without a surface there.
    pub depth: Vec<f32>,
    /// `[H,W]` depth of the second surface that faces the camera, such as a flank behind an arm: the first front face
    /// behind the point where the ray leaves the body. 0 without one. Empty unless [`ViewOptions::second`].
    pub second: Vec<f32>,
}

/// A triangle on the screen.
struct Triangle {
    /// Corners in units of 1/[`SUBPIXELS`] pixel, in the order in which edge functions are positive inside.
    corners: [[i64; 2]; 3],
    /// 1/z = plane · (u, v, 1) at pixel coordinates (u, v).
    plane: DVec3,
    /// First and last pixel column and row that the triangle may touch.
    columns: [usize; 2],
    rows: [usize; 2],
    face: u32,
    /// Whether the triangle faces the camera.
    is_front: bool,
    /// Whether the surface is cut out in places ([`Shader::is_cut`]).
    has_holes: bool,
}

/// A mesh with the normals and textures that drawing needs, for any number of views.
pub struct Renderer<'a> {
    mesh: &'a Mesh,
    normals: Vec<Vec3>,
    /// One per material.
    textures: Vec<Option<Arc<Pyramid>>>,
    /// Computed by the first view with shadows.
    occlusion: OnceLock<Occlusion>,
}

impl<'a> Renderer<'a> {
    /// Prepares normals and textures.
    ///
    /// # Errors
    /// [`MeshError`] if the mesh cannot be drawn.
    pub fn new(mesh: &'a Mesh) -> Result<Self, MeshError> {
        mesh.check()?;
        // Materials often share a texture.
        let mut pyramids: HashMap<*const RgbImage, Arc<Pyramid>> = HashMap::new();
        let mut pyramid = |texture: &Arc<RgbImage>| {
            let pyramid = pyramids.entry(Arc::as_ptr(texture));
            pyramid.or_insert_with(|| Arc::new(Pyramid::new(texture))).clone()
        };
        let textures = mesh.materials.iter().map(|m| m.texture.as_ref().map(&mut pyramid)).collect();
        Ok(Self { mesh, normals: mesh.normals(), textures, occlusion: OnceLock::new() })
    }

    /// Where the surface of a face is cut out, and the face's texture coordinates.
    fn holes(&self, face: &Face) -> Option<(&GrayImage, [u32; 3])> {
        self.mesh.materials[face.material as usize].opacity.as_deref().zip(face.texcoords)
    }

    fn occlusion(&self) -> &Occlusion {
        self.occlusion.get_or_init(|| {
            // A card with holes would throw the shadow of a board.
            let faces = self.mesh.faces.iter().filter(|face| self.holes(face).is_none());
            let faces: Vec<[u32; 3]> = faces.map(|face| face.positions).collect();
            Occlusion::new(&self.mesh.positions, &self.normals, &faces)
        })
    }

    /// Draws the mesh from `camera`. Both sides of a surface are visible.
    ///
    /// # Panics
    /// If `options.samples` is not 1 to 6.
    pub fn draw(&self, camera: &Camera, options: &ViewOptions) -> View {
        assert!((1..=6).contains(&options.samples), "{} samples per axis", options.samples);
        let (width, height) = (camera.width as usize, camera.height as usize);
        let corners: Vec<DVec3> =
            self.mesh.positions.par_iter().map(|p| camera.world_to_camera.apply(p.as_dvec3())).collect();
        let projected = |(row, face): (usize, &Face)| {
            let corners = face.positions.map(|row| corners[row as usize]);
            triangle(corners, row, self.holes(face).is_some(), camera)
        };
        let triangles: Vec<Triangle> = self.mesh.faces.par_iter().enumerate().filter_map(projected).collect();
        let mut lists: Vec<Vec<u32>> = vec![Vec::new(); height.div_ceil(BAND)];
        for (index, t) in (0..).zip(&triangles) {
            let lists = &mut lists[t.rows[0] / BAND..=t.rows[1] / BAND];
            lists.iter_mut().for_each(|list| list.push(index));
        }

        // Positions of the samples within a pixel, in 1/[`SUBPIXELS`]. The last one is the centre, for depth.
        let n = options.samples;
        let place = |i: usize| (2 * i as i64 + 1) * SUBPIXELS / (2 * n as i64);
        let grid = (0..n * n).map(|i| [place(i % n), place(i / n)]);
        let places = grid.chain([[SUBPIXELS / 2; 2]]).collect();
        let light = match &options.light {
            Light::Plain(lights) => Lit::Plain(lights),
            Light::Around(surroundings) => Lit::Vertices(self.occlusion().light(surroundings, &self.normals)),
        };
        let shader = Shader { renderer: self, camera, corners: &corners, light, triangles, places };
        let pixels = width * height;
        let mut view = View {
            width,
            height,
            color: vec![[0.0; 3]; pixels],
            alpha: vec![0.0; pixels],
            depth: vec![0.0; pixels],
            second: vec![0.0; if options.second { pixels } else { 0 }],
        };
        let colors = view.color.par_chunks_mut(BAND * width);
        let coverages = view.alpha.par_chunks_mut(BAND * width);
        let depths = view.depth.par_chunks_mut(BAND * width);
        // Empty rows if the second surface is not wanted.
        let mut seconds: Vec<&mut [f32]> = match options.second {
            true => view.second.chunks_mut(BAND * width).collect(),
            false => lists.iter().map(|_| Default::default()).collect(),
        };
        let outputs = (colors, coverages, depths, seconds.par_iter_mut()).into_par_iter();
        let bands = lists.par_iter().enumerate().zip(outputs);
        bands.for_each(|((number, list), (color, alpha, depth, second))| {
            let rows = [number * BAND, height.min((number + 1) * BAND)];
            let Some(band) = Band::new(list, rows, &shader) else { return };
            for (pixel, seen) in band.nearest.chunks_exact(shader.places.len()).enumerate() {
                let (x, y) = (band.left + pixel % band.columns, pixel / band.columns);
                let at = y * width + x;
                let ((inverse_depth, centre), samples) = seen.split_last().expect("the centre");
                if *centre != NONE {
                    depth[at] = (1.0 / inverse_depth) as f32;
                }
                let corner = DVec2::new(x as f64, (rows[0] + y) as f64);
                (color[at], alpha[at]) = shade(samples, corner, &shader);
            }
            if options.second {
                band.second(list, rows, width, &shader, second);
            }
        });
        view
    }
}

/// Projects a triangle; `None` if it is invisible.
fn triangle(corners: [DVec3; 3], face: usize, has_holes: bool, camera: &Camera) -> Option<Triangle> {
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
    let (face, is_front) = (face as u32, distance < 0.0);
    Some(Triangle { corners: rounded, plane, columns, rows, face, is_front, has_holes })
}

/// Z-buffer of a band, from the first to the last column that triangles may touch.
struct Band {
    /// First column.
    left: usize,
    columns: usize,
    /// For each pixel and sample: 1/z of the nearest triangle, and its index.
    nearest: Vec<(f64, u32)>,
}

impl Band {
    /// Rasterises the triangles of `list` in the rows `rows[0]..rows[1]`; `None` if `list` is empty.
    fn new(list: &[u32], rows: [usize; 2], shader: &Shader) -> Option<Self> {
        let Shader { triangles, places, .. } = shader;
        let columns = || list.iter().map(|index| triangles[*index as usize].columns);
        let left = columns().map(|[first, _]| first).min()?;
        let columns = columns().map(|[_, last]| last).max()? + 1 - left;
        let mut nearest = vec![(0.0, NONE); (rows[1] - rows[0]) * columns * places.len()];
        for &index in list {
            // Depth test of the samples inside the triangle.
            triangles[index as usize].samples(rows, places, shader, |x, y, place, inverse_depth| {
                let pixel = (y - rows[0]) * columns + x - left;
                let nearest = &mut nearest[pixel * places.len() + place];
                if inverse_depth > nearest.0 {
                    *nearest = (inverse_depth, index);
                }
            });
        }
        Some(Self { left, columns, nearest })
    }

    /// Writes [`View::second`] of the band's rows to `to`, whose rows have `width` pixels.
    fn second(&self, list: &[u32], rows: [usize; 2], width: usize, shader: &Shader, to: &mut [f32]) {
        let per_pixel = self.nearest.len() / ((rows[1] - rows[0]) * self.columns);
        let centres = self.nearest.iter().skip(per_pixel - 1).step_by(per_pixel);
        // A step of depth peeling: 1/z of the nearest front or back faces behind `limits` (inverse depths).
        let behind = |limits: &[f64], is_front: bool| {
            let mut found = vec![0.0_f64; limits.len()];
            let triangles = list.iter().map(|index| &shader.triangles[*index as usize]);
            for t in triangles.filter(|t| t.is_front == is_front) {
                t.samples(rows, &[[SUBPIXELS / 2; 2]], shader, |x, y, _, inverse_depth| {
                    let pixel = (y - rows[0]) * self.columns + x - self.left;
                    // A limit of 0 means no surface.
                    let is_behind =
                        limits[pixel] > 0.0 && 1.0 / inverse_depth > 1.0 / limits[pixel] + LEAST_GAP;
                    if is_behind && inverse_depth > found[pixel] {
                        found[pixel] = inverse_depth;
                    }
                });
            }
            found
        };
        let first: Vec<f64> = centres.map(|(inverse_depth, _)| *inverse_depth).collect();
        let exits = behind(&first, false);
        for (pixel, inverse_depth) in behind(&exits, true).into_iter().enumerate() {
            if inverse_depth > 0.0 {
                to[pixel / self.columns * width + self.left + pixel % self.columns] =
                    (1.0 / inverse_depth) as f32;
            }
        }
    }
}

impl Triangle {
    /// Calls `each` with column, row, sample and 1/z of the samples on the triangle's surface in the rows
    /// `rows[0]..rows[1]`.
    fn samples(
        &self,
        rows: [usize; 2],
        places: &[[i64; 2]],
        shader: &Shader,
        mut each: impl FnMut(usize, usize, usize, f64),
    ) {
        // Coefficients of edge function i: inside is ≥ 0. Minus one where points on the edge belong to the neighbour.
        let edges: [[i64; 3]; 3] = std::array::from_fn(|i| {
            let (from, to) = (self.corners[i], self.corners[(i + 1) % 3]);
            let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
            // With y down and positive area, top edges run right and left edges run up.
            let owned = (dy == 0 && dx > 0) || dy < 0;
            [-dy, dx, dy * from[0] - dx * from[1] - i64::from(!owned)]
        });
        for y in self.rows[0].max(rows[0])..=self.rows[1].min(rows[1] - 1) {
            for x in self.columns[0]..=self.columns[1] {
                let (px, py) = (x as i64 * SUBPIXELS, y as i64 * SUBPIXELS);
                for (place, [dx, dy]) in places.iter().enumerate() {
                    let (sx, sy) = (px + dx, py + dy);
                    if edges.iter().all(|[a, b, c]| a * sx + b * sy + c >= 0) {
                        let at = DVec2::new(sx as f64, sy as f64) / SUBPIXELS as f64;
                        if !(self.has_holes && shader.is_cut(self, at)) {
                            each(x, y, place, self.plane.dot(at.extend(1.0)));
                        }
                    }
                }
            }
        }
    }
}

/// Colour and coverage of one pixel from its samples; `corner` is the pixel's upper left corner.
fn shade(samples: &[(f64, u32)], corner: DVec2, shader: &Shader) -> ([f32; 3], f32) {
    let mut color = Vec3::ZERO;
    let mut covered = 0;
    for (i, &(_, index)) in samples.iter().enumerate() {
        if index == NONE {
            continue;
        }
        covered += 1;
        // Each triangle is shaded at its first sample, for all of its samples.
        if samples[..i].iter().any(|&(_, other)| other == index) {
            continue;
        }
        let mut middle = DVec2::ZERO;
        let mut weight = 0;
        for (place, _) in shader.places.iter().zip(samples).filter(|(_, sample)| sample.1 == index) {
            middle += DVec2::new(place[0] as f64, place[1] as f64);
            weight += 1;
        }
        let t = &shader.triangles[index as usize];
        let at = corner + middle / (f64::from(weight) * SUBPIXELS as f64);
        color += weight as f32 * shader.color(t, at);
    }
    let count = samples.len() as f32;
    ((color / count).to_array(), covered as f32 / count)
}

#[cfg(test)]
mod tests;
