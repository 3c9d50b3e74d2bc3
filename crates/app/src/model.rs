//! Options of the commands that make people: networks, cameras and the person. The memory that a photograph needs.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::Args;
use snapsnap_net::Reconstructor;
use snapsnap_net::config::{Config, OPPOSITE};
use snapsnap_net::precision::Precision;
use snapsnap_net::weights::WeightFile;
use snapsnap_net::weights::schema::Part;
use snapsnap_photo::{DISTANCES, ELEVATIONS, FOCALS, Told, Unplaced};

use crate::arguments::{ConfigArguments, one_of};
use crate::failure::{Failure, bail};
use crate::{device, memory, weights};

/// Bytes per pixel of a photograph while it is placed on its canvas: 4 of the decoded picture, 3 + 1 of its colours
/// and mask, 4 of a plane of f32, 3 + 1 of the other photograph's colours and mask, and 2 to spare.
const BYTES_PER_PIXEL: u64 = 18;
/// `None` is `auto`. (clap knows `Option` by its name, and would expect another parser.)
type Asked = Option<Precision>;
const PRECISIONS: [(&str, &str, Asked); 3] =
    [("auto", "", None), ("f32", "", Some(Precision::F32)), ("bf16", "", Some(Precision::Bf16))];

/// The networks and what computes them.
#[derive(Args)]
pub struct ModelArguments {
    /// Weight file, or a folder that contains `weights.safetensors` [default: the program's own].
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) config: ConfigArguments,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Numbers in the point predictor's matrix products: f32, bf16, or auto: bf16 if the weights were trained in bf16
    /// and the CPU has instructions for it, else f32.
    #[arg(long, value_name = "auto|f32|bf16", default_value = "auto", value_parser = one_of(PRECISIONS))]
    precision: Asked,
}

impl ModelArguments {
    /// These weights on this device.
    pub fn new(weights: Option<PathBuf>, device: &str) -> Self {
        Self { weights, config: ConfigArguments::default(), device: device.to_owned(), precision: None }
    }

    /// Opens the weights of both networks.
    pub fn open(&self) -> Result<WeightFile, Failure> {
        let weights = weights::open(self.weights.as_deref(), &self.config)?;
        weights.require(Part::PointPredictor)?;
        weights.require(Part::Regressor)?;
        Ok(weights)
    }

    /// The device for many people, if the networks fit into its memory.
    pub fn device(&self, weights: &WeightFile) -> Result<Device, Failure> {
        memory::with_room(device::choose(&self.device)?, weights)
    }

    /// The device for one person, if the networks fit into its memory.
    pub fn device_for_one(&self, weights: &WeightFile) -> Result<Device, Failure> {
        /// Parameters of networks that a CPU needs long for.
        const MANY: u64 = 100_000_000;
        let choose = if weights.parameters() < MANY { device::choose_for_one } else { device::choose };
        memory::with_room(choose(&self.device)?, weights)
    }

    /// Loads the networks.
    pub fn load(&self, weights: &WeightFile, device: &Device) -> Result<(Reconstructor, Precision), Failure> {
        let degrees = weights.config.network.pair_degrees;
        if degrees != OPPOSITE {
            bail!(
                "{}: `network.pair_degrees` is {degrees}: these networks are for several known cameras \
                 (`views.inputs` of `evaluate`), not for a front and a back",
                weights.path().display()
            );
        }
        let precision = self.precision.unwrap_or_else(|| Precision::of_weights(&weights.config, device));
        if !device.supports_dtype(precision.dtype()) {
            bail!("--device {}: does not compute in {}", self.device, precision.name());
        }
        Ok((Reconstructor::load(weights, device)?.in_precision(precision), precision))
    }
}

/// Options about the cameras and the person.
#[derive(Args, Debug, Clone, Copy, Default)]
pub struct CameraArguments {
    /// Height of the person in metres [default: 1.72].
    #[arg(long, value_name = "METRES")]
    pub height: Option<f64>,
    /// Focal length of both photographs in millimetres of 35 mm film [default: the files' own, else unknown].
    #[arg(long, value_name = "MM", conflicts_with = "distance")]
    pub focal: Option<f64>,
    /// Distance of both cameras in metres [default: it follows from the focal length, else 2].
    #[arg(long, value_name = "METRES")]
    pub distance: Option<f64>,
    /// How far both cameras look down at the person's middle, in degrees [default: what an iPhone's files say, else 8].
    #[arg(long, value_name = "DEGREES", allow_hyphen_values = true)]
    pub elevation: Option<f64>,
}

impl CameraArguments {
    /// These options, replaced by a page's fields: JSON of names and texts.
    pub fn updated(self, fields: &str) -> Result<Self, Failure> {
        let parsed: HashMap<String, String> =
            serde_json::from_str(fields).map_err(|e| Failure::Input(format!("the page's fields: {e}")))?;
        let mut updated = self;
        for (name, text) in parsed {
            let field = match name.as_str() {
                "height" => &mut updated.height,
                "focal" => &mut updated.focal,
                _ => continue,
            };
            *field = Some(text.parse().map_err(|_| Failure::Input(format!("{name} {text}: is no number")))?);
        }
        Ok(updated)
    }

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

/// Refuses a photograph that memory cannot hold.
pub fn check_memory(name: &Path, [width, height]: [u32; 2]) -> Result<(), Failure> {
    let bytes = BYTES_PER_PIXEL * u64::from(width) * u64::from(height);
    memory::check(&format!("{}, {width}×{height},", name.display()), bytes, "make the picture smaller")
}
