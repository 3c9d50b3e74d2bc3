//! A U-shaped network: residual units at four sizes, attention at the coarsest size, and a decoder with the encoder's
//! images as skips (docs/method.md, "Convolutional body").

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::nn::{LayerNorm, Linear, LinearConfig};
use burn::tensor::{Device, Tensor};

use super::block::{EncoderBlock, layer_norm, normalise};
use super::dpt::{ResidualConvUnit, conv1x1, conv3x3};
use super::rope;
use snapsnap_ops::layers::{conv2d, linear};
use snapsnap_ops::{as_weight, bilinear};

/// Number of image sizes, each half of the one before.
pub(super) const LEVELS: usize = 4;

/// Tokens of the coarsest image, and blocks of attention between them.
#[derive(Module, Debug)]
pub(super) struct Attention {
    embed: Linear,
    blocks: Vec<EncoderBlock>,
    norm: LayerNorm,
    /// Projection to the channels of the image.
    proj: Linear,
    #[module(skip)]
    head_dim: usize,
}

impl Attention {
    /// Attention between tokens of `dim` channels, from and to images with their channels.
    pub(super) fn new([from, dim, to]: [usize; 3], [depth, heads]: [usize; 2], device: &Device) -> Self {
        Self {
            embed: LinearConfig::new(from, dim).init(device),
            blocks: (0..depth).map(|_| EncoderBlock::new(dim, heads, device)).collect(),
            norm: layer_norm(dim, device),
            proj: LinearConfig::new(dim, to).init(device),
            head_dim: dim / heads,
        }
    }

    /// Tokens `[B, N, from]` of a grid of rows and columns → normalised tokens `[B, N, dim]`.
    pub(super) fn forward(&self, tokens: Tensor<3>, grid: [usize; 2]) -> Tensor<3> {
        let tokens = linear(&self.embed, tokens);
        if self.blocks.is_empty() {
            return normalise(&self.norm, tokens);
        }
        let rope = rope(grid, self.head_dim, &tokens.device());
        normalise(&self.norm, self.blocks.iter().fold(tokens, |x, block| block.forward(x, &rope)))
    }

    /// Normalised tokens as an image.
    pub(super) fn image(&self, tokens: Tensor<3>, [rows, columns]: [usize; 2]) -> Tensor<4> {
        let x = linear(&self.proj, tokens);
        let [b, _, c] = x.dims();
        x.swap_dims(1, 2).reshape([b, c, rows, columns])
    }
}

/// From the coarsest image to the output at the finest size.
#[derive(Module, Debug)]
pub(super) struct Decoder {
    /// By level.
    units: Vec<ResidualConvUnit>,
    /// To each level from the next coarser one.
    up: Vec<Conv2d>,
    conv_mid: Conv2d,
    conv_out: Conv2d,
}

impl Decoder {
    pub(super) fn new(widths: [usize; LEVELS], last_dim: usize, outputs: usize, device: &Device) -> Self {
        Self {
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            up: widths.windows(2).map(|pair| conv1x1(pair[1], pair[0], device)).collect(),
            conv_mid: conv3x3(widths[0], last_dim, 1, true, device),
            conv_out: conv1x1(last_dim, outputs, device),
        }
    }

    /// `coarsest` and skip images of all levels, which may be one column wide → features `[B, last_dim, h, w]`.
    pub(super) fn features(&self, coarsest: Tensor<4>, levels: &[Tensor<4>]) -> Tensor<4> {
        let mut x = coarsest + levels[LEVELS - 1].clone();
        for level in (0..LEVELS).rev() {
            if level < LEVELS - 1 {
                let [_, _, h, w] = x.dims();
                // A 1×1 convolution and an enlargement commute, and this way round it does a quarter of the work.
                let enlarged = bilinear(conv2d(&self.up[level], x, false), [2 * h, 2 * w], false);
                x = enlarged + levels[level].clone();
            }
            x = self.units[level].forward(x);
        }
        conv2d(&self.conv_mid, x, true)
    }

    /// Features → `[B, outputs, h, w]`, in the precision of the last layer.
    pub(super) fn out(&self, features: Tensor<4>) -> Tensor<4> {
        conv2d(&self.conv_out, as_weight(features, &self.conv_out.weight), true)
    }
}

/// Input of the decoders.
#[derive(Debug, Clone)]
pub struct Levels {
    /// An image of each size `[B, layer_dims, ..]`.
    pub(super) images: Vec<Tensor<4>>,
    /// Normalised tokens of the coarsest image `[B, N, enc_dim]`.
    pub(super) tokens: Tensor<3>,
}

/// Residual units at four sizes, attention at the coarsest, and a decoder with skips.
#[derive(Module, Debug)]
pub(super) struct UNet {
    conv_in: Conv2d,
    /// By level.
    units: Vec<ResidualConvUnit>,
    /// From a level to the next coarser one.
    down: Vec<Conv2d>,
    attention: Attention,
    pub(super) decoder: Decoder,
}

/// Sizes of a [`UNet`].
pub(super) struct UNetSizes {
    pub inputs: usize,
    pub outputs: usize,
    /// Channels by level.
    pub widths: [usize; LEVELS],
    /// Channels, number and heads of the attention's blocks.
    pub blocks: [usize; 3],
    /// Pixels of the input per finest pixel, along an axis.
    pub stride: usize,
    /// Channels of the features.
    pub last_dim: usize,
}

impl UNet {
    pub(super) fn new(sizes: &UNetSizes, device: &Device) -> Self {
        let UNetSizes { inputs, outputs, widths, blocks: [dim, depth, heads], stride, last_dim } = *sizes;
        let coarsest = widths[LEVELS - 1];
        Self {
            conv_in: conv3x3(inputs, widths[0], stride, true, device),
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            down: widths.windows(2).map(|pair| conv3x3(pair[0], pair[1], 2, true, device)).collect(),
            attention: Attention::new([coarsest, dim, coarsest], [depth, heads], device),
            decoder: Decoder::new(widths, last_dim, outputs, device),
        }
    }

    /// `x` `[B, inputs, H, W]`, H and W multiples of the patch. `more` is added to the levels before their units.
    pub(super) fn encode(&self, x: Tensor<4>, more: Option<Vec<Tensor<4>>>) -> Levels {
        let mut x = conv2d(&self.conv_in, x, false);
        let mut images: Vec<Tensor<4>> = Vec::new();
        for (level, unit) in self.units.iter().enumerate() {
            if level > 0 {
                x = conv2d(&self.down[level - 1], x, true);
            }
            if let Some(more) = &more {
                x = x + more[level].clone();
            }
            x = unit.forward(x);
            images.push(x.clone());
        }
        let [b, c, h, w] = x.dims();
        let tokens = self.attention.forward(x.reshape([b, c, h * w]).swap_dims(1, 2), [h, w]);
        Levels { images, tokens }
    }

    /// Features `[B, last_dim, h, w]` at the finest size.
    pub(super) fn features(&self, Levels { images, tokens }: &Levels) -> Tensor<4> {
        let [_, _, rows, columns] = images[LEVELS - 1].dims();
        self.decoder.features(self.attention.image(tokens.clone(), [rows, columns]), images)
    }
}
