//! A U-shaped convolutional network over both photographs (docs/method.md, "Convolutional body"): residual units at
//! four sizes, attention at the coarsest. One decoder gives the photographs' maps and uses the encoder's images as skips. A
//! second decoder gives the maps of the unseen sides and uses the row means of these images: a height in a side view is
//! the same height in the front view.

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::nn::{LayerNorm, Linear, LinearConfig};
use burn::tensor::{Device, Tensor};

use super::block::{EncoderBlock, layer_norm, normalise};
use super::dpt::{ResidualConvUnit, conv1x1, conv3x3};
use crate::config::NetworkConfig;
use snapsnap_ops::layers::{conv2d, linear};
use snapsnap_ops::{Rope, as_weight, bilinear};

/// Sizes of images inside, each half of the one before.
const LEVELS: usize = 4;
/// The finest pixel of a patch of `patch` pixels is this many of the input's.
fn stride(patch: usize) -> usize {
    patch >> (LEVELS - 1)
}

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

/// From the coarsest image to the raw points of two views.
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
    fn new(config: &NetworkConfig, device: &Device) -> Self {
        let widths = config.layer_dims;
        Self {
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            up: widths.windows(2).map(|pair| conv1x1(pair[1], pair[0], device)).collect(),
            conv_mid: conv3x3(widths[0], config.last_dim, 1, true, device),
            conv_out: conv1x1(config.last_dim, 8, device),
        }
    }

    /// `coarsest` and images of all levels, which may be but a column wide → `[B, 8, h, w]`.
    fn forward(&self, coarsest: Tensor<4>, levels: &[Tensor<4>]) -> Tensor<4> {
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
        let x = conv2d(&self.conv_mid, x, true);
        conv2d(&self.conv_out, as_weight(x, &self.conv_out.weight), true)
    }
}

/// Input of both decoders.
#[derive(Debug, Clone)]
pub struct Levels {
    /// An image of each size `[B, layer_dims, ..]`.
    images: Vec<Tensor<4>>,
    /// Normalised tokens of the coarsest `[B, N, enc_dim]`.
    tokens: Tensor<3>,
}

/// The network.
#[derive(Module, Debug)]
pub struct PointUNet {
    conv_in: Conv2d,
    /// By level.
    units: Vec<ResidualConvUnit>,
    /// From a level to the next coarser one.
    down: Vec<Conv2d>,
    attention: Attention,
    decoder: Decoder,
    side_attention: Option<Attention>,
    side_decoder: Option<Decoder>,
    #[module(skip)]
    config: NetworkConfig,
}

impl PointUNet {
    pub(crate) fn new(config: &NetworkConfig, device: &Device) -> Self {
        let (c, widths) = (config, config.layer_dims);
        let coarsest = widths[LEVELS - 1];
        let blocks = [c.enc_depth, c.enc_heads, c.mlp_ratio];
        let side_blocks = [c.dec_depth, c.dec_heads, c.mlp_ratio];
        let sides = || Attention::new([c.enc_dim, c.dec_dim, coarsest], side_blocks, device);
        Self {
            conv_in: conv3x3(2 * c.input_channels(), widths[0], stride(c.patch), true, device),
            units: widths.iter().map(|width| ResidualConvUnit::new(*width, device)).collect(),
            down: widths.windows(2).map(|pair| conv3x3(pair[0], pair[1], 2, true, device)).collect(),
            attention: Attention::new([coarsest, c.enc_dim, coarsest], blocks, device),
            decoder: Decoder::new(c, device),
            side_attention: c.side_heads.then(sides),
            side_decoder: c.side_heads.then(|| Decoder::new(c, device)),
            config: c.clone(),
        }
    }

    /// The same network without the decoder of the unseen sides.
    pub fn without_sides(self) -> Self {
        Self { side_attention: None, side_decoder: None, ..self }
    }

    /// Whether the layer of this name gives the raw points.
    pub(super) fn is_last_layer(name: &str) -> bool {
        name.ends_with("decoder.conv_out")
    }

    /// Whether it has a decoder of the unseen sides.
    pub fn has_sides(&self) -> bool {
        self.side_decoder.is_some()
    }

    fn rope(&self, image: &Tensor<4>, [dim, heads]: [usize; 2]) -> (Rope, [usize; 2]) {
        let [_, _, rows, columns] = image.dims();
        let rope = Rope::new(rows, columns, dim / heads, self.config.rope_base, &image.device());
        (rope, [rows, columns])
    }

    /// Both photographs `[B, C, H, W]`, H and W multiples of the patch.
    pub fn encode(&self, front: Tensor<4>, back: Tensor<4>) -> Levels {
        let mut x = conv2d(&self.conv_in, Tensor::cat(vec![front, back], 1), false);
        let mut images: Vec<Tensor<4>> = Vec::new();
        for (level, unit) in self.units.iter().enumerate() {
            if level > 0 {
                x = conv2d(&self.down[level - 1], x, true);
            }
            x = unit.forward(x);
            images.push(x.clone());
        }
        let (rope, _) = self.rope(&x, [self.config.enc_dim, self.config.enc_heads]);
        let [b, c, h, w] = x.dims();
        let tokens = self.attention.forward(x.reshape([b, c, h * w]).swap_dims(1, 2), &rope);
        Levels { images, tokens }
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the front and the back.
    pub fn photographed(&self, Levels { images, tokens }: &Levels) -> [Tensor<4>; 2] {
        let [_, _, rows, columns] = images[LEVELS - 1].dims();
        let coarsest = self.attention.image(tokens.clone(), [rows, columns]);
        self.pair(self.decoder.forward(coarsest, images))
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of the right and the left.
    ///
    /// # Panics
    /// If the network has no sides.
    pub fn sides(&self, Levels { images, tokens }: &Levels) -> [Tensor<4>; 2] {
        let attention = self.side_attention.as_ref().expect("a network with sides");
        let decoder = self.side_decoder.as_ref().expect("a network with sides");
        let c = &self.config;
        let (rope, size) = self.rope(&images[LEVELS - 1], [c.dec_dim, c.dec_heads]);
        let coarsest = attention.image(attention.forward(tokens.clone(), &rope), size);
        let rows: Vec<Tensor<4>> = images.iter().map(|image| image.clone().mean_dim(3)).collect();
        self.pair(decoder.forward(coarsest, &rows))
    }

    /// Two views' channels as two images of the input's size.
    fn pair(&self, x: Tensor<4>) -> [Tensor<4>; 2] {
        let ([_, _, h, w], stride) = (x.dims(), stride(self.config.patch));
        let x = if stride > 1 { bilinear(x, [stride * h, stride * w], false) } else { x };
        [x.clone().narrow(1, 0, 4), x.narrow(1, 4, 4)]
    }
}
