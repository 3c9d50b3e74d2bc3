//! The regressor's UNet (docs/method.md, "UNet"): two halvings, residual blocks, group normalisation, no attention.
//!
//! Field names are the checkpoint's.

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{GroupNorm, GroupNormConfig, PaddingConfig2d};
use burn::tensor::activation::silu;
use burn::tensor::{Device, Tensor};
use snapsnap_ops::fused::CHANNELS;
use snapsnap_ops::layers::conv2d;
use snapsnap_ops::regressor::{BRANCH_SCALE, LEVELS};

use super::statistics::{Statistics, normalise};
use super::{FEATURES, INPUT_CHANNELS};

/// Groups of every group normalisation.
pub(super) const GROUPS: usize = 16;

fn conv3x3(from: usize, to: usize, stride: usize, device: &Device) -> Conv2d {
    Conv2dConfig::new([from, to], [3, 3])
        .with_stride([stride, stride])
        .with_padding(PaddingConfig2d::Explicit(1, 1, 1, 1))
        .init(device)
}

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
        let shortcut = Conv2dConfig::new([from, CHANNELS], [1, 1]).with_padding(PaddingConfig2d::Valid);
        Self {
            norm1: GroupNormConfig::new(GROUPS, from).init(device),
            conv1: conv3x3(from, CHANNELS, 1, device),
            norm2: GroupNormConfig::new(GROUPS, CHANNELS).init(device),
            conv2: conv3x3(CHANNELS, CHANNELS, 1, device),
            shortcut: (from != CHANNELS).then(|| shortcut.init(device)),
        }
    }

    fn forward(&self, x: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
        let h = conv2d(&self.conv1, silu(normalise(&self.norm1, x.clone(), statistics)), false);
        let h = conv2d(&self.conv2, silu(normalise(&self.norm2, h, statistics)), false);
        let x = match &self.shortcut {
            Some(shortcut) => conv2d(shortcut, x, false),
            None => x,
        };
        (h + x) * BRANCH_SCALE
    }
}

#[derive(Module, Debug)]
pub(crate) struct DownBlock {
    pub nets: Vec<ResBlock>,
    pub downsample: Option<Conv2d>,
}

#[derive(Module, Debug)]
pub(crate) struct MidBlock {
    pub nets: Vec<ResBlock>,
}

#[derive(Module, Debug)]
pub(crate) struct UpBlock {
    pub nets: Vec<ResBlock>,
    pub upsample: Option<Conv2d>,
}

/// Three levels, two of which halve the size.
#[derive(Module, Debug)]
pub struct UNet {
    pub(crate) conv_in: Conv2d,
    pub(crate) down_blocks: Vec<DownBlock>,
    pub(crate) mid_block: MidBlock,
    pub(crate) up_blocks: Vec<UpBlock>,
    pub(crate) norm_out: GroupNorm,
    pub(crate) conv_out: Conv2d,
}

impl UNet {
    pub(crate) fn new(device: &Device) -> Self {
        let c = CHANNELS;
        let blocks = |n: usize, from: usize| (0..n).map(|_| ResBlock::new(from, device)).collect();
        Self {
            conv_in: conv3x3(INPUT_CHANNELS, c, 1, device),
            down_blocks: (0..LEVELS)
                .map(|level| DownBlock {
                    nets: blocks(2, c),
                    downsample: (level + 1 < LEVELS).then(|| conv3x3(c, c, 2, device)),
                })
                .collect(),
            mid_block: MidBlock { nets: blocks(2, c) },
            up_blocks: (0..LEVELS)
                .map(|level| UpBlock {
                    nets: blocks(3, 2 * c),
                    upsample: (level + 1 < LEVELS).then(|| conv3x3(c, c, 1, device)),
                })
                .collect(),
            norm_out: GroupNormConfig::new(GROUPS, c).init(device),
            conv_out: conv3x3(c, FEATURES, 1, device),
        }
    }

    /// `[B, 6, H, W]`, H and W multiples of 4 → `[B, 14, H, W]`.
    pub fn forward(&self, x: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
        let mut x = conv2d(&self.conv_in, x, false);
        let mut skips = vec![x.clone()];
        for block in &self.down_blocks {
            for net in &block.nets {
                x = net.forward(x, statistics);
                skips.push(x.clone());
            }
            if let Some(downsample) = &block.downsample {
                x = conv2d(downsample, x, false);
                skips.push(x.clone());
            }
        }
        for net in &self.mid_block.nets {
            x = net.forward(x, statistics);
        }
        for block in &self.up_blocks {
            for net in &block.nets {
                let skip = skips.pop().expect("as many skips as up blocks consume");
                x = net.forward(Tensor::cat(vec![x, skip], 1), statistics);
            }
            if let Some(upsample) = &block.upsample {
                x = conv2d(upsample, repeat_twice(x), false);
            }
        }
        conv2d(&self.conv_out, silu(normalise(&self.norm_out, x, statistics)), false)
    }
}

/// Nearest-neighbour ×2 enlargement of `[B, C, H, W]`.
fn repeat_twice(x: Tensor<4>) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    x.reshape([b * c, h, 1, w]).repeat_dim(2, 2).reshape([b * c, 2 * h, w, 1]).repeat_dim(3, 2).reshape([
        b,
        c,
        2 * h,
        2 * w,
    ])
}
