//! The operators in order of execution, and where their parameters lie in one flat vector.

use std::collections::HashMap;
use std::ops::Range;

use super::LEVELS;
use crate::fused::GroupNorm;

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

impl Network {
    /// The network whose parameters have these `shapes`, by their names in a checkpoint.
    ///
    /// # Panics
    /// If a parameter is missing.
    pub fn new(shapes: &HashMap<String, Vec<usize>>) -> Self {
        let mut places = Places { shapes, names: Vec::new(), end: 0, norms: 0 };
        let steps = places.steps();
        let norm_out = places.norm("norm_out");
        let conv_out = places.conv("conv_out");
        let gs_conv = places.conv("gs_conv");
        Self { steps, norm_out, conv_out, gs_conv, names: places.names }
    }

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
struct Places<'a> {
    shapes: &'a HashMap<String, Vec<usize>>,
    names: Vec<String>,
    /// Length of the flat vector so far.
    end: usize,
    norms: usize,
}

impl<'a> Places<'a> {
    /// The place and the shape of a parameter.
    fn place(&mut self, name: String) -> (Range<usize>, &'a [usize]) {
        let shape = self.shapes.get(&name).unwrap_or_else(|| panic!("the network has no parameter {name}"));
        let start = self.end;
        self.end += shape.iter().product::<usize>();
        self.names.push(name);
        (start..self.end, shape.as_slice())
    }

    fn conv(&mut self, name: &str) -> Conv {
        let (weight, shape) = self.place(format!("{name}.weight"));
        let &[to, from, height, width] = shape else { panic!("{name} is no convolution") };
        let (bias, _) = self.place(format!("{name}.bias"));
        Conv { weight, bias, shape: [to, from, height * width] }
    }

    fn norm(&mut self, name: &str) -> Norm {
        let (gamma, _) = self.place(format!("{name}.weight"));
        let (beta, _) = self.place(format!("{name}.bias"));
        self.norms += 1;
        Norm { gamma, beta, index: self.norms - 1 }
    }

    fn residual(&mut self, name: &str) -> Box<Residual> {
        let shortcut = format!("{name}.shortcut");
        Box::new(Residual {
            norm1: self.norm(&format!("{name}.norm1")),
            conv1: self.conv(&format!("{name}.conv1")),
            norm2: self.norm(&format!("{name}.norm2")),
            conv2: self.conv(&format!("{name}.conv2")),
            shortcut: self.shapes.contains_key(&format!("{shortcut}.weight")).then(|| self.conv(&shortcut)),
        })
    }

    /// All operators in the order of the state dict.
    fn steps(&mut self) -> Vec<Step> {
        let conv = self.conv("conv_in");
        let mut steps = vec![Step::Convolve { conv, from: 0, stride: 1, enlarge: false }];
        let mut skips = vec![steps.len()];
        for level in 0..LEVELS {
            for i in 0..2 {
                let block = self.residual(&format!("down_blocks.{level}.nets.{i}"));
                steps.push(Step::Residual { block, from: steps.len(), skip: None });
                skips.push(steps.len());
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("down_blocks.{level}.downsample"));
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 2, enlarge: false });
                skips.push(steps.len());
            }
        }
        for i in 0..2 {
            let block = self.residual(&format!("mid_block.nets.{i}"));
            steps.push(Step::Residual { block, from: steps.len(), skip: None });
        }
        for level in 0..LEVELS {
            for i in 0..3 {
                let block = self.residual(&format!("up_blocks.{level}.nets.{i}"));
                steps.push(Step::Residual { block, from: steps.len(), skip: skips.pop() });
            }
            if level + 1 < LEVELS {
                let conv = self.conv(&format!("up_blocks.{level}.upsample"));
                steps.push(Step::Convolve { conv, from: steps.len(), stride: 1, enlarge: true });
            }
        }
        steps
    }
}
