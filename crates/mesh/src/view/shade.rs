//! Texture filtering and shading.

use std::sync::Arc;

use glam::{DVec2, DVec3, Vec2, Vec3};
use image::RgbImage;
use snapsnap_splat::Camera;

use super::light::Lights;
use super::{Renderer, Triangle};

/// Step in pixels for the derivative of texture coordinates.
const STEP: f64 = 0.01;
/// Most samples of a texture for one pixel.
const MAX_TAPS: f32 = 8.0;

/// A texture and its mip levels.
pub struct Pyramid {
    levels: Vec<Arc<RgbImage>>,
}

impl Pyramid {
    pub fn new(texture: &Arc<RgbImage>) -> Self {
        let mut levels = vec![texture.clone()];
        while let Some(last) = levels.last().filter(|l| l.width() > 1 || l.height() > 1) {
            let (w, h) = ((last.width() / 2).max(1), (last.height() / 2).max(1));
            levels.push(Arc::new(image::imageops::thumbnail(last.as_ref(), w, h)));
        }
        Self { levels }
    }

    /// Colour at the texture coordinates `at`, filtered over a pixel. `right` and `down` are the changes of the
    /// coordinates per column and row. On an oblique surface, several samples along the longer change are averaged
    /// (anisotropic filter), each as wide as the shorter change.
    fn sample(&self, at: Vec2, right: Vec2, down: Vec2) -> Vec3 {
        let size = Vec2::new(self.levels[0].width() as f32, self.levels[0].height() as f32);
        let (a, b) = ((right * size).length(), (down * size).length());
        let (long, short) = (a.max(b), a.min(b).max(1.0));
        let taps = (long / short).ceil().clamp(1.0, MAX_TAPS);
        let level = (long / taps).max(1.0).log2().min((self.levels.len() - 1) as f32);
        let way = if a > b { right } else { down };
        let tap = |tap: usize| self.level(at + way * ((tap as f32 + 0.5) / taps - 0.5), level);
        (0..taps as usize).map(tap).sum::<Vec3>() / taps
    }

    fn level(&self, at: Vec2, level: f32) -> Vec3 {
        let (low, fraction) = (level.floor() as usize, level.fract());
        let fine = bilinear(&self.levels[low], at);
        match self.levels.get(low + 1).filter(|_| fraction > 0.0) {
            Some(coarse) => fine.lerp(bilinear(coarse, at), fraction),
            None => fine,
        }
    }
}

/// Colour at the coordinates `at`, (0, 0) at the lower left. Texel centres are at +½; the texture repeats.
fn bilinear(texture: &RgbImage, at: Vec2) -> Vec3 {
    let (w, h) = (i64::from(texture.width()), i64::from(texture.height()));
    let x = at.x.rem_euclid(1.0) * w as f32 - 0.5;
    let y = (1.0 - at.y).rem_euclid(1.0) * h as f32 - 0.5;
    let (x0, y0) = (x.floor(), y.floor());
    let texel = |dx: i64, dy: i64| {
        let (x, y) = ((x0 as i64 + dx).rem_euclid(w), (y0 as i64 + dy).rem_euclid(h));
        let [r, g, b] = texture.get_pixel(x as u32, y as u32).0;
        Vec3::new(f32::from(r), f32::from(g), f32::from(b)) / 255.0
    };
    let (fx, fy) = (x - x0, y - y0);
    texel(0, 0).lerp(texel(1, 0), fx).lerp(texel(0, 1).lerp(texel(1, 1), fx), fy)
}

/// The light on a mesh's surfaces in one view.
pub enum Lit<'a> {
    /// Light that depends on the surface's normal alone.
    Plain(&'a Lights),
    /// Linear light on the front and the back of each vertex.
    Vertices(Vec<[Vec3; 2]>),
}

/// Colours of a mesh's surfaces in the view of one camera.
pub struct Shader<'a> {
    pub renderer: &'a Renderer<'a>,
    pub camera: &'a Camera,
    /// Positions in the camera's frame.
    pub corners: &'a [DVec3],
    pub light: Lit<'a>,
    /// Visible triangles.
    pub(super) triangles: Vec<Triangle>,
    /// Places of a pixel's samples; the last one is the centre.
    pub places: Vec<[i64; 2]>,
}

impl Shader<'_> {
    /// Colour of a triangle at pixel coordinates `at`.
    pub(super) fn color(&self, triangle: &Triangle, at: DVec2) -> Vec3 {
        let Renderer { mesh, normals, textures, .. } = self.renderer;
        let Triangle { plane, is_front, .. } = *triangle;
        let face = &mesh.faces[triangle.face as usize];
        let weights = self.weights(face.positions, at, plane).as_vec3();
        let mix = |values: [Vec3; 3]| values[0] * weights.x + values[1] * weights.y + values[2] * weights.z;
        // The side towards the camera is lit.
        let light = match &self.light {
            Lit::Plain(lights) => {
                let normal = mix(face.positions.map(|row| normals[row as usize])).normalize_or_zero();
                Vec3::splat(lights.strength(if is_front { normal } else { -normal }))
            }
            Lit::Vertices(light) => {
                let linear = mix(face.positions.map(|row| light[row as usize][usize::from(!is_front)]));
                // Colours are sRGB, about the 2.2nd root of linear light.
                linear.min(Vec3::ONE).map(|light| libm::powf(light, 1.0 / 2.2))
            }
        };
        let material = &mesh.materials[face.material as usize];
        let mut color = material.color * light;
        if !mesh.colors.is_empty() {
            color *= mix(face.positions.map(|row| mesh.colors[row as usize]));
        }
        if let Some((texture, rows)) = textures[face.material as usize].as_ref().zip(face.texcoords) {
            let coordinate = |at: DVec2| self.texcoord(face.positions, rows, at, plane);
            let here = coordinate(at);
            // Change per pixel, from a small step, since the step of a whole pixel may lead beyond the horizon.
            let change = |way: DVec2| ((coordinate(at + STEP * way) - here) / STEP).as_vec2();
            color *= texture.sample(here.as_vec2(), change(DVec2::X), change(DVec2::Y));
        }
        color
    }

    /// Whether the surface of a triangle is cut out at pixel coordinates `at`.
    pub(super) fn is_cut(&self, triangle: &Triangle, at: DVec2) -> bool {
        let face = &self.renderer.mesh.faces[triangle.face as usize];
        self.renderer.holes(face).is_some_and(|(opacity, rows)| {
            let at = self.texcoord(face.positions, rows, at, triangle.plane);
            let texel = |at: f64, side: u32| ((at.rem_euclid(1.0) * f64::from(side)) as u32).min(side - 1);
            opacity.get_pixel(texel(at.x, opacity.width()), texel(1.0 - at.y, opacity.height()))[0] == 0
        })
    }

    /// Texture coordinates at pixel coordinates `at`; `positions` and `rows` are the face's positions and coordinates.
    fn texcoord(&self, positions: [u32; 3], rows: [u32; 3], at: DVec2, plane: DVec3) -> DVec2 {
        let w = self.weights(positions, at, plane).to_array();
        let corners = rows.map(|row| self.renderer.mesh.texcoords[row as usize].as_dvec2());
        corners.into_iter().zip(w).map(|(corner, w)| corner * w).sum()
    }

    /// Barycentric weights of the point on the triangle's plane at pixel coordinates `at`.
    fn weights(&self, rows: [u32; 3], at: DVec2, plane: DVec3) -> DVec3 {
        let [a, b, c] = rows.map(|row| self.corners[row as usize]);
        let inverse_depth = plane.dot(DVec3::new(at.x, at.y, 1.0));
        let ray = ((at - self.camera.principal_point) / self.camera.focal).extend(1.0);
        let p = ray / inverse_depth;
        let n = (b - a).cross(c - a);
        let area = n.length_squared();
        let first = (c - b).cross(p - b).dot(n) / area;
        let second = (a - c).cross(p - c).dot(n) / area;
        let weights = DVec3::new(first, second, 1.0 - first - second);
        if weights.is_finite() { weights } else { DVec3::splat(1.0 / 3.0) }
    }
}
