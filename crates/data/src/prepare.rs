//! From a mesh to a subject of a data set: which cameras, which names, which machine.

use std::path::Path;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use snapsnap_splat::{Camera, Orbit};

use crate::JitterConfig;
use crate::dataset::{Description, Drawn, Folder, Layout, MAX_RESOLUTION, MAX_VIEWS, Made, Split};
use crate::sample::SampleConfig;
use snapsnap_mesh::FileError;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_mesh::view::{Lights, Renderer, ViewOptions};
use snapsnap_people::random::stream;

/// How subjects become views, and views samples: `configs/data/*.toml`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Which views.
    pub views: ViewsConfig,
    /// How cameras stray from the training orbit.
    pub jitter: JitterConfig,
    /// How training makes samples of the views; nothing to `prepare`.
    pub samples: SampleConfig,
}

/// Which views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewsConfig {
    /// Views of each subject, evenly around it.
    pub count: usize,
    /// Side in pixels.
    pub resolution: u32,
    /// Whether each view is drawn at twice the side as well, for stage 2's supervision.
    pub high_resolution: bool,
    /// Samples per pixel along each axis, 1 to 6.
    pub samples: usize,
    /// How views are stored.
    pub layout: Layout,
}

impl Default for ViewsConfig {
    /// The published cameras in our exact layout.
    fn default() -> Self {
        Self { count: 24, resolution: 1024, high_resolution: false, samples: 3, layout: Layout::Exact }
    }
}

impl DataConfig {
    /// The first key that makes no sense, and why.
    pub fn problem(&self) -> Option<(String, String)> {
        let ViewsConfig { count, resolution, samples, .. } = self.views;
        if count == 0 || count > MAX_VIEWS {
            return Some(("views.count".into(), format!("is {count}, must be 1 to {MAX_VIEWS}")));
        }
        let most = if self.views.high_resolution { MAX_RESOLUTION / 2 } else { MAX_RESOLUTION };
        if resolution == 0 || resolution > most {
            return Some(("views.resolution".into(), format!("is {resolution}, must be 1 to {most}")));
        }
        if !(1..=6).contains(&samples) {
            return Some(("views.samples".into(), format!("is {samples}, must be 1 to 6")));
        }
        let jitter = self.jitter.problem().map(|(key, message)| (format!("jitter.{key}"), message));
        jitter.or_else(|| self.samples.problem().map(|(key, message)| (format!("samples.{key}"), message)))
    }

    /// The config as TOML, every key written out.
    ///
    /// # Panics
    /// Never: every field is representable in TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("the config has only TOML types")
    }

    /// What a data set made with this config says of itself.
    pub fn description(&self, source: &str) -> Description {
        let ViewsConfig { count, resolution, high_resolution, layout, .. } = self.views;
        Description {
            layout,
            views: count,
            resolution,
            high_resolution,
            pixel_centre: if layout == Layout::Authors { 0.0 } else { 0.5 },
            source: source.to_owned(),
            drawn: Some(Drawn { samples: self.views.samples, jitter: self.jitter.clone() }),
        }
    }

    /// The cameras of a subject that faces `yaw_degrees` (SNAPSNAP §5.3), straying as `name` decides.
    pub fn cameras(&self, yaw_degrees: f64, name: &str) -> Vec<Camera> {
        let mut random = stream(&format!("cameras/{name}"));
        let mut rig = Orbit { yaw_degrees, ..Orbit::default() };
        self.jitter.rig.apply(&mut rig, &mut random);
        (0..self.views.count)
            .map(|view| {
                let mut orbit = rig;
                orbit.yaw_degrees += view as f64 * 360.0 / self.views.count as f64;
                self.jitter.view.apply(&mut orbit, &mut random);
                orbit.camera(self.views.resolution)
            })
            .collect()
    }

    /// Draws and adds a subject. `mesh` stands on the floor at the origin.
    ///
    /// # Errors
    /// [`FileError`] for a mesh that cannot be drawn or that a camera does not see, naming its origin, and for files that
    /// cannot be written.
    pub fn add(&self, folder: &Folder, subject: &Subject, mesh: &Mesh) -> Result<Made, FileError> {
        let Subject { split, name, identity, yaw_degrees, origin } = *subject;
        let renderer = Renderer::new(mesh).map_err(|e| FileError::unsuitable(origin, e))?;
        let options = ViewOptions { samples: self.views.samples, lights: Lights::default() };
        let cameras = self.cameras(yaw_degrees, identity);
        folder.write_subject(split, name, origin, &cameras, |camera| renderer.draw(camera, &options))
    }
}

/// A subject to be added.
#[derive(Debug, Clone, Copy)]
pub struct Subject<'a> {
    /// Where it belongs.
    pub split: Split,
    /// Its name in the data set.
    pub name: &'a str,
    /// Its name among all data sets, which decides what is random about its cameras.
    pub identity: &'a str,
    /// Where it faces, around y.
    pub yaw_degrees: f64,
    /// What it was made of: the file that errors name.
    pub origin: &'a Path,
}

impl<'a> Subject<'a> {
    /// A subject that faces +z, of no file.
    pub fn plain(split: Split, name: &'a str) -> Self {
        Self { split, name, identity: name, yaw_degrees: 0.0, origin: Path::new(name) }
    }
}

/// One of several machines that share the work: `i/n`, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Default for Shard {
    fn default() -> Self {
        Self { index: 0, count: 1 }
    }
}

impl Shard {
    /// Whether the subject at this place is this machine's.
    pub fn has(self, place: usize) -> bool {
        place % self.count == self.index
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, count)) if index < count => Ok(Self { index, count }),
            _ => Err(format!("`{text}` is no shard: expected i/n, with i from 0 to n − 1")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Jitter;

    #[test]
    fn without_jitter_the_cameras_are_the_published_ones() {
        let cameras = DataConfig::default().cameras(30.0, "a");
        assert_eq!(cameras.len(), 24);
        assert_eq!(cameras[0], Camera::orbit_at_yaw_degrees(30.0, 1024));
        assert_eq!(cameras[12], Camera::orbit_at_yaw_degrees(210.0, 1024));
    }

    #[test]
    fn jitter_stays_in_its_ranges_and_follows_the_name() {
        let jitter = Jitter { yaw: 5.0, pitch: 4.0, roll: 3.0, distance: 0.2, focal: 0.1, look_at: 0.05 };
        let mut config = DataConfig::default();
        config.jitter.view = jitter;
        let cameras = |name: &str| config.cameras(0.0, name);
        assert_eq!(cameras("a"), cameras("a"));
        assert_ne!(cameras("a"), cameras("b"));
        let (mut nearest, mut furthest, mut shortest, mut longest) = (9.0_f64, 0.0_f64, 9.0_f64, 0.0_f64);
        for camera in (0..40).flat_map(|i| cameras(&i.to_string())) {
            let distance = (camera.centre() - Orbit::default().centre).length();
            (nearest, furthest) = (nearest.min(distance), furthest.max(distance));
            let focal = camera.focal.x / 1024.0;
            (shortest, longest) = (shortest.min(focal), longest.max(focal));
        }
        assert!(nearest > 1.7 && furthest < 2.3 && furthest - nearest > 0.4, "{nearest} {furthest}");
        assert!(shortest >= 0.72 && longest <= 0.88 && longest - shortest > 0.15, "{shortest} {longest}");
        assert_eq!(config.problem(), None);
        config.jitter.rig.focal = 0.6;
        assert_eq!(config.problem(), Some(("jitter.rig.focal".into(), "is 0.6, must be 0 to 0.5".into())));
    }

    #[test]
    fn shards_share_the_work() {
        let shards: Vec<Shard> = ["0/3", "1/3", "2/3"].map(|s| s.parse().expect("a shard")).to_vec();
        for place in 0..10 {
            assert_eq!(shards.iter().filter(|shard| shard.has(place)).count(), 1);
        }
        for wrong in ["", "1", "3/3", "0/0", "-1/2", "1/2/3"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
