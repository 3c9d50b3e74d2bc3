//! Options of the commands that make people, and the memory that a photograph needs.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::Args;
use snapsnap_net::Reconstructor;
use snapsnap_net::config::OPPOSITE;
use snapsnap_net::precision::Precision;
use snapsnap_net::weights::WeightFile;
use snapsnap_net::weights::schema::Part;

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
    pub config: ConfigArguments,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Numbers in the point predictor's matrix products: f32, bf16, or auto: bf16 if the weights were trained in bf16
    /// and the CPU has instructions for it, else f32.
    #[arg(long, value_name = "auto|f32|bf16", default_value = "auto", value_parser = one_of(PRECISIONS))]
    precision: Asked,
}

impl ModelArguments {
    /// Opens the weights of both networks.
    pub fn open(&self) -> Result<WeightFile, Failure> {
        let weights = weights::open(self.weights.as_deref(), &self.config)?;
        weights.require(Part::PointPredictor)?;
        weights.require(Part::Regressor)?;
        Ok(weights)
    }

    /// The device for many people, if the networks fit into its memory.
    pub fn device(&self, weights: &WeightFile) -> Result<Device, Failure> {
        let device = device::choose(&self.device)?;
        memory::check_networks(weights, &device)?;
        Ok(device)
    }

    /// The device for one person, if the networks fit into its memory.
    pub fn device_for_one(&self, weights: &WeightFile) -> Result<Device, Failure> {
        /// Parameters of networks that a CPU needs long for.
        const MANY: u64 = 100_000_000;
        let is_small = weights.parameters() < MANY;
        let device =
            if is_small { device::choose_for_one(&self.device) } else { device::choose(&self.device) }?;
        memory::check_networks(weights, &device)?;
        Ok(device)
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

/// Refuses a photograph that memory cannot hold.
pub fn check_memory(name: &Path, [width, height]: [u32; 2]) -> Result<(), Failure> {
    let bytes = BYTES_PER_PIXEL * u64::from(width) * u64::from(height);
    memory::check(&format!("{}, {width}×{height},", name.display()), bytes, "make the picture smaller")
}
