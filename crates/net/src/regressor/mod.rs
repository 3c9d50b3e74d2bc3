//! The Gaussian regressor: colours and points of one view → one Gaussian per pixel
//! (docs/method.md, "Gaussian regressor").

mod attributes;
mod kernel;
#[cfg(test)]
mod tests;
mod unet;

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, Tensor};
use snapsnap_ops::layers::conv2d;

use crate::network::conv1x1;
use unet::{Normalise, UNet, normalise};

pub use attributes::{Attributes, Geometry, Limits};
pub use snapsnap_ops::regressor::{FEATURES, INPUT_CHANNELS};

/// UNet and final 1×1 convolution. Field names are the checkpoint's.
#[derive(Module, Debug)]
pub struct Regressor {
    pub(crate) pred_unet: UNet,
    pub(crate) gs_conv: Conv2d,
}

impl Regressor {
    /// A regressor without values for its parameters yet.
    pub fn new(device: &Device) -> Self {
        Self { pred_unet: UNet::new(device), gs_conv: conv1x1(FEATURES, FEATURES, device) }
    }

    /// Input `[B, 6, H, W]` with H and W multiples of 4 → features `[B, H, W, 14]`, before activation.
    pub fn forward(&self, input: Tensor<4>) -> Tensor<4> {
        let [_, channels, h, w] = input.dims();
        assert_eq!(channels, INPUT_CHANNELS, "regressor input must be [B, {INPUT_CHANNELS}, H, W]");
        assert!(h % 4 == 0 && w % 4 == 0, "regressor input {h}×{w}: both sides must be multiples of 4");
        if snapsnap_ops::has_kernels(&input) {
            return kernel::regress(&self.pred_unet, &self.gs_conv, input);
        }
        self.composed(input, &mut normalise)
    }

    /// [`Self::forward`] in plain tensor code.
    fn composed(&self, input: Tensor<4>, normalise: Normalise) -> Tensor<4> {
        conv2d(&self.gs_conv, self.pred_unet.forward(input, normalise), false).permute([0, 2, 3, 1])
    }
}
