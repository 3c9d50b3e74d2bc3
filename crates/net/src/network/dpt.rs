//! The DPT head: the tokens of four layers → one raw point map (docs/method.md, "DPT head").
//!
//! Field names are the checkpoint's, with `at_N` for entry N of a PyTorch `Sequential`.

#![allow(non_snake_case, reason = "the checkpoint's names")]

use burn::module::Module;
use burn::nn::PaddingConfig2d::{Explicit, Valid};
use burn::nn::conv::{Conv2d, Conv2dConfig, ConvTranspose2d, ConvTranspose2dConfig};
use burn::tensor::{Device, Tensor};

use crate::config::NetworkConfig;
use snapsnap_ops::layers::{conv2d, enlarge};
use snapsnap_ops::{as_weight, bilinear};

pub(crate) fn conv3x3(from: usize, to: usize, stride: usize, bias: bool, device: &Device) -> Conv2d {
    Conv2dConfig::new([from, to], [3, 3])
        .with_stride([stride, stride])
        .with_padding(Explicit(1, 1, 1, 1))
        .with_bias(bias)
        .init(device)
}

pub(crate) fn conv1x1(from: usize, to: usize, device: &Device) -> Conv2d {
    Conv2dConfig::new([from, to], [1, 1]).with_padding(Valid).init(device)
}

/// 1×1 convolution, then a transposed convolution that enlarges `stride` times.
#[derive(Module, Debug)]
struct Enlarge {
    at_0: Conv2d,
    at_1: ConvTranspose2d,
}

impl Enlarge {
    fn new(from: usize, to: usize, stride: usize, device: &Device) -> Self {
        let at_1 =
            ConvTranspose2dConfig::new([to, to], [stride, stride]).with_stride([stride, stride]).init(device);
        Self { at_0: conv1x1(from, to, device), at_1 }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        enlarge(&self.at_1, conv2d(&self.at_0, x, false))
    }
}

/// The four branches that bring the token maps to 4, 2, 1 and ½ times the token grid.
#[derive(Module, Debug)]
struct Branches {
    at_0: Enlarge,
    at_1: Enlarge,
    /// 1×1 convolution only.
    at_2: Vec<Conv2d>,
    /// 1×1 convolution, then a 3×3 convolution with stride 2.
    at_3: Vec<Conv2d>,
}

/// x + conv₂(relu(conv₁(relu x))).
#[derive(Module, Debug)]
pub struct ResidualConvUnit {
    conv1: Conv2d,
    conv2: Conv2d,
}

impl ResidualConvUnit {
    pub(super) fn new(features: usize, device: &Device) -> Self {
        let conv = || conv3x3(features, features, 1, true, device);
        Self { conv1: conv(), conv2: conv() }
    }

    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let h = conv2d(&self.conv1, x.clone(), true);
        x + conv2d(&self.conv2, h, true)
    }
}

/// Joins a coarse map with a finer one and doubles the size.
#[derive(Module, Debug)]
struct Fusion {
    out_conv: Conv2d,
    resConfUnit1: ResidualConvUnit,
    resConfUnit2: ResidualConvUnit,
}

impl Fusion {
    fn new(features: usize, device: &Device) -> Self {
        Self {
            out_conv: conv1x1(features, features, device),
            resConfUnit1: ResidualConvUnit::new(features, device),
            resConfUnit2: ResidualConvUnit::new(features, device),
        }
    }

    /// `coarse` may exceed `fine` by one row or column (odd token grids) and is cropped to the size of `fine`.
    fn forward(&self, coarse: Tensor<4>, fine: Option<Tensor<4>>) -> Tensor<4> {
        let sum = match fine {
            Some(fine) => {
                let [_, _, h, w] = fine.dims();
                coarse.narrow(2, 0, h).narrow(3, 0, w) + self.resConfUnit1.forward(fine)
            }
            None => coarse,
        };
        let sum = self.resConfUnit2.forward(sum);
        let [_, _, h, w] = sum.dims();
        // The published order is enlarge, then 1×1 convolution; the two commute (the interpolation weights of a pixel
        // sum to one), and this way round the convolution does a quarter of the work.
        bilinear(conv2d(&self.out_conv, sum, false), [2 * h, 2 * w], true)
    }
}

/// The 3×3 convolutions to a common width, and the four fusion blocks.
#[derive(Module, Debug)]
struct Scratch {
    layer1_rn: Conv2d,
    layer2_rn: Conv2d,
    layer3_rn: Conv2d,
    layer4_rn: Conv2d,
    refinenet1: Fusion,
    refinenet2: Fusion,
    refinenet3: Fusion,
    refinenet4: Fusion,
}

/// Two convolutions around a ×2 enlargement, then the projection to x, y, z and confidence.
#[derive(Module, Debug)]
struct Output {
    at_0: Conv2d,
    at_2: Conv2d,
    at_4: Conv2d,
}

/// The whole head.
#[derive(Module, Debug)]
pub struct DptHead {
    act_postprocess: Branches,
    scratch: Scratch,
    head: Output,
}

impl DptHead {
    /// `widths` are the channels of the four hooked token maps.
    pub(crate) fn new(config: &NetworkConfig, widths: [usize; 4], device: &Device) -> Self {
        let [d0, d1, d2, d3] = config.layer_dims;
        let f = config.feature_dim;
        Self {
            act_postprocess: Branches {
                at_0: Enlarge::new(widths[0], d0, 4, device),
                at_1: Enlarge::new(widths[1], d1, 2, device),
                at_2: vec![conv1x1(widths[2], d2, device)],
                at_3: vec![conv1x1(widths[3], d3, device), conv3x3(d3, d3, 2, true, device)],
            },
            scratch: Scratch {
                layer1_rn: conv3x3(d0, f, 1, false, device),
                layer2_rn: conv3x3(d1, f, 1, false, device),
                layer3_rn: conv3x3(d2, f, 1, false, device),
                layer4_rn: conv3x3(d3, f, 1, false, device),
                refinenet1: Fusion::new(f, device),
                refinenet2: Fusion::new(f, device),
                refinenet3: Fusion::new(f, device),
                // Every checkpoint has its first residual unit, which never runs; kept so that files round-trip.
                refinenet4: Fusion::new(f, device),
            },
            head: Output {
                at_0: conv3x3(f, f / 2, 1, true, device),
                at_2: conv3x3(f / 2, config.last_dim, 1, true, device),
                at_4: conv1x1(config.last_dim, 4, device),
            },
        }
    }

    /// Tokens `[B, N, C]` of the four hooked layers on a grid → raw x, y, z, confidence
    /// `[B, 4, 16·rows, 16·columns]`.
    pub(crate) fn forward(&self, tokens: [Tensor<3>; 4], [rows, columns]: [usize; 2]) -> Tensor<4> {
        let [m0, m1, m2, m3] = tokens.map(|x| {
            let [b, _, c] = x.dims();
            x.swap_dims(1, 2).reshape([b, c, rows, columns])
        });
        let (branches, s) = (&self.act_postprocess, &self.scratch);
        let conv = |layer: &Conv2d, x| conv2d(layer, x, false);
        let l3 = conv(&branches.at_3[1], conv(&branches.at_3[0], m3));
        let path = s.refinenet4.forward(conv(&s.layer4_rn, l3), None);
        let l2 = conv(&s.layer3_rn, conv(&branches.at_2[0], m2));
        let path = s.refinenet3.forward(path, Some(l2));
        let path = s.refinenet2.forward(path, Some(conv(&s.layer2_rn, branches.at_1.forward(m1))));
        let path = s.refinenet1.forward(path, Some(conv(&s.layer1_rn, branches.at_0.forward(m0))));
        let x = conv(&self.head.at_0, path);
        let [_, _, h, w] = x.dims();
        let x = conv(&self.head.at_2, bilinear(x, [2 * h, 2 * w], true));
        let last = &self.head.at_4;
        conv2d(last, as_weight(x, &last.weight), true)
    }
}
