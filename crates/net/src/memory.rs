//! Estimate of a reconstruction's memory on a CPU, from its config.

use crate::config::{Config, DetailsConfig, PATCH};

/// Bytes of an f32.
const F32: u64 = 4;
/// Bytes per canvas pixel, measured for a person of the training subjects' height with sides (docs/inference.md): all
/// images and maps on device and host. A Gaussian in every pixel of every view needs twice as much.
const PER_PIXEL: u64 = 500;
/// Images of the finest size that the network of details has at once, for each channel and photograph: its input, the skip
/// image, and the images of a residual unit. Counted in the code and not measured: of the default sizes, the regressor
/// needs more.
const DETAIL_IMAGES: u64 = 6;
/// Memory that depends neither on size nor on weights: code, buffers of the threads.
const BASE: u64 = 200 << 20;

impl Config {
    /// Bytes that [`crate::Reconstructor::reconstruct`] needs for a standing person and so many `parameters`.
    pub fn memory_needed(&self, parameters: u64) -> u64 {
        let n = &self.network;
        let area = |side: usize| (side * side) as u64;
        // A head's maps at half and at full resolution of the network.
        let head = area(n.net_resolution) * F32 * n.feature_dim as u64;
        // Second surfaces are two more views.
        let per_pixel = if n.second_layer { PER_PIXEL * 3 / 2 } else { PER_PIXEL };
        let image = |details: &DetailsConfig| area(details.resolution / PATCH) * F32 * details.dims[0] as u64;
        let details = n.details.as_ref().map_or(0, |details| 2 * DETAIL_IMAGES * image(details));
        BASE + parameters * F32 + head + area(n.resolution) * per_pixel + details
    }
}
