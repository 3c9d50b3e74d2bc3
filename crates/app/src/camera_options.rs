//! Options about the cameras and the person of a user's photographs.

use clap::Args;
use snapsnap_net::config::Config;
use snapsnap_photo::{DISTANCES, ELEVATIONS, FOCALS, Told, Unplaced};

use crate::failure::{Failure, bail};

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
    /// Refuses impossible values, and all values if the config's networks do not place photographs as a user's.
    pub fn told(&self, config: &Config, as_is: bool) -> Result<Told, Failure> {
        let Self { height, focal, distance, elevation } = *self;
        let told = Told { as_is, height, focal, distance, elevation };
        let why = told.unplaced(config).map(|why| match why {
            Unplaced::AsIs => "with --as-is the cameras are the nominal ones",
            Unplaced::Compat => "weights in `mode.compat` have the published demo's cameras",
            Unplaced::Mirrored => "`mode.world_frame` is mirrored",
        });
        let options = [
            ("--height", height, 0.1..=10.0),
            ("--focal", focal, FOCALS),
            ("--distance", distance, DISTANCES),
            ("--elevation", elevation, ELEVATIONS),
        ];
        for (name, value, range) in options {
            let Some(value) = value else { continue };
            if !range.contains(&value) {
                bail!("{name} {value}: must be from {} to {}", range.start(), range.end());
            }
            if let Some(why) = why {
                bail!("{name}: {why}");
            }
        }
        Ok(told)
    }
}
