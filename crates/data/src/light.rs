//! Random light of a subject's views.

use glam::Vec3;
use rand::Rng;
use serde::{Deserialize, Serialize};
use snapsnap_base::{config, random};
use snapsnap_mesh::view::{Lamp, Light, Surroundings};

/// How a subject is lit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// The same weak lights all around, without shadows.
    #[default]
    Even,
    /// Random lamps and a sky for each subject, with shadows.
    Random,
}

/// The camera with which random light moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Follows {
    /// The camera of each view, as if the person turned in front of one camera.
    #[default]
    Camera,
    /// The camera of the first view, as if one camera moved around the person.
    First,
}

/// The section `[light]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LightConfig {
    /// Even or random.
    pub kind: Kind,
    /// The camera with which random light moves.
    pub follows: Follows,
    /// Largest number of lamps. Each subject has at least one.
    pub lamps: usize,
    /// Range of the contrast: the luminance of a surface in its brightest direction over its luminance in the darkest
    /// direction, before shadows. Pixel values differ less: by the 2.2nd root of the contrast.
    pub contrast: [f32; 2],
    /// Largest deviation of the channels of a lamp's colour, as a share.
    pub color: f32,
    /// Another seed gives the same people other light.
    pub seed: u64,
}

impl Default for LightConfig {
    fn default() -> Self {
        let (kind, follows) = (Kind::default(), Follows::default());
        Self { kind, follows, lamps: 3, contrast: [1.5, 50.0], color: 0.2, seed: 0 }
    }
}

impl LightConfig {
    /// The first invalid key, and why it is invalid.
    pub(crate) fn problem(&self) -> Option<(&'static str, String)> {
        let [low, high] = self.contrast.map(f64::from);
        config::outside([
            ("lamps", self.lamps as f64, 1.0..=8.0),
            ("contrast", low, 1.05..=100.0),
            ("contrast", high, low.max(1.05)..=100.0),
            ("color", f64::from(self.color), 0.0..=0.9),
        ])
    }

    /// The light of a subject, for a camera that looks along −z.
    pub(crate) fn draw(&self, identity: &str) -> Light {
        let random = &mut random::stream(&format!("light/{}/{identity}", self.seed));
        if self.kind == Kind::Even {
            return Light::default();
        }
        let mut between = |low: f32, high: f32| low + (high - low) * random.random_range(0.0..1.0_f32);
        let tint = |a: f32, b: f32| Vec3::new(1.0 + a, 1.0, 1.0 + b);
        let count = between(1.0, self.lamps as f32 + 1.0).min(self.lamps as f32) as usize;
        let lamps = (0..count).map(|lamp| {
            let (azimuth, elevation) = (between(-125.0, 125.0), between(-5.0, 75.0));
            let ((sin, cos), (up, level)) =
                (libm::sincosf(azimuth.to_radians()), libm::sincosf(elevation.to_radians()));
            let strength = if lamp == 0 { 1.0 } else { between(0.15, 0.9) };
            let color = strength * tint(between(-self.color, self.color), between(-self.color, self.color));
            Lamp { direction: Vec3::new(level * sin, up, level * cos), color, radius: between(0.12, 0.7) }
        });
        let lamps = lamps.collect();
        let warm = between(-0.5, 0.5) * self.color;
        let ground = between(0.3, 1.0) * tint(-between(-0.5, 0.5) * self.color, -warm);
        // Uniform in the logarithm of the contrast.
        let [low, high] = self.contrast;
        let contrast = low * libm::powf(high / low, between(0.0, 1.0));
        Light::Around(Surroundings::new(lamps, [tint(-warm, warm), ground], contrast))
    }

    /// The light of a view from `degrees` around the subject, whose first view is from `first` degrees.
    pub(crate) fn seen_from(&self, light: &Light, degrees: f64, first: f64) -> Light {
        let degrees = if self.follows == Follows::Camera { degrees } else { first };
        match light {
            Light::Plain(_) => light.clone(),
            Light::Around(surroundings) => Light::Around(surroundings.turned(degrees as f32)),
        }
    }
}
