//! Makes a person of photographs on their canvases, and restores it to its height and to the real cameras.

use std::fmt;
use std::ops::RangeInclusive;

use burn::tensor::Tensor;
use serde::Serialize;
use snapsnap_net::config::{Config, WorldFrame};
use snapsnap_net::steps::Step;
use snapsnap_net::{Reconstruction, Reconstructor, placed};
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use crate::Photographs;
use crate::exif_camera::{ELEVATIONS, Frame, Viewpoint};
use crate::restoration::Restoration;
use crate::source::Placement;
use crate::surface::reconstruct;

/// Plausible distances of a camera from a standing person, in metres.
pub const DISTANCES: RangeInclusive<f64> = 1.0..=30.0;
/// Assumed height of a person whose height is not given, in metres.
const USUAL: f64 = 1.72;
/// Largest height of a person over its height in the nominal cameras, with the same pictures. From 60° above and two
/// metres away it is 3.1.
const TALLEST: f64 = 4.0;

/// What a user says of the photographs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Told {
    /// The photographs are the canvases already.
    pub as_is: bool,
    /// Height of the person in metres.
    pub height: Option<f64>,
    /// Focal length of the photographs in millimetres of 35 mm film.
    pub focal: Option<f64>,
    /// Distance of the cameras in metres.
    pub distance: Option<f64>,
    /// How far the cameras look down at the person's middle, in degrees.
    pub elevation: Option<f64>,
}

impl Told {
    /// The placement for the networks of a config.
    pub fn placement(&self, config: &Config) -> Placement {
        let height = config.person_height();
        match (self.as_is, config.mode.compat) {
            (true, _) => Placement::AsIs,
            (_, true) => Placement::Demo { height },
            _ => Placement::Training { height },
        }
    }

    /// The reason why cameras and heights have no effect with the networks of a config, if there is one.
    pub fn unplaced(&self, config: &Config) -> Option<Unplaced> {
        match self.placement(config) {
            Placement::AsIs => Some(Unplaced::AsIs),
            Placement::Demo { .. } => Some(Unplaced::Compat),
            Placement::Training { .. } => {
                (config.world_frame() == WorldFrame::Mirrored).then_some(Unplaced::Mirrored)
            }
        }
    }

    /// Where the camera of a photograph stood. The networks' person is `height` metres high, the canvas `side` pixels.
    fn seat(&self, frame: &Frame, side: usize, height: f64) -> Seat {
        let nominal = Viewpoint::default();
        let tall = self.height.unwrap_or(USUAL);
        let focal = frame.shot.focal;
        let seen = focal.map(|focal| Viewpoint::distance(focal, frame, side));
        // Turning may shorten the focal length so that the person fits. A told focal length is reported unchanged.
        let lens = Lens { focal: self.focal.or(focal).unwrap_or_default(), told: self.focal.is_some() };
        let (distance, distance_by) = match (self.distance, seen) {
            (Some(distance), _) => (distance * height / tall, DistanceBy::Told),
            (None, Some(seen)) if DISTANCES.contains(&seen) => (seen, DistanceBy::Lens(lens)),
            (None, Some(_)) => (nominal.distance, DistanceBy::Misfit(lens)),
            (None, None) => (nominal.distance, DistanceBy::Unknown),
        };
        let pitch = frame.shot.pitch.zip(focal);
        let pitch = pitch.map(|(pitch, focal)| Viewpoint::elevation(pitch, focal, frame, side));
        let is_possible = |elevation: &f64| {
            ELEVATIONS.contains(elevation)
                && Viewpoint { elevation: *elevation, distance }.stretch() <= TALLEST
        };
        let (elevation, elevation_by) = match (self.elevation, pitch.filter(is_possible)) {
            (Some(elevation), _) => (elevation, ElevationBy::Told),
            (None, Some(elevation)) => (elevation, ElevationBy::File),
            (None, None) => (nominal.elevation, ElevationBy::Unknown),
        };
        Seat {
            viewpoint: Viewpoint { elevation, distance },
            distance: distance * tall / height,
            distance_by,
            height: tall,
            height_assumed: self.height.is_none(),
            elevation,
            elevation_by,
        }
    }
}

/// Why cameras and heights have no effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unplaced {
    /// The photographs are the canvases: their cameras are the nominal ones.
    AsIs,
    /// The weights have the published demo's cameras.
    Compat,
    /// The world is mirrored.
    Mirrored,
}

/// Where a camera stood, and how that is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Seat {
    /// Elevation and distance relative to the person of the networks.
    #[serde(skip)]
    pub viewpoint: Viewpoint,
    /// Distance in metres from a person of `height`.
    pub distance: f64,
    /// How the distance is known.
    pub distance_by: DistanceBy,
    /// Height of the person in metres.
    pub height: f64,
    /// Whether the height was not told.
    pub height_assumed: bool,
    /// How far the camera looks down at the person's middle, in degrees.
    pub elevation: f64,
    /// How the elevation is known.
    pub elevation_by: ElevationBy,
}

/// How a distance is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "by", rename_all = "kebab-case")]
pub enum DistanceBy {
    /// The user told it.
    Told,
    /// It follows from the focal length.
    Lens(Lens),
    /// The nominal distance: the focal length does not fit a person of this size.
    Misfit(Lens),
    /// The nominal distance: the focal length is unknown.
    Unknown,
}

/// A focal length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Lens {
    /// Millimetres of 35 mm film.
    pub focal: f64,
    /// Whether the user told the focal length; otherwise it is the file's.
    pub told: bool,
}

impl fmt::Display for Lens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.0} mm of 35 mm film, {}", self.focal, if self.told { "--focal" } else { "the file" })
    }
}

/// How an elevation is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ElevationBy {
    /// The user told it.
    Told,
    /// The file says it.
    File,
    /// The nominal elevation: nothing is known.
    Unknown,
}

impl fmt::Display for Seat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { distance, distance_by, height, height_assumed, elevation, elevation_by, .. } = self;
        write!(f, "camera {distance:.2} m away (")?;
        match distance_by {
            DistanceBy::Told => write!(f, "--distance")?,
            DistanceBy::Lens(lens) => write!(f, "{lens}")?,
            DistanceBy::Misfit(lens) => write!(f, "nominal: {lens}, does not fit a person of this size")?,
            DistanceBy::Unknown => write!(f, "nominal: the focal length is unknown")?,
        }
        let assumed = if *height_assumed { ", assumed" } else { "" };
        let known = match elevation_by {
            ElevationBy::Told => "--elevation",
            ElevationBy::File => "the file",
            ElevationBy::Unknown => "nominal: unknown",
        };
        write!(f, "; person {height} m high{assumed}), looking down by {elevation:.1}° ({known})")
    }
}

/// A person made of photographs.
pub struct Person {
    /// In the world of the config: y up, metres.
    pub gaussians: Gaussians,
    /// Where the cameras of front and back stood; `None` if cameras have no effect ([`Told::unplaced`]).
    pub seats: Option<[Seat; 2]>,
    /// The networks' result, in the front camera's frame. Its `origins` hold for [`Self::gaussians`] as well.
    pub made: Reconstruction,
}

/// No person came out of photographs.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the names say it")]
pub enum NoPerson {
    /// The networks made no Gaussian in these steps.
    #[error("no Gaussian came out of these photographs")]
    Empty { steps: Vec<Step> },
    /// The person would be far too tall for its width, with a camera at this distance in metres that looks down by
    /// `elevation` degrees.
    #[error(
        "a camera {distance:.2} m away that looks down by {elevation:.0}° cannot have taken these photographs: check --distance and --elevation"
    )]
    Camera { distance: f64, elevation: f64 },
}

/// Makes the person in a front and a back photograph, restored to the real cameras. The person stands on y = 0 and has
/// the told height, or the usual one, if cameras have an effect ([`Told::unplaced`]). `stage` is called with the name of
/// each module before it runs.
///
/// # Errors
/// [`NoPerson`].
///
/// # Panics
/// If there are not two photographs on canvases of the networks' size.
pub fn person(
    photographs: &Photographs,
    networks: &Reconstructor,
    told: &Told,
    stage: &dyn Fn(&'static str),
) -> Result<Person, NoPerson> {
    let [front, back] = &*photographs.canvases else { panic!("a person needs two photographs") };
    let config = networks.config();
    let made = reconstruct(networks, [front, back], stage);
    if made.gaussians.is_empty() {
        return Err(NoPerson::Empty { steps: made.steps });
    }
    let mut gaussians = made.in_world(config);
    let mut seats = None;
    if told.unplaced(config).is_none() {
        let side = config.network.resolution;
        let [floor, top] = range(&host(gaussians.means.clone()));
        let here = [0, 1].map(|i| told.seat(&photographs.frames[i], side, top - floor));
        if let Some(Seat { distance, elevation, .. }) =
            here.iter().find(|seat| seat.viewpoint.stretch() > TALLEST)
        {
            return Err(NoPerson::Camera { distance: *distance, elevation: *elevation });
        }
        if here.iter().any(|seat| seat.viewpoint != Viewpoint::default()) {
            let restoration = Restoration::to_viewpoints(here.map(|seat| seat.viewpoint));
            let person = restoration.person(made.gaussians.clone(), &made.origins);
            gaussians = placed(config, person, &restoration.front.world_to_camera.inverse());
        }
        let [low, high] = range(&host(gaussians.means.clone()));
        let sole = Tensor::from_floats([[0.0, low, 0.0]], &gaussians.device());
        let means = gaussians.means - sole;
        gaussians = Gaussians { means, ..gaussians }.scaled(here[0].height / (high - low));
        seats = Some(here);
    }
    Ok(Person { gaussians, seats, made })
}

/// The y of the person's lowest and highest Gaussian, in metres.
fn range(means: &[f32]) -> [f64; 2] {
    let heights = means.iter().skip(1).step_by(3);
    let range = heights.fold([f32::INFINITY, f32::NEG_INFINITY], |[a, b], y| [a.min(*y), b.max(*y)]);
    range.map(f64::from)
}
