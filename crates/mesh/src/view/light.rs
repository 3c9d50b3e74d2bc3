//! Lights: soft directional lights without shadows, and surroundings with shadows cast by the mesh itself.

use std::f32::consts::{PI, TAU};

use glam::{Mat3, Vec3};

/// Number of pairs of opposite directions from which light is summed.
pub const PAIRS: usize = 96;
/// Number of directions.
pub const WAYS: usize = 2 * PAIRS;
/// Weight of one direction: light of 1 from all directions is reflected as 1.
pub const SHARE: f32 = 4.0 / WAYS as f32;

/// The light in a view.
#[derive(Debug, Clone)]
pub enum Light {
    /// Soft lights that cast no shadows.
    Plain(Lights),
    /// Light from all around, with shadows and ambient occlusion.
    Around(Surroundings),
}

impl Default for Light {
    fn default() -> Self {
        Self::Plain(Lights::default())
    }
}

/// Soft directional lights, scaled so that a surface in the brightest direction shows exactly its own colour. No
/// surface is clipped.
#[derive(Debug, Clone)]
pub struct Lights {
    /// Unit vector towards each light in world axes, and its strength.
    directional: Vec<(Vec3, f32)>,
    /// Ambient light.
    ambient: f32,
}

impl Lights {
    /// Lights of these directions and strengths, and ambient light, all scaled by one factor.
    pub fn new(directional: &[(Vec3, f32)], ambient: f32) -> Self {
        let directional = directional.iter().map(|(d, s)| (d.normalize_or_zero(), *s)).collect();
        let mut lights = Self { directional, ambient };
        let brightest = directions(4000).map(|d| lights.sum(d)).fold(f32::MIN_POSITIVE, f32::max);
        lights.ambient /= brightest;
        lights.directional.iter_mut().for_each(|(_, strength)| *strength /= brightest);
        lights
    }

    /// Light that a surface with this unit normal reflects, 0 to 1.
    pub fn strength(&self, normal: Vec3) -> f32 {
        // A direction between the sampled ones may be brighter by less than one step of 8 bits.
        self.sum(normal).min(1.0)
    }

    fn sum(&self, normal: Vec3) -> f32 {
        let soft = |(direction, strength): &(Vec3, f32)| {
            // The light of an area reaches a little beyond the terminator.
            let cosine = (normal.dot(*direction) + 0.3) / 1.3;
            strength * cosine.max(0.0)
        };
        self.ambient + self.directional.iter().map(soft).sum::<f32>()
    }
}

impl Default for Lights {
    /// Six weak lights all around, from above, and a stronger one.
    fn default() -> Self {
        let weak = |i: i32| {
            let (sin, cos) = (TAU * i as f32 / 6.0).sin_cos();
            (Vec3::new(sin, 0.6, cos), 0.25)
        };
        let strong = (Vec3::new(0.4, 0.8, 0.9), 0.35);
        Self::new(&(0..6).map(weak).chain([strong]).collect::<Vec<_>>(), 0.5)
    }
}

/// Unit vectors of a Fibonacci lattice on the sphere, from the top down.
fn directions(count: usize) -> impl Iterator<Item = Vec3> {
    let golden = TAU * (1.0 - 1.0 / 1.618_034);
    (0..count).map(move |i| {
        let y = 1.0 - (2 * i + 1) as f32 / count as f32;
        let (sin, cos) = libm::sincosf(golden * i as f32);
        let r = (1.0 - y * y).sqrt();
        Vec3::new(r * cos, y, r * sin)
    })
}

/// The directions from which light is summed. The second half are the opposites of the first, in the same order.
pub fn ways() -> Vec<Vec3> {
    // The upper hemisphere of an even distribution.
    let upper = || directions(WAYS).take(PAIRS);
    upper().chain(upper().map(|way| -way)).collect()
}

/// A distant area light.
#[derive(Debug, Clone, Copy)]
pub struct Lamp {
    /// Unit vector towards it.
    pub direction: Vec3,
    /// Linear red, green and blue of its light.
    pub color: Vec3,
    /// Angular radius in radians, at which the light falls to 1/e.
    pub radius: f32,
}

/// Light from all around: lamps, and a sky with one colour above and one below. An unshadowed surface in the
/// brightest direction shows exactly its own colour.
#[derive(Debug, Clone)]
pub struct Surroundings {
    lamps: Vec<Lamp>,
    /// Linear light from straight above and straight below.
    sky: [Vec3; 2],
}

impl Surroundings {
    /// Scales the sky so that, without shadows, the luminance of the brightest direction is `contrast` times the
    /// luminance of the darkest. Then scales all light so that no channel of any direction exceeds 1. The contrast of
    /// the lamps alone is the upper limit.
    pub fn new(mut lamps: Vec<Lamp>, sky: [Vec3; 2], contrast: f32) -> Self {
        for lamp in &mut lamps {
            lamp.direction = lamp.direction.normalize_or(Vec3::Y);
            // The total light of a lamp does not depend on its size.
            lamp.color *= 1.0 / (PI * lamp.radius * lamp.radius).min(TAU);
        }
        let ways = ways();
        // Light that a white surface reflects, for each direction as its normal.
        let reflected = |surroundings: &Self| -> Vec<Vec3> {
            let light = ways.iter().map(|d| surroundings.from(*d)).collect::<Vec<_>>();
            let sum = |normal: &Vec3| {
                let parts = ways.iter().zip(&light).map(|(d, light)| normal.dot(*d).max(0.0) * *light);
                parts.sum::<Vec3>() * SHARE
            };
            ways.iter().map(sum).collect()
        };
        let mut found = Self { lamps, sky };
        // Bisection: a stronger sky lowers the contrast.
        let (mut weak, mut strong) = (0.0_f32, 64.0_f32);
        for _ in 0..24 {
            let middle = 0.5 * (weak + strong);
            found.sky = sky.map(|s| s * middle);
            let all = reflected(&found).into_iter().map(luminance);
            let (darkest, brightest) =
                all.fold((f32::INFINITY, 0.0_f32), |(low, high), v| (low.min(v), high.max(v)));
            if brightest > contrast * darkest { weak = middle } else { strong = middle }
        }
        let brightest = reflected(&found).iter().map(|v| v.max_element()).fold(f32::MIN_POSITIVE, f32::max);
        found.sky = found.sky.map(|s| s / brightest);
        found.lamps.iter_mut().for_each(|lamp| lamp.color /= brightest);
        found
    }

    /// The surroundings, rotated around the vertical axis like a camera that moves by this angle around the person.
    #[must_use]
    pub fn turned(&self, degrees: f32) -> Self {
        let (sin, cos) = libm::sincosf(degrees.to_radians());
        let turn = Mat3::from_cols(Vec3::new(cos, 0.0, -sin), Vec3::Y, Vec3::new(sin, 0.0, cos));
        let lamps =
            self.lamps.iter().map(|lamp| Lamp { direction: turn * lamp.direction, ..*lamp }).collect();
        Self { lamps, sky: self.sky }
    }

    /// Linear light from a direction.
    pub(super) fn from(&self, direction: Vec3) -> Vec3 {
        let lamps = self.lamps.iter().map(|lamp| {
            let away = (1.0 - lamp.direction.dot(direction)).max(0.0);
            lamp.color * libm::expf(-2.0 * away / (lamp.radius * lamp.radius))
        });
        let up = 0.5 + 0.5 * direction.y;
        self.sky[1].lerp(self.sky[0], up) + lamps.sum::<Vec3>()
    }
}

fn luminance(linear: Vec3) -> f32 {
    linear.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}
