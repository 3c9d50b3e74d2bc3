//! Renders meshes as subjects of a data set: config and cameras.

use std::borrow::Borrow;
use std::path::Path;
use std::sync::Arc;

use rand::Rng;
use serde::{Deserialize, Serialize};
use snapsnap_splat::{Camera, Orbit};

use crate::JitterConfig;
use crate::dataset::{Arrangement, Description, Drawn, Folder, Layout, MAX_RESOLUTION, MAX_VIEWS, Split};
use crate::light::LightConfig;
use snapsnap_base::config::{Schema, outside};
use snapsnap_base::{FileError, random};
use snapsnap_mesh::mesh::Mesh;
use snapsnap_mesh::view::{Renderer, ViewOptions};

/// Config of a data set: `configs/data/*.toml`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Views.
    pub views: ViewsConfig,
    /// Deviations of cameras from the training orbit.
    pub jitter: JitterConfig,
    /// Light.
    pub light: LightConfig,
}

/// The section `[views]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewsConfig {
    /// Views of each subject.
    pub count: usize,
    /// Evenly around the subject, or in groups of front, back and both sides.
    pub arrangement: Arrangement,
    /// Groups: largest angle, in degrees, between a group's front and the subject's own front.
    pub front_within_degrees: f64,
    /// Degrees that are added to the published cameras' pitch of 8° downwards.
    pub pitch: f64,
    /// Factor on the distance of the published cameras.
    pub distance: f64,
    /// Whether the focal length grows with the distance, so that a person is as large in a picture from afar.
    pub framed: bool,
    /// Side in pixels.
    pub resolution: u32,
    /// Whether each view is rendered at twice the side as well, for stage 2's targets.
    pub high_resolution: bool,
    /// Samples per pixel along each axis, 1 to 6.
    pub samples_per_axis: usize,
    /// Whether the depth of the second surface that faces the camera is stored as well.
    pub second_depth: bool,
    /// Layout of the stored views.
    pub layout: Layout,
}

impl Default for ViewsConfig {
    /// The published cameras in the exact layout.
    fn default() -> Self {
        Self {
            count: 24,
            arrangement: Arrangement::Ring,
            front_within_degrees: 30.0,
            pitch: 0.0,
            distance: 1.0,
            framed: false,
            resolution: 1024,
            high_resolution: false,
            samples_per_axis: 3,
            second_depth: false,
            layout: Layout::Exact,
        }
    }
}

impl Schema for DataConfig {
    fn refusal(&self) -> Option<(String, String)> {
        let ViewsConfig { count, arrangement, layout, .. } = self.views;
        let most = if self.views.high_resolution { MAX_RESOLUTION / 2 } else { MAX_RESOLUTION };
        let ranges = [
            ("count", count as f64, 1.0..=MAX_VIEWS as f64),
            ("front_within_degrees", self.views.front_within_degrees, 0.0..=180.0),
            ("pitch", self.views.pitch, -60.0..=60.0),
            ("distance", self.views.distance, 0.5..=10.0),
            ("resolution", f64::from(self.views.resolution), 1.0..=f64::from(most)),
            ("samples_per_axis", self.views.samples_per_axis as f64, 1.0..=6.0),
        ];
        if let Some((key, message)) = outside(ranges) {
            return Some((format!("views.{key}"), message));
        }
        if arrangement == Arrangement::Groups && !count.is_multiple_of(4) {
            return Some(("views.count".into(), format!("is {count}, must be a multiple of 4 in groups")));
        }
        if self.views.second_depth && layout == Layout::Authors {
            let message = "is true, which the authors' layout does not support".into();
            return Some(("views.second_depth".into(), message));
        }
        if arrangement == Arrangement::Groups && layout == Layout::Authors {
            let message = "is \"groups\", which the authors' layout does not support".into();
            return Some(("views.arrangement".into(), message));
        }
        if let Some((key, message)) = self.light.problem() {
            return Some((format!("light.{key}"), message));
        }
        self.jitter.problem(self.orbit(0.0).radius).map(|(key, message)| (format!("jitter.{key}"), message))
    }
}

impl DataConfig {
    /// Side of the largest pictures.
    pub fn largest_side(&self) -> u32 {
        if self.views.high_resolution { 2 * self.views.resolution } else { self.views.resolution }
    }

    /// Description of a data set with this config.
    pub fn description(&self, source: &str) -> Description {
        let ViewsConfig { count, arrangement, resolution, high_resolution, second_depth, layout, .. } =
            self.views;
        Description {
            layout,
            views: count,
            arrangement,
            resolution,
            high_resolution,
            second_depth,
            pixel_centre: if layout == Layout::Authors { 0.0 } else { 0.5 },
            source: source.to_owned(),
            drawn: Some(Drawn {
                samples: self.views.samples_per_axis,
                jitter: self.jitter.clone(),
                light: self.light.clone(),
            }),
        }
    }

    /// The cameras of a subject that faces `yaw_degrees` (docs/method.md, "Cameras"). `name` decides their random
    /// deviations.
    pub fn cameras(&self, yaw_degrees: f64, name: &str) -> Vec<Camera> {
        let mut random = random::stream(&format!("cameras/{name}"));
        let mut shifts = random::stream(&format!("shifts/{name}"));
        if self.views.arrangement == Arrangement::Groups {
            return (0..self.views.count / 4)
                .flat_map(|_| self.group(yaw_degrees, &mut random, &mut shifts))
                .collect();
        }
        let mut rig = self.orbit(yaw_degrees);
        self.jitter.rig.apply(&mut rig, &mut random);
        let camera = |view: usize| {
            let mut orbit = rig;
            orbit.yaw_degrees += view as f64 * 360.0 / self.views.count as f64;
            self.jitter.view.apply(&mut orbit, &mut random);
            self.jitter.rig.plus(&self.jitter.view).shifted(self.camera(orbit), &mut shifts)
        };
        (0..self.views.count).map(camera).collect()
    }

    /// The orbit of a camera without deviations.
    fn orbit(&self, yaw_degrees: f64) -> Orbit {
        let published = Orbit::default();
        Orbit {
            yaw_degrees,
            pitch_degrees: published.pitch_degrees + self.views.pitch,
            radius: published.radius * self.views.distance,
            ..published
        }
    }

    fn camera(&self, orbit: Orbit) -> Camera {
        let nominal = Orbit::default().radius;
        let zoom = if self.views.framed { orbit.radius / nominal } else { 1.0 };
        Orbit { focal: zoom * orbit.focal, ..orbit }.camera(self.views.resolution)
    }

    /// Cameras of a group. The sides' cameras are exact quarter turns of the front camera.
    fn group(&self, yaw_degrees: f64, random: &mut impl Rng, shifts: &mut impl Rng) -> [Camera; 4] {
        let front_within_degrees = self.views.front_within_degrees;
        let mut front = self.orbit(yaw_degrees);
        front.yaw_degrees += front_within_degrees * random.random_range(-1.0..1.0);
        self.jitter.rig.apply(&mut front, random);
        let mut back = Orbit { yaw_degrees: front.yaw_degrees + 180.0, ..front };
        self.jitter.view.apply(&mut back, random);
        let front = self.jitter.rig.shifted(self.camera(front), shifts);
        let back = self.jitter.rig.plus(&self.jitter.view).shifted(self.camera(back), shifts);
        [front, back, front.turned(90.0), front.turned(270.0)]
    }

    /// Makes a data set of these people, who stand on the floor at the origin and face +z.
    ///
    /// # Errors
    /// As [`Folder::create`] and [`Self::add`].
    pub fn make<M: Borrow<Mesh>>(
        &self,
        root: &Path,
        source: &str,
        people: impl IntoIterator<Item = (Split, String, M)>,
    ) -> Result<Arc<Folder>, FileError> {
        let folder = Folder::create(root, self.description(source))?;
        for (split, name, mesh) in people {
            self.add(&folder, &Subject::plain(split, &name), mesh.borrow())?;
        }
        Ok(Arc::new(folder))
    }

    /// Renders a subject and adds it to the data set. `mesh` stands on the floor at the origin. The result is false if
    /// another run is writing the subject.
    ///
    /// # Errors
    /// [`FileError`] if the mesh cannot be rendered or is outside a view (the error names the subject's origin), or if
    /// a file cannot be written.
    pub fn add(&self, folder: &Folder, subject: &Subject, mesh: &Mesh) -> Result<bool, FileError> {
        let Subject { split, name, identity, yaw_degrees, origin } = *subject;
        let renderer = Renderer::new(mesh).map_err(|e| FileError::unsuitable(origin, e))?;
        let cameras = self.cameras(yaw_degrees, identity);
        let light = self.light.draw(identity);
        let around = |camera: &Camera| camera.centre().x.atan2(camera.centre().z).to_degrees();
        let first = around(&cameras[0]);
        folder.write_subject(split, name, origin, &cameras, |camera| {
            let light = self.light.seen_from(&light, around(camera), first);
            let ViewsConfig { samples_per_axis: samples, second_depth: second, .. } = self.views;
            renderer.draw(camera, &ViewOptions { samples, light, second })
        })
    }
}

/// A subject that is added to a data set.
#[derive(Debug, Clone, Copy)]
pub struct Subject<'a> {
    /// The subject's split.
    pub split: Split,
    /// Name in the data set.
    pub name: &'a str,
    /// Name that is unique among all data sets. It seeds the light and the random deviations of the cameras.
    pub identity: &'a str,
    /// Direction in which the subject faces: the angle around +y, from +z.
    pub yaw_degrees: f64,
    /// Source of the mesh, for error messages.
    pub origin: &'a Path,
}

impl<'a> Subject<'a> {
    /// A subject that faces +z, without a source file.
    pub fn plain(split: Split, name: &'a str) -> Self {
        Self { split, name, identity: name, yaw_degrees: 0.0, origin: Path::new(name) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Jitter;

    fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    }

    #[test]
    fn without_jitter_the_cameras_are_the_published_ones() {
        let cameras = DataConfig::default().cameras(30.0, "a");
        assert_eq!(cameras.len(), 24);
        assert_eq!(cameras[0], Camera::orbit_at_yaw_degrees(30.0, 1024));
        assert_eq!(cameras[12], Camera::orbit_at_yaw_degrees(210.0, 1024));
    }

    #[test]
    fn fronts_of_groups_are_near_the_subjects_own_and_backs_deviate() {
        let mut config = DataConfig::default();
        (config.views.arrangement, config.views.count) = (Arrangement::Groups, 12);
        config.jitter.rig = Jitter { pitch: 6.0, distance: 0.1, roll: 2.0, ..Jitter::default() };
        config.jitter.view = Jitter { yaw: 5.0, pitch: 3.0, ..Jitter::default() };
        assert_eq!(config.refusal(), None);
        let cameras = config.cameras(40.0, "a");
        let yaw = |camera: &Camera| camera.centre().x.atan2(camera.centre().z).to_degrees();
        let apart = |a: f64, b: f64| (a - b + 540.0).rem_euclid(360.0) - 180.0;
        assert_eq!(cameras.len(), 12);
        for group in cameras.chunks(4) {
            let front = yaw(&group[0]);
            assert!(apart(front, 40.0).abs() < 30.1, "{front}");
            assert!(apart(yaw(&group[1]), front + 180.0).abs() < 8.0 && yaw(&group[1]) != front + 180.0);
        }
        assert!(cameras[0] != cameras[4] && cameras[4] != cameras[8]);
        config.views.count = 6;
        assert_eq!(config.refusal().expect("a problem").0, "views.count");
        (config.views.count, config.views.layout) = (8, Layout::Authors);
        assert_eq!(config.refusal().expect("a problem").0, "views.arrangement");
    }

    /// From 1.6 to 4 metres, a person has about the same size in all pictures, and is near the middle.
    #[test]
    fn framed_cameras_see_persons_of_one_size_from_any_distance() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data/phone.toml");
        let config = DataConfig::from_file(&path, &[]).expect("reads");
        let mut seen: Vec<[f64; 4]> = Vec::new();
        for name in 0..200 {
            for camera in config.cameras(0.0, &name.to_string()).chunks(4).flat_map(|four| [four[0], four[1]])
            {
                let away = camera.centre() - Orbit::default().centre;
                let pitch = (away.y / away.length()).asin().to_degrees();
                let at = |y: f64| {
                    let p = camera.world_to_camera.apply(glam::DVec3::new(0.0, y, 0.0));
                    (camera.focal * p.truncate() / p.z + camera.principal_point) / f64::from(camera.width)
                };
                let (size, place) = ((at(1.8) - at(0.0)).length(), (at(0.9) - 0.5).abs().max_element());
                seen.push([away.length(), pitch, size, place]);
            }
        }
        let of = |column: usize| range(seen.iter().map(|values| values[column]));
        let (nearest, farthest) = of(0);
        assert!((1.55..1.8).contains(&nearest) && (3.8..4.05).contains(&farthest), "{nearest} {farthest}");
        let (lowest, highest) = of(1);
        assert!((-6.5..-3.0).contains(&lowest) && (18.0..21.5).contains(&highest), "{lowest} {highest}");
        let (smallest, largest) = of(2);
        assert!(smallest > 0.55 && largest < 0.9, "{smallest} {largest}");
        let (_, farthest) = of(3);
        assert!((0.05..0.2).contains(&farthest), "{farthest}");
    }
}
