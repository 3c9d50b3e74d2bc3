//! Random deviations of cameras from the training orbit.

use glam::{DVec2, DVec3};
use rand::Rng;
use serde::{Deserialize, Serialize};
use snapsnap_splat::{Camera, Orbit};

use snapsnap_base::config::outside;

/// Least distance of a camera from its target point, metres.
const NEAREST: f64 = 1.3;

/// Uniform deviations of cameras within ± each value.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JitterConfig {
    /// All views of a subject together.
    pub rig: Jitter,
    /// Each view separately.
    pub view: Jitter,
}

/// Largest deviations to either side.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Jitter {
    /// Angle around the subject in degrees.
    pub yaw: f64,
    /// Angle up and down in degrees.
    pub pitch: f64,
    /// Angle around the optical axis in degrees.
    pub roll: f64,
    /// Distance in metres.
    pub distance: f64,
    /// Focal length, as a share of itself.
    pub focal: f64,
    /// Position of the target point in metres, per axis.
    pub look_at: f64,
    /// Principal point, as a share of the picture's side in x and in y, as if the picture was cropped.
    pub shift: f64,
}

impl JitterConfig {
    /// The first invalid key for cameras at `radius` metres, and why it is invalid.
    pub(crate) fn problem(&self, radius: f64) -> Option<(String, String)> {
        let Self { rig, view } = self;
        let sections = [("rig", rig), ("view", view), ("rig + jitter.view", &rig.plus(view))];
        sections.into_iter().find_map(|(section, jitter)| {
            jitter.problem(radius).map(|(key, message)| (format!("{section}.{key}"), message))
        })
    }
}

impl Jitter {
    fn problem(&self, radius: f64) -> Option<(&'static str, String)> {
        let Self { yaw, pitch, roll, distance, focal, look_at, shift } = *self;
        outside([
            ("yaw", yaw, 0.0..=180.0),
            ("pitch", pitch, 0.0..=80.0),
            ("roll", roll, 0.0..=180.0),
            // Larger deviations would put the camera into the subject, or the subject out of view.
            ("distance", distance, 0.0..=(radius - NEAREST).max(0.0)),
            ("focal", focal, 0.0..=0.5),
            ("look_at", look_at, 0.0..=0.5),
            ("shift", shift, 0.0..=0.25),
        ])
    }

    /// Sums the deviations whose sum is limited. Yaw and roll are not limited, and are 0 in the sum.
    pub(crate) fn plus(&self, other: &Self) -> Self {
        Self {
            yaw: 0.0,
            pitch: self.pitch + other.pitch,
            roll: 0.0,
            distance: self.distance + other.distance,
            focal: self.focal + other.focal,
            look_at: self.look_at + other.look_at,
            shift: self.shift + other.shift,
        }
    }

    /// Moves the principal point of a camera at random.
    pub(crate) fn shifted(&self, camera: Camera, random: &mut impl Rng) -> Camera {
        let mut stray = || self.shift * f64::from(camera.width) * random.random_range(-1.0..1.0);
        let principal_point = camera.principal_point + DVec2::new(stray(), stray());
        Camera { principal_point, ..camera }
    }

    /// Moves the camera of an orbit at random, except for its principal point.
    pub(crate) fn apply(&self, orbit: &mut Orbit, random: &mut impl Rng) {
        // A range of 0 also draws a random number, so that the numbers of the other ranges do not change.
        let mut stray = |range: f64| range * random.random_range(-1.0..1.0);
        orbit.yaw_degrees += stray(self.yaw);
        orbit.pitch_degrees += stray(self.pitch);
        orbit.roll_degrees += stray(self.roll);
        orbit.radius += stray(self.distance);
        orbit.focal *= 1.0 + stray(self.focal);
        orbit.centre += DVec3::new(stray(self.look_at), stray(self.look_at), stray(self.look_at));
    }
}
