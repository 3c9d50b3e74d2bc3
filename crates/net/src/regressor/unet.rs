//! The regressor's UNet (docs/method.md, "UNet"): two halvings, residual blocks, group normalisation, no attention.
//!
//! Field names are the checkpoint's.

use burn::module::{Module, Param};
use burn::nn::conv::Conv2d;
use burn::nn::{GroupNorm, GroupNormConfig};
use burn::tensor::activation::silu;
use burn::tensor::{Device, Tensor};
use snapsnap_ops::fused::{CHANNELS, GROUPS};
use snapsnap_ops::layers::conv2d;
use snapsnap_ops::regressor::{BRANCH_SCALE, LEVELS};
use snapsnap_ops::{spread_last, sum_last};

use super::{FEATURES, INPUT_CHANNELS};
use crate::network::{conv1x1, conv3x3};

/// A group normalisation of `[B, C, H, W]`: [`normalise`], or a test's with the statistics of another image.
pub(super) type Normalise<'a> = &'a mut dyn FnMut(&GroupNorm, Tensor<4>) -> Tensor<4>;

/// (conv₂(silu(norm₂(conv₁(silu(norm₁ x))))) + shortcut x) / √2.
#[derive(Module, Debug)]
pub(crate) struct ResBlock {
    pub norm1: GroupNorm,
    pub conv1: Conv2d,
    pub norm2: GroupNorm,
    pub conv2: Conv2d,
    pub shortcut: Option<Conv2d>,
}

impl ResBlock {
    fn new(from: usize, device: &Device) -> Self {
        Self {
            norm1: GroupNormConfig::new(GROUPS, from).init(device),
            conv1: conv3x3(from, CHANNELS, 1, true, device),
            norm2: GroupNormConfig::new(GROUPS, CHANNELS).init(device),
            conv2: conv3x3(CHANNELS, CHANNELS, 1, true, device),
            shortcut: (from != CHANNELS).then(|| conv1x1(from, CHANNELS, device)),
        }
    }

    fn forward(&self, x: Tensor<4>, normalise: Normalise) -> Tensor<4> {
        let h = conv2d(&self.conv1, silu(normalise(&self.norm1, x.clone())), false);
        let h = conv2d(&self.conv2, silu(normalise(&self.norm2, h)), false);
        let x = match &self.shortcut {
            Some(shortcut) => conv2d(shortcut, x, false),
            None => x,
        };
        (h + x) * BRANCH_SCALE
    }
}

/// Residual blocks, and a convolution behind them if the size changes.
#[derive(Module, Debug)]
pub(crate) struct Blocks {
    pub nets: Vec<ResBlock>,
    pub downsample: Option<Conv2d>,
    pub upsample: Option<Conv2d>,
}

/// Three levels, two of which halve the size.
#[derive(Module, Debug)]
pub struct UNet {
    pub(crate) conv_in: Conv2d,
    pub(crate) down_blocks: Vec<Blocks>,
    pub(crate) mid_block: Blocks,
    pub(crate) up_blocks: Vec<Blocks>,
    pub(crate) norm_out: GroupNorm,
    pub(crate) conv_out: Conv2d,
}

impl UNet {
    pub(crate) fn new(device: &Device) -> Self {
        let c = CHANNELS;
        let blocks = |n: usize, from: usize| (0..n).map(|_| ResBlock::new(from, device)).collect();
        Self {
            conv_in: conv3x3(INPUT_CHANNELS, c, 1, true, device),
            down_blocks: (0..LEVELS)
                .map(|level| Blocks {
                    nets: blocks(2, c),
                    downsample: (level + 1 < LEVELS).then(|| conv3x3(c, c, 2, true, device)),
                    upsample: None,
                })
                .collect(),
            mid_block: Blocks { nets: blocks(2, c), downsample: None, upsample: None },
            up_blocks: (0..LEVELS)
                .map(|level| Blocks {
                    nets: blocks(3, 2 * c),
                    downsample: None,
                    upsample: (level + 1 < LEVELS).then(|| conv3x3(c, c, 1, true, device)),
                })
                .collect(),
            norm_out: GroupNormConfig::new(GROUPS, c).init(device),
            conv_out: conv3x3(c, FEATURES, 1, true, device),
        }
    }

    /// `[B, 6, H, W]`, H and W multiples of 4 → `[B, 14, H, W]`.
    pub(super) fn forward(&self, x: Tensor<4>, normalise: Normalise) -> Tensor<4> {
        let mut x = conv2d(&self.conv_in, x, false);
        let mut skips = vec![x.clone()];
        for block in &self.down_blocks {
            for net in &block.nets {
                x = net.forward(x, normalise);
                skips.push(x.clone());
            }
            if let Some(downsample) = &block.downsample {
                x = conv2d(downsample, x, false);
                skips.push(x.clone());
            }
        }
        for net in &self.mid_block.nets {
            x = net.forward(x, normalise);
        }
        for block in &self.up_blocks {
            for net in &block.nets {
                let skip = skips.pop().expect("as many skips as up blocks consume");
                x = net.forward(Tensor::cat(vec![x, skip], 1), normalise);
            }
            if let Some(upsample) = &block.upsample {
                x = conv2d(upsample, repeat_twice(x), false);
            }
        }
        conv2d(&self.conv_out, silu(normalise(&self.norm_out, x)), false)
    }
}

/// Group normalisation of `[B, C, H, W]`.
pub(super) fn normalise(norm: &GroupNorm, x: Tensor<4>) -> Tensor<4> {
    let statistics = statistics(norm, &x);
    normalise_with(norm, x, statistics)
}

/// Means and reciprocal standard deviations `[B, groups]` of `[B, C, H, W]`.
pub(super) fn statistics(norm: &GroupNorm, x: &Tensor<4>) -> [Tensor<2>; 2] {
    let ([b, c, h, w], groups) = (x.dims(), norm.num_groups);
    let n = c / groups * h * w;
    let flat = x.clone().reshape([b, groups, n]);
    let average = |x: Tensor<3>| sum_last(x) / n as f64;
    let mean = average(flat.clone());
    let variance = average((flat - spread_last(mean.clone(), n)).square());
    [mean.squeeze_dim(2), (variance + norm.epsilon).sqrt().recip().squeeze_dim(2)]
}

/// Group normalisation of `[B, C, H, W]` with these means and reciprocal standard deviations.
pub(super) fn normalise_with(norm: &GroupNorm, x: Tensor<4>, [mean, rstd]: [Tensor<2>; 2]) -> Tensor<4> {
    let ([b, c, h, w], groups) = (x.dims(), norm.num_groups);
    let per_channel = |x: Tensor<2>| x.reshape([b, groups, 1]).repeat_dim(2, c / groups).reshape([b, c]);
    let affine = |p: &Option<Param<Tensor<1>>>| {
        p.as_ref().expect("the published group norms are affine").val().reshape([1, c])
    };
    let scale = per_channel(rstd) * affine(&norm.gamma);
    let shift = affine(&norm.beta) - per_channel(mean) * scale.clone();
    // Expanded, so that gradients are sums over one dimension after the other, not over all at once.
    let [scale, shift] = [scale, shift].map(|x| x.reshape([b, c, 1, 1]).expand([b, c, h, w]));
    x * scale + shift
}

/// Nearest-neighbour ×2 enlargement of `[B, C, H, W]`.
fn repeat_twice(x: Tensor<4>) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let rows = x.reshape([b * c, h, 1, w]).repeat_dim(2, 2);
    rows.reshape([b * c, 2 * h, w, 1]).repeat_dim(3, 2).reshape([b, c, 2 * h, 2 * w])
}
