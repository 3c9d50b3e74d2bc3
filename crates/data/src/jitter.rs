//! How cameras stray from the training orbit.

use glam::DVec3;
use rand::Rng;
use serde::{Deserialize, Serialize};
use snapsnap_splat::Orbit;

/// How cameras stray, evenly within ± each value: all views of a subject together (`rig`), and each by itself (`view`).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JitterConfig {
    /// All views of a subject together.
    pub rig: Jitter,
    /// Each view by itself.
    pub view: Jitter,
}

/// Ranges, each ±.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Jitter {
    /// Around the subject, degrees.
    pub yaw: f64,
    /// Up and down, degrees.
    pub pitch: f64,
    /// Around the optical axis, degrees.
    pub roll: f64,
    /// Metres.
    pub distance: f64,
    /// Share of the focal length.
    pub focal: f64,
    /// Of the point looked at, metres per axis.
    pub look_at: f64,
}

impl JitterConfig {
    /// The first key that makes no sense, and why.
    pub(crate) fn problem(&self) -> Option<(String, String)> {
        let Self { rig, view } = self;
        let sections = [("rig", rig), ("view", view), ("rig + jitter.view", &rig.plus(view))];
        sections.into_iter().find_map(|(section, jitter)| {
            jitter.problem().map(|(key, message)| (format!("{section}.{key}"), message))
        })
    }
}

impl Jitter {
    fn problem(&self) -> Option<(&'static str, String)> {
        let Self { yaw, pitch, roll, distance, focal, look_at } = *self;
        let limits = [
            ("yaw", yaw, 180.0),
            ("pitch", pitch, 80.0),
            ("roll", roll, 180.0),
            // Beyond these the camera would stand in the subject, or see nothing of it.
            ("distance", distance, 0.7),
            ("focal", focal, 0.5),
            ("look_at", look_at, 0.5),
        ];
        let (key, value, limit) =
            limits.into_iter().find(|(_, value, limit)| !(0.0..=*limit).contains(value))?;
        Some((key, format!("is {value}, must be 0 to {limit}")))
    }

    /// How far both can stray together.
    fn plus(&self, other: &Self) -> Self {
        Self {
            yaw: 0.0,
            pitch: self.pitch + other.pitch,
            roll: 0.0,
            distance: self.distance + other.distance,
            focal: self.focal + other.focal,
            look_at: self.look_at + other.look_at,
        }
    }

    /// Moves a camera, at random.
    pub(crate) fn apply(&self, orbit: &mut Orbit, random: &mut impl Rng) {
        // Drawn even where the range is 0, so that one range does not change what another draws.
        let mut stray = |range: f64| range * random.random_range(-1.0..1.0);
        orbit.yaw_degrees += stray(self.yaw);
        orbit.pitch_degrees += stray(self.pitch);
        orbit.roll_degrees += stray(self.roll);
        orbit.radius += stray(self.distance);
        orbit.focal *= 1.0 + stray(self.focal);
        orbit.centre += DVec3::new(stray(self.look_at), stray(self.look_at), stray(self.look_at));
    }
}
