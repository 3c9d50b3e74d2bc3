//! The operators in order of execution, and where their parameters lie in one flat vector.

use std::ops::Range;

use super::{FEATURES, INPUT_CHANNELS, LEVELS};
use crate::fused::{CHANNELS, GroupNorm};

/// Where the parameters of a convolution lie.
#[derive(Debug, Clone)]
pub(super) struct Conv {
    pub weight: Range<usize>,
    pub bias: Range<usize>,
    /// `[out, in, k²]`.
    pub shape: [usize; 3],
}

/// Where the parameters of a normalisation lie, and its number.
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

/// Step i computes plane i + 1. Plane 0 is the input.
#[derive(Debug, Clone)]
pub(super) enum Step {
    Convolve { conv: Conv, from: usize, stride: usize, enlarge: bool },
    Residual { block: Box<Residual>, from: usize, skip: Option<usize> },
}

/// The network's structure.
#[derive(Debug, Clone)]
pub struct Network {
    pub(super) steps: Vec<Step>,
    pub(super) norm_out: Norm,
    pub(super) conv_out: Conv,
    pub(super) gs_conv: Conv,
    names: Vec<String>,
}

impl Default for Network {
    fn default() -> Self {
        let mut places = Places::default();
        let steps = places.steps();
        let norm_out = places.norm("norm_out", CHANNELS);
        let conv_out = places.conv("conv_out", [FEATURES, CHANNELS, 9]);
        let gs_conv = places.conv("gs_conv", [FEATURES, FEATURES, 1]);
        Self { steps, norm_out, conv_out, gs_conv, names: places.names }
    }
}

impl Network {
    /// The names of all parameters, as in the authors' state dict, in the order of the flat vector.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Length of the flat vector.
    pub fn parameters(&self) -> usize {
        self.gs_conv.bias.end
    }

    /// The last step that reads each plane. The normalisation at the end counts as one more step.
    pub(super) fn last_readers(&self) -> Vec<usize> {
        let mut readers = vec![0; self.steps.len() + 1];
        for (i, step) in self.steps.iter().enumerate() {
            let (Step::Convolve { from, .. } | Step::Residual { from, .. }) = step;
            readers[*from] = i;
            if let Step::Residual { skip: Some(skip), .. } = step {
                readers[*skip] = i;
            }
        }
        readers[self.steps.len()] = self.steps.len();
        readers
    }

    pub(super) fn norm<'a>(&self, norm: &Norm, parameters: &'a [f32]) -> GroupNorm<'a> {
        GroupNorm { gamma: &parameters[norm.gamma.clone()], beta: &parameters[norm.beta.clone()] }
    }
}

/// Assigns consecutive places in the flat vector.
#[derive(Default)]
struct Places {
    names: Vec<String>,
    /// Length of the flat vector so far.
    end: usize,
    norms: usize,
}

impl Places {
    /// The place of a parameter of `len` values.
    fn place(&mut self, name: String, len: usize) -> Range<usize> {
        self.names.push(name);
        self.end += len;
        self.end - len..self.end
    }

    fn conv(&mut self, name: &str, shape: [usize; 3]) -> Conv {
        let weight = self.place(format!("{name}.weight"), shape.iter().product());
        Conv { weight, bias: self.place(format!("{name}.bias"), shape[0]), shape }
    }

    fn norm(&mut self, name: &str, channels: usize) -> Norm {
        let [gamma, beta] = ["weight", "bias"].map(|part| self.place(format!("{name}.{part}"), channels));
        self.norms += 1;
        Norm { gamma, beta, index: self.norms - 1 }
    }

    /// A block that reads `from` channels.
    fn residual(&mut self, name: &str, from: usize) -> Box<Residual> {
        let shortcut = format!("{name}.shortcut");
        Box::new(Residual {
            norm1: self.norm(&format!("{name}.norm1"), from),
            conv1: self.conv(&format!("{name}.conv1"), [CHANNELS, from, 9]),
            norm2: self.norm(&format!("{name}.norm2"), CHANNELS),
            conv2: self.conv(&format!("{name}.conv2"), [CHANNELS, CHANNELS, 9]),
            shortcut: (from != CHANNELS).then(|| self.conv(&shortcut, [CHANNELS, from, 1])),
        })
    }

    /// All operators in the order of the state dict.
    fn steps(&mut self) -> Vec<Step> {
        let conv = self.conv("conv_in", [CHANNELS, INPUT_CHANNELS, 9]);
        let mut steps = vec![Step::Convolve { conv, from: 0, stride: 1, enlarge: false }];
        let mut skips = vec![steps.len()];
        for level in 0..LEVELS {
            for i in 0..2 {
                let block = self.residual(&format!("down_blocks.{level}.nets.{i}"), CHANNELS);
                steps.push(Step::Residual { block, from: steps.len(), skip: None });
                skips.push(steps.len());
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("down_blocks.{level}.downsample"), [CHANNELS, CHANNELS, 9]);
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 2, enlarge: false });
                skips.push(steps.len());
            }
        }
        for i in 0..2 {
            let block = self.residual(&format!("mid_block.nets.{i}"), CHANNELS);
            steps.push(Step::Residual { block, from: steps.len(), skip: None });
        }
        for level in 0..LEVELS {
            for i in 0..3 {
                let block = self.residual(&format!("up_blocks.{level}.nets.{i}"), 2 * CHANNELS);
                steps.push(Step::Residual { block, from: steps.len(), skip: skips.pop() });
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("up_blocks.{level}.upsample"), [CHANNELS, CHANNELS, 9]);
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 1, enlarge: true });
            }
        }
        steps
    }
}
