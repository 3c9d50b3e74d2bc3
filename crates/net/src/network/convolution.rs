//! A U-shaped convolutional network over both photographs (docs/method.md, "Convolutional body"). A decoder makes the
//! photographs' maps. A second decoder may make the maps of the unseen sides, with row means of the encoder's images as
//! skips: a side view shares its rows with the front view.

use burn::module::Module;
use burn::tensor::{Device, Tensor};

use super::completion::Completion;
use super::unet::{Attention, Decoder, LEVELS, Levels, UNet, UNetSizes};
use crate::config::{NetworkConfig, Sides};
use snapsnap_ops::bilinear;

/// The convolutional body of the point predictor.
#[derive(Module, Debug)]
pub struct PointUNet {
    pub(super) body: UNet,
    side_attention: Option<Attention>,
    side_decoder: Option<Decoder>,
    pub(super) completion: Option<Completion>,
    #[module(skip)]
    config: NetworkConfig,
}

impl PointUNet {
    pub(crate) fn new(config: &NetworkConfig, device: &Device) -> Self {
        let (c, widths) = (config, config.layer_dims);
        let sizes = UNetSizes {
            inputs: 2 * c.input_channels(),
            outputs: 8,
            widths,
            blocks: [c.enc_dim, c.enc_depth, c.enc_heads],
            stride: c.stride(),
            last_dim: c.last_dim,
        };
        let attention = || {
            let blocks = [c.dec_depth, c.dec_heads];
            Attention::new([c.enc_dim, c.dec_dim, widths[LEVELS - 1]], blocks, device)
        };
        let has = |sides: Sides| c.side_heads && c.sides == sides;
        Self {
            body: UNet::new(&sizes, device),
            side_attention: has(Sides::Predicted).then(attention),
            side_decoder: has(Sides::Predicted).then(|| Decoder::new(widths, c.last_dim, 8, device)),
            completion: has(Sides::Completed).then(|| Completion::new(c, device)),
            config: c.clone(),
        }
    }

    /// The same network without the layers of the unseen sides.
    pub fn without_sides(self) -> Self {
        Self { side_attention: None, side_decoder: None, completion: None, ..self }
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the front and the back from their features.
    pub fn photographed(&self, features: Tensor<4>) -> [Tensor<4>; 2] {
        self.pair(self.body.decoder.out(features))
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the right and the left; `None` without predicted sides.
    pub fn sides(&self, Levels { images, tokens }: &Levels) -> Option<[Tensor<4>; 2]> {
        let (attention, decoder) = (self.side_attention.as_ref()?, self.side_decoder.as_ref()?);
        let [_, _, rows, columns] = images[LEVELS - 1].dims();
        let coarsest = attention.image(attention.forward(tokens.clone(), [rows, columns]), [rows, columns]);
        let rows: Vec<Tensor<4>> = images.iter().map(|image| image.clone().mean_dim(3)).collect();
        Some(self.pair(decoder.out(decoder.features(coarsest, &rows))))
    }

    /// Splits the channels of two views into two images of the input's size.
    fn pair(&self, x: Tensor<4>) -> [Tensor<4>; 2] {
        let ([_, _, h, w], stride) = (x.dims(), self.config.stride());
        let x = if stride > 1 { bilinear(x, [stride * h, stride * w], false) } else { x };
        let each = x.dims()[1] / 2;
        [x.clone().narrow(1, 0, each), x.narrow(1, each, each)]
    }
}
