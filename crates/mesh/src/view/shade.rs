//! Light and textures.

use std::f32::consts::TAU;
use std::sync::Arc;

use glam::{DVec2, DVec3, Vec2, Vec3};
use image::RgbImage;
use snapsnap_splat::Camera;

use super::Renderer;

/// Soft directional lights. Together they are so strong that the brightest direction reflects exactly the surface's own
/// colour, and none is clipped.
#[derive(Debug, Clone)]
pub struct Lights {
    /// Unit vectors towards the lights, world axes, and their strengths.
    directional: Vec<(Vec3, f32)>,
    /// Light from everywhere.
    ambient: f32,
}

impl Lights {
    /// Scales these directions with strengths, and the light from everywhere, as a whole.
    pub fn new(directional: &[(Vec3, f32)], ambient: f32) -> Self {
        let directional = directional.iter().map(|(d, s)| (d.normalize_or_zero(), *s)).collect();
        let mut lights = Self { directional, ambient };
        // The brightest of many directions, evenly spread over the sphere.
        let count = 4000;
        let golden = TAU * (1.0 - 1.0 / 1.618_034);
        let brightest = (0..count)
            .map(|i| {
                let y = 1.0 - (2 * i + 1) as f32 / count as f32;
                let (sin, cos) = (golden * i as f32).sin_cos();
                let r = (1.0 - y * y).sqrt();
                lights.sum(Vec3::new(r * cos, y, r * sin))
            })
            .fold(f32::MIN_POSITIVE, f32::max);
        lights.ambient /= brightest;
        lights.directional.iter_mut().for_each(|(_, strength)| *strength /= brightest);
        lights
    }

    /// Light that a surface with this unit normal reflects, 0 to 1.
    pub fn strength(&self, normal: Vec3) -> f32 {
        // A direction between the sampled ones may be brighter, by less than a shade of 8 bits.
        self.sum(normal).min(1.0)
    }

    fn sum(&self, normal: Vec3) -> f32 {
        let soft = |(direction, strength): &(Vec3, f32)| {
            // Light from an area reaches a little beyond the terminator.
            let cosine = (normal.dot(*direction) + 0.3) / 1.3;
            strength * cosine.max(0.0)
        };
        self.ambient + self.directional.iter().map(soft).sum::<f32>()
    }
}

impl Default for Lights {
    /// Six weak lights all around, from above, and one stronger.
    fn default() -> Self {
        let mut directional: Vec<(Vec3, f32)> = (0..6)
            .map(|i| {
                let (sin, cos) = (TAU * i as f32 / 6.0).sin_cos();
                (Vec3::new(sin, 0.6, cos), 0.25)
            })
            .collect();
        directional.push((Vec3::new(0.4, 0.8, 0.9), 0.35));
        Self::new(&directional, 0.5)
    }
}

/// Step in pixels for the derivative of texture coordinates.
const STEP: f64 = 0.01;
/// Most samples of a texture for one pixel.
const MAX_TAPS: f32 = 8.0;

/// A texture and its reductions, each half as large as the one before.
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

    /// Colour at the texture coordinates `at`, filtered over a pixel. `right` and `down` are the changes of the coordinates
    /// from one column and row to the next. On an oblique surface, several samples lie along the longer of them, each no
    /// wider than the shorter one.
    fn sample(&self, at: Vec2, right: Vec2, down: Vec2) -> Vec3 {
        let size = Vec2::new(self.levels[0].width() as f32, self.levels[0].height() as f32);
        let (a, b) = ((right * size).length(), (down * size).length());
        let (long, short) = (a.max(b), a.min(b).max(1.0));
        let taps = (long / short).ceil().clamp(1.0, MAX_TAPS);
        let level = (long / taps).max(1.0).log2().min((self.levels.len() - 1) as f32);
        let way = if a > b { right } else { down };
        let sum: Vec3 = (0..taps as usize)
            .map(|tap| self.level(at + way * ((tap as f32 + 0.5) / taps - 0.5), level))
            .sum();
        sum / taps
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

/// Colours of a mesh's surfaces in the view of one camera.
pub struct Shader<'a> {
    pub renderer: &'a Renderer<'a>,
    pub camera: &'a Camera,
    /// Positions in the camera's frame.
    pub corners: &'a [DVec3],
    pub lights: &'a Lights,
}

impl Shader<'_> {
    /// Colour of `face` at pixel coordinates `at`; `plane` gives 1/z there.
    pub fn color(&self, face: usize, at: DVec2, plane: DVec3) -> Vec3 {
        let Renderer { mesh, normals, textures } = self.renderer;
        let face = &mesh.faces[face];
        let weights = self.weights(face.positions, at, plane).as_vec3();
        let mix = |values: [Vec3; 3]| values[0] * weights.x + values[1] * weights.y + values[2] * weights.z;
        let mut normal = mix(face.positions.map(|row| normals[row as usize])).normalize_or_zero();
        // The visible side of the surface is lit.
        let corners = face.positions.map(|row| self.corners[row as usize]);
        let towards = (corners[1] - corners[0]).cross(corners[2] - corners[0]).dot(corners[0]);
        if towards > 0.0 {
            normal = -normal;
        }
        let material = &mesh.materials[face.material as usize];
        let mut color = material.color * self.lights.strength(normal);
        if !mesh.colors.is_empty() {
            color *= mix(face.positions.map(|row| mesh.colors[row as usize]));
        }
        if let Some((texture, rows)) = textures[face.material as usize].as_ref().zip(face.texcoords) {
            let coordinates = rows.map(|row| mesh.texcoords[row as usize].as_dvec2());
            let coordinate = |at: DVec2| {
                let w = self.weights(face.positions, at, plane);
                coordinates[0] * w.x + coordinates[1] * w.y + coordinates[2] * w.z
            };
            let here = coordinate(at);
            // Change per pixel, from a small step, since a whole one may lead beyond the horizon.
            let change = |way: DVec2| ((coordinate(at + STEP * way) - here) / STEP).as_vec2();
            color *= texture.sample(here.as_vec2(), change(DVec2::X), change(DVec2::Y));
        }
        color
    }

    /// Barycentric weights of the point of the triangle's plane at pixel coordinates `at`.
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
