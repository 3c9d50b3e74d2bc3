//! A U-shaped convolutional network over both photographs (docs/method.md, "Convolutional body"): residual units at
//! four sizes, attention at the coarsest. One decoder gives the photographs' maps and uses the encoder's images as skips. A
//! second decoder may give the maps of the unseen sides and uses the row means of these images: a height in a side view is
//! the same height in the front view.

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::nn::{LayerNorm, Linear, LinearConfig};
use burn::tensor::{Device, Tensor};

use super::block::{EncoderBlock, layer_norm, normalise};
use super::completion::Completion;
use super::dpt::{ResidualConvUnit, conv1x1, conv3x3};
use crate::config::{NetworkConfig, Sides};
use snapsnap_ops::layers::{conv2d, linear};
use snapsnap_ops::{Rope, as_weight, bilinear};

/// Sizes of images inside, each half of the one before.
const LEVELS: usize = 4;

/// Tokens of the coarsest image, and blocks of attention between them.
#[derive(Module, Debug)]
struct Attention {
    embed: Linear,
    blocks: Vec<EncoderBlock>,
    norm: LayerNorm,
    /// Back to an image's channels.
    proj: Linear,
}

impl Attention {
    fn new([from, dim, to]: [usize; 3], [depth, heads, ratio]: [usize; 3], device: &Device) -> Self {
        Self {
            embed: LinearConfig::new(from, dim).init(device),
            blocks: (0..depth).map(|_| EncoderBlock::new(dim, heads, ratio, device)).collect(),
            norm: layer_norm(dim, device),
            proj: LinearConfig::new(dim, to).init(device),
        }
    }

    /// Tokens `[B, N, from]` → normalised tokens `[B, N, dim]`.
    fn forward(&self, tokens: Tensor<3>, rope: &Rope) -> Tensor<3> {
        let tokens = linear(&self.embed, tokens);
        normalise(&self.norm, self.blocks.iter().fold(tokens, |x, block| block.forward(x, rope)))
    }

    /// Normalised tokens as an image.
    fn image(&self, tokens: Tensor<3>, [rows, columns]: [usize; 2]) -> Tensor<4> {
        let x = linear(&self.proj, tokens);
        let [b, _, c] = x.dims();
        x.swap_dims(1, 2).reshape([b, c, rows, columns])
    }
}

/// From the coarsest image to channels of the finest.
#[derive(Module, Debug)]
struct Decoder {
    /// By level.
    units: Vec<ResidualConvUnit>,
    /// To a level from the next coarser one.
    up: Vec<Conv2d>,
    conv_mid: Conv2d,
    conv_out: Conv2d,
}

impl Decoder {
    fn new(widths: [usize; LEVELS], last_dim: usize, outputs: usize, device: &Device) -> Self {
        Self {
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            up: widths.windows(2).map(|pair| conv1x1(pair[1], pair[0], device)).collect(),
            conv_mid: conv3x3(widths[0], last_dim, 1, true, device),
            conv_out: conv1x1(last_dim, outputs, device),
        }
    }

    /// `coarsest` and images of all levels, which may be but a column wide → features `[B, last_dim, h, w]`.
    fn features(&self, coarsest: Tensor<4>, levels: &[Tensor<4>]) -> Tensor<4> {
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

    /// Features → `[B, outputs, h, w]`.
    fn out(&self, features: Tensor<4>) -> Tensor<4> {
        out(&self.conv_out, features)
    }
}

/// Features → the output of a last layer, in its precision.
fn out(layer: &Conv2d, features: Tensor<4>) -> Tensor<4> {
    conv2d(layer, as_weight(features, &layer.weight), true)
}

/// Input of the decoders.
#[derive(Debug, Clone)]
pub struct Levels {
    /// An image of each size `[B, layer_dims, ..]`.
    pub(super) images: Vec<Tensor<4>>,
    /// Normalised tokens of the coarsest `[B, N, enc_dim]`.
    tokens: Tensor<3>,
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
    decoder: Decoder,
    #[module(skip)]
    head_dim: usize,
    #[module(skip)]
    rope_base: f64,
}

/// Sizes of a [`UNet`].
pub(super) struct UNetSizes {
    pub inputs: usize,
    pub outputs: usize,
    /// Channels by level.
    pub widths: [usize; LEVELS],
    /// Channels, number and heads of the attention's blocks.
    pub blocks: [usize; 3],
}

impl UNet {
    pub(super) fn new(config: &NetworkConfig, sizes: &UNetSizes, device: &Device) -> Self {
        let UNetSizes { inputs, outputs, widths, blocks: [dim, depth, heads] } = *sizes;
        let coarsest = widths[LEVELS - 1];
        // Pixels of the input per finest pixel, along an axis.
        let stride = config.patch >> (LEVELS - 1);
        Self {
            conv_in: conv3x3(inputs, widths[0], stride, true, device),
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            down: widths.windows(2).map(|pair| conv3x3(pair[0], pair[1], 2, true, device)).collect(),
            attention: Attention::new([coarsest, dim, coarsest], [depth, heads, config.mlp_ratio], device),
            decoder: Decoder::new(widths, config.last_dim, outputs, device),
            head_dim: dim / heads,
            rope_base: config.rope_base,
        }
    }

    fn rope(&self, [rows, columns]: [usize; 2], device: &Device) -> Rope {
        Rope::new(rows, columns, self.head_dim, self.rope_base, device)
    }

    /// `[B, inputs, H, W]`, H and W multiples of the patch. `more` is added to the images of the levels before their units.
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
        let rope = self.rope([h, w], &x.device());
        let tokens = self.attention.forward(x.reshape([b, c, h * w]).swap_dims(1, 2), &rope);
        Levels { images, tokens }
    }

    /// Features `[B, last_dim, h, w]` of the finest pixels.
    pub(super) fn features(&self, Levels { images, tokens }: &Levels) -> Tensor<4> {
        let [_, _, rows, columns] = images[LEVELS - 1].dims();
        self.decoder.features(self.attention.image(tokens.clone(), [rows, columns]), images)
    }

    /// Features → `[B, outputs, h, w]`.
    pub(super) fn out(&self, features: Tensor<4>) -> Tensor<4> {
        self.decoder.out(features)
    }
}

/// The network.
#[derive(Module, Debug)]
pub struct PointUNet {
    body: UNet,
    side_attention: Option<Attention>,
    side_decoder: Option<Decoder>,
    completion: Option<Completion>,
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
        };
        let attention = || {
            let blocks = [c.dec_depth, c.dec_heads, c.mlp_ratio];
            Attention::new([c.enc_dim, c.dec_dim, widths[LEVELS - 1]], blocks, device)
        };
        let has = |sides: Sides| c.side_heads && c.sides == sides;
        Self {
            body: UNet::new(c, &sizes, device),
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

    /// Whether the layer of this name gives the raw points.
    pub(super) fn is_last_layer(name: &str) -> bool {
        name.ends_with("decoder.conv_out")
    }

    /// Whether it has the unseen sides.
    pub fn has_sides(&self) -> bool {
        self.side_decoder.is_some() || self.completion.is_some()
    }

    /// The network of completed sides.
    pub(super) fn completion(&self) -> Option<&Completion> {
        self.completion.as_ref()
    }

    /// Both photographs `[B, C, H, W]`, H and W multiples of the patch.
    pub fn encode(&self, front: Tensor<4>, back: Tensor<4>) -> Levels {
        self.body.encode(Tensor::cat(vec![front, back], 1), None)
    }

    /// Features `[B, last_dim, h, w]` of the photographs' pixels.
    pub fn features(&self, levels: &Levels) -> Tensor<4> {
        self.body.features(levels)
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the front and the back from their features.
    pub fn photographed(&self, features: Tensor<4>) -> [Tensor<4>; 2] {
        self.pair(self.body.out(features))
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the right and the left; `None` without predicted sides.
    pub fn sides(&self, Levels { images, tokens }: &Levels) -> Option<[Tensor<4>; 2]> {
        let (attention, decoder) = (self.side_attention.as_ref()?, self.side_decoder.as_ref()?);
        let [_, _, rows, columns] = images[LEVELS - 1].dims();
        let c = &self.config;
        let rope = Rope::new(rows, columns, c.dec_dim / c.dec_heads, c.rope_base, &tokens.device());
        let coarsest = attention.image(attention.forward(tokens.clone(), &rope), [rows, columns]);
        let rows: Vec<Tensor<4>> = images.iter().map(|image| image.clone().mean_dim(3)).collect();
        Some(self.pair(decoder.out(decoder.features(coarsest, &rows))))
    }

    /// Two views' channels as two images of the input's size.
    fn pair(&self, x: Tensor<4>) -> [Tensor<4>; 2] {
        let ([_, _, h, w], stride) = (x.dims(), self.config.patch >> (LEVELS - 1));
        let x = if stride > 1 { bilinear(x, [stride * h, stride * w], false) } else { x };
        let each = x.dims()[1] / 2;
        [x.clone().narrow(1, 0, each), x.narrow(1, each, each)]
    }
}
