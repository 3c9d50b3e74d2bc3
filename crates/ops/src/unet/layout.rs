//! The operators in order of execution, and where each one's parameters lie in one flat vector.

use std::ops::Range;

use super::{EPSILON, FEATURES, INPUT_CHANNELS};
use crate::conv::{CHANNELS, GroupNorm};

/// Levels of the UNet.
const LEVELS: usize = 3;

/// A parameter: its name in a checkpoint, its shape there, and where its values lie.
#[derive(Debug, Clone)]
pub struct Tensor {
    /// As the authors' state dict has it.
    pub name: String,
    /// `[out, in, k, k]` or `[n]`.
    pub shape: Vec<usize>,
    /// Place in the flat vector.
    pub range: Range<usize>,
}

/// A convolution's places.
#[derive(Debug, Clone)]
pub(super) struct Conv {
    pub weight: Range<usize>,
    pub bias: Range<usize>,
    /// `[out, in, k²]`.
    pub shape: [usize; 3],
}

/// A normalisation's places and its number.
#[derive(Debug, Clone)]
pub(super) struct Norm {
    pub gamma: Range<usize>,
    pub beta: Range<usize>,
    /// In order of execution.
    pub index: usize,
}

#[derive(Debug, Clone)]
pub(super) struct Residual {
    pub norm1: Norm,
    pub conv1: Conv,
    pub norm2: Norm,
    pub conv2: Conv,
    pub shortcut: Option<Conv>,
}

/// Makes plane i + 1, if it is step i; plane 0 is the input.
#[derive(Debug, Clone)]
pub(super) enum Step {
    Convolve { conv: Conv, from: usize, stride: usize, enlarge: bool },
    Residual { block: Box<Residual>, from: usize, skip: Option<usize> },
}

/// The network's structure.
#[derive(Debug, Clone)]
pub struct Network {
    pub(super) groups: usize,
    pub(super) steps: Vec<Step>,
    pub(super) norm_out: Norm,
    pub(super) conv_out: Conv,
    pub(super) gs_conv: Conv,
    tensors: Vec<Tensor>,
}

impl Network {
    /// The network whose normalisations have `groups` groups.
    ///
    /// # Panics
    /// If `groups` does not divide 16.
    pub fn new(groups: usize) -> Self {
        assert!(groups > 0 && CHANNELS.is_multiple_of(groups), "{groups} groups of 16 channels");
        let mut places = Places::default();
        let steps = places.steps();
        let norm_out = places.norm("norm_out", CHANNELS);
        let conv_out = places.conv("conv_out", CHANNELS, FEATURES, 3);
        let gs_conv = places.conv("gs_conv", FEATURES, FEATURES, 1);
        Self { groups, steps, norm_out, conv_out, gs_conv, tensors: places.tensors }
    }

    /// All parameters in the order of the flat vector.
    pub fn tensors(&self) -> &[Tensor] {
        &self.tensors
    }

    /// Length of the flat vector.
    pub fn parameters(&self) -> usize {
        self.gs_conv.bias.end
    }

    pub(super) fn norm<'a>(&self, norm: &Norm, parameters: &'a [f32]) -> GroupNorm<'a> {
        GroupNorm {
            groups: self.groups,
            epsilon: EPSILON,
            gamma: &parameters[norm.gamma.clone()],
            beta: &parameters[norm.beta.clone()],
        }
    }
}

/// Hands out places one after another.
#[derive(Default)]
struct Places {
    tensors: Vec<Tensor>,
    norms: usize,
}

impl Places {
    fn place(&mut self, name: String, shape: &[usize]) -> Range<usize> {
        let start = self.tensors.last().map_or(0, |tensor| tensor.range.end);
        let range = start..start + shape.iter().product::<usize>();
        self.tensors.push(Tensor { name, shape: shape.to_vec(), range: range.clone() });
        range
    }

    fn conv(&mut self, name: &str, from: usize, to: usize, side: usize) -> Conv {
        let weight = self.place(format!("{name}.weight"), &[to, from, side, side]);
        let bias = self.place(format!("{name}.bias"), &[to]);
        Conv { weight, bias, shape: [to, from, side * side] }
    }

    fn norm(&mut self, name: &str, channels: usize) -> Norm {
        let gamma = self.place(format!("{name}.weight"), &[channels]);
        let beta = self.place(format!("{name}.bias"), &[channels]);
        self.norms += 1;
        Norm { gamma, beta, index: self.norms - 1 }
    }

    fn residual(&mut self, name: &str, from: usize) -> Residual {
        Residual {
            norm1: self.norm(&format!("{name}.norm1"), from),
            conv1: self.conv(&format!("{name}.conv1"), from, CHANNELS, 3),
            norm2: self.norm(&format!("{name}.norm2"), CHANNELS),
            conv2: self.conv(&format!("{name}.conv2"), CHANNELS, CHANNELS, 3),
            shortcut: (from != CHANNELS).then(|| self.conv(&format!("{name}.shortcut"), from, CHANNELS, 1)),
        }
    }

    /// The order of the paper's table (SNAPSNAP §8.2), which is the state dict's as well.
    fn steps(&mut self) -> Vec<Step> {
        let conv = self.conv("conv_in", INPUT_CHANNELS, CHANNELS, 3);
        let mut steps = vec![Step::Convolve { conv, from: 0, stride: 1, enlarge: false }];
        let mut skips = vec![steps.len()];
        for level in 0..LEVELS {
            for i in 0..2 {
                let block = Box::new(self.residual(&format!("down_blocks.{level}.nets.{i}"), CHANNELS));
                steps.push(Step::Residual { block, from: steps.len(), skip: None });
                skips.push(steps.len());
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("down_blocks.{level}.downsample"), CHANNELS, CHANNELS, 3);
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 2, enlarge: false });
                skips.push(steps.len());
            }
        }
        for i in 0..2 {
            let block = Box::new(self.residual(&format!("mid_block.nets.{i}"), CHANNELS));
            steps.push(Step::Residual { block, from: steps.len(), skip: None });
        }
        for level in 0..LEVELS {
            for i in 0..3 {
                let block = Box::new(self.residual(&format!("up_blocks.{level}.nets.{i}"), 2 * CHANNELS));
                steps.push(Step::Residual { block, from: steps.len(), skip: skips.pop() });
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("up_blocks.{level}.upsample"), CHANNELS, CHANNELS, 3);
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 1, enlarge: true });
            }
        }
        steps
    }
}
