//! The cameras of a user's photographs, from files and options, and the correction of the person for these cameras.

use burn::tensor::{Tensor, TensorData};
use clap::Args;
use glam::Vec3;
use snapsnap_data::photo::{ELEVATIONS, FOCALS, Mapping, Shot, Viewpoint};
use snapsnap_net::Reconstruction;
use snapsnap_splat::Gaussians;

use crate::failure::{Failure, bail};
use crate::pictures::read_back;

/// Distances beyond which a camera photographs nobody who stands upright.
const DISTANCES: std::ops::RangeInclusive<f64> = 1.0..=30.0;
/// Height of a person whose height is not given, in metres.
const USUAL: f64 = 1.72;
/// Share of the Gaussians above and below a person's height, which may be outliers.
const OUTSIDE: f64 = 0.0002;

/// Options about the cameras and the person.
#[derive(Args, Debug, Default)]
pub struct CameraArguments {
    /// Height of the person in metres [default: that of the networks, about 1.7].
    #[arg(long, value_name = "METRES")]
    height: Option<f64>,
    /// Focal length of both photographs in millimetres of 35 mm film [default: the files' own, else unknown].
    #[arg(long, value_name = "MM", conflicts_with = "distance")]
    focal: Option<f64>,
    /// Distance of both cameras in metres [default: it follows from the focal length, else 2].
    #[arg(long, value_name = "METRES")]
    distance: Option<f64>,
    /// How far both cameras look down at the person's middle, in degrees [default: what an iPhone's files say, else 8].
    #[arg(long, value_name = "DEGREES", allow_hyphen_values = true)]
    elevation: Option<f64>,
}

impl CameraArguments {
    /// Refuses impossible values, and all with photographs that are placed otherwise than a user's (`why`).
    pub fn check(&self, unplaced: Option<&str>) -> Result<(), Failure> {
        let options = [
            ("--height", self.height, 0.1..=10.0),
            ("--focal", self.focal, FOCALS),
            ("--distance", self.distance, DISTANCES),
            ("--elevation", self.elevation, ELEVATIONS),
        ];
        for (name, value, range) in options {
            let Some(value) = value else { continue };
            if !range.contains(&value) {
                bail!("{name} {value}: must be from {} to {}", range.start(), range.end());
            }
            if let Some(why) = unplaced {
                bail!("{name}: {why}");
            }
        }
        Ok(())
    }

    /// The focal length of both photographs, if it is given.
    pub fn focal(&self) -> Option<f64> {
        self.focal
    }

    /// Where the camera of a photograph stood, and how that is known. `height` is the height of the networks' person.
    fn viewpoint(
        &self,
        shot: Shot,
        picture: [u32; 2],
        mapping: &Mapping,
        side: usize,
        height: f64,
    ) -> (Viewpoint, String) {
        let nominal = Viewpoint::default();
        let tall = self.height.unwrap_or(USUAL);
        let focal = shot.focal;
        // That of a turned picture is a little shorter where the person would not fit into it.
        let told = self.focal.or(focal).unwrap_or_default();
        let whence = if self.focal.is_some() { "--focal" } else { "the file" };
        let seen = focal.map(|focal| Viewpoint::distance(focal, picture, mapping, side));
        let (distance, how) = match (self.distance, focal, seen) {
            (Some(distance), ..) => (distance * height / tall, "--distance".to_owned()),
            (None, Some(_), Some(seen)) if DISTANCES.contains(&seen) => {
                (seen, format!("{told:.0} mm of 35 mm film, {whence}"))
            }
            (None, Some(_), _) => (
                nominal.distance,
                format!("nominal: {told:.0} mm of 35 mm film, {whence}, does not fit a person of this size"),
            ),
            _ => (nominal.distance, "nominal: the focal length is unknown".to_owned()),
        };
        let pitch = shot
            .pitch
            .zip(focal)
            .map(|(pitch, focal)| Viewpoint::elevation(pitch, focal, picture, mapping, side));
        let (elevation, known) = match (self.elevation, pitch.filter(|pitch| ELEVATIONS.contains(pitch))) {
            (Some(elevation), _) => (elevation, "--elevation"),
            (None, Some(elevation)) => (elevation, "the file"),
            (None, None) => (nominal.elevation, "nominal: unknown"),
        };
        let metres = distance * tall / height;
        let assumed = if self.height.is_some() { "" } else { ", assumed" };
        let report = format!(
            "camera {metres:.2} m away ({how}; person {tall} m high{assumed}), looking down by {elevation:.1}° ({known})"
        );
        (Viewpoint { elevation, distance }, report)
    }

    /// The person as these cameras saw it, at its height, and reports about front and back. `world` contains the Gaussians of
    /// `result` with y up.
    pub fn person(
        &self,
        world: Gaussians,
        result: &Reconstruction,
        photographs: [(Shot, [u32; 2], Mapping); 2],
        side: usize,
    ) -> Result<(Gaussians, [String; 2]), Failure> {
        let mut means = read_back(world.means.clone())?;
        let [floor, top] = range(&means);
        let height = top - floor;
        let seats =
            photographs.map(|(shot, picture, mapping)| self.viewpoint(shot, picture, &mapping, side, height));
        if self.height.is_none() && seats.iter().all(|(seat, _)| *seat == Viewpoint::default()) {
            return Ok((world, seats.map(|(_, report)| report)));
        }
        let [front, back] = [seats[0].0.restorer(0.0), seats[1].0.restorer(180.0)];
        let [of_front, of_back] = result.photographed();
        for (i, mean) in means.chunks_exact_mut(3).enumerate() {
            let point = Vec3::from_slice(mean).as_dvec3();
            let is_back = i >= of_front && (i < of_front + of_back || point.z < 0.0);
            let moved = if is_back { back(point) } else { front(point) };
            mean.copy_from_slice(&moved.as_vec3().to_array());
        }
        let [low, top] = range(&means);
        // The person stands where it stood.
        means.iter_mut().skip(1).step_by(3).for_each(|y| *y += (floor - low) as f32);
        let scale = self.height.map_or(1.0, |wanted| wanted / (top - low));
        let device = world.means.device();
        let means = Tensor::from_data(TensorData::new(means, world.means.dims()), &device);
        Ok((Gaussians { means, ..world }.scaled(scale), seats.map(|(_, report)| report)))
    }
}

/// The y of the person's lowest and highest Gaussians, without outliers, in metres.
fn range(means: &[f32]) -> [f64; 2] {
    let mut heights: Vec<f32> = means.chunks_exact(3).map(|mean| mean[1]).collect();
    heights.sort_unstable_by(f32::total_cmp);
    [OUTSIDE, 1.0 - OUTSIDE].map(|share| f64::from(heights[(share * (heights.len() - 1) as f64) as usize]))
}
