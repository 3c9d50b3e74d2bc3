//! The linear head: one projection of the last tokens and a pixel shuffle (docs/method.md, "Linear head").

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::{Device, Tensor};
use snapsnap_ops::as_weight;
use snapsnap_ops::layers::linear;

/// Channels of a raw point map: x, y, z, confidence.
const CHANNELS: usize = 4;

/// One linear layer from a token to its patch's raw points.
#[derive(Module, Debug)]
pub struct LinearHead {
    proj: Linear,
    patch: usize,
}

impl LinearHead {
    pub(crate) fn new(width: usize, patch: usize, device: &Device) -> Self {
        Self { proj: LinearConfig::new(width, CHANNELS * patch * patch).init(device), patch }
    }

    /// Tokens `[B, rows·columns, C]` → raw x, y, z, confidence `[B, 4, rows·patch, columns·patch]`.
    pub(crate) fn forward(&self, tokens: Tensor<3>, [rows, columns]: [usize; 2]) -> Tensor<4> {
        let [batch, _, _] = tokens.dims();
        let p = self.patch;
        linear(&self.proj, as_weight(tokens, &self.proj.weight))
            .reshape([batch, rows, columns, CHANNELS, p, p])
            .permute([0, 3, 1, 4, 2, 5])
            .reshape([batch, CHANNELS, rows * p, columns * p])
    }
}
