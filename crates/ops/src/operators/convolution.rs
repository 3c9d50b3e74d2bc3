//! Convolutions with zero padding of half a kernel, on images `[B, C, H, W]`.

use crate::op::{Given, InputGradients, Kept, Kernel};

/// Sizes of a convolution, and whether it reads max(x, 0) instead of its input x.
#[derive(Debug, Clone, Copy)]
pub struct Convolution {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows of the input.
    pub height: usize,
    /// Columns of the input.
    pub width: usize,
    /// Rows and columns of the kernel: 1, with stride 1, or 3.
    pub side: usize,
    /// Rows and columns of the input per row and column of the output.
    pub stride: usize,
    /// Reads max(x, 0).
    pub rectified: bool,
    /// Products of a kernel of one pixel in bf16, if the processor has the instructions.
    pub in_bf16: bool,
}

impl Kernel for Convolution {
    /// `x` `[B, inputs, H, W]`, `weight` `[outputs, inputs, side, side]`, `bias` `[outputs]` →
    /// `[B, outputs, ⌈H/stride⌉, ⌈W/stride⌉]`.
    fn forward(&self, [x, weight, bias]: [&[f32]; 3], _keep: bool) -> (Vec<f32>, Kept) {
        let out = match (self.side, self.stride) {
            (1, _) => self.pointwise(x, weight, bias),
            (_, 1) => self.winograd(x, weight, bias),
            _ => self.unfolded(x, weight, bias),
        };
        (out, None)
    }

    fn backward(&self, Given { inputs: [x, weight, _], upstream, wanted, .. }: Given) -> InputGradients {
        let given = [x, weight, upstream];
        match (self.side, self.stride) {
            (1, _) => self.pointwise_gradients(given, wanted),
            (_, 1) => self.winograd_gradients(given, wanted),
            _ => self.unfolded_gradients(given, wanted),
        }
    }
}

impl Convolution {
    /// Pixels of an image of the input.
    pub(super) fn pixels(&self) -> usize {
        self.height * self.width
    }
}
