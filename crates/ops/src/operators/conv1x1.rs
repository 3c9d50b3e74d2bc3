//! 1×1 convolutions: one matrix product per block of pixels, on images `[B, C, H, W]`. A block is so small that its
//! channels stay in the second-level cache between the products that read them.

use rayon::prelude::*;

use super::elements::{add_constant, mask, rectify, total};
use super::{Convolution, join};
use crate::buffers::{Floats, take};
use crate::multiply::{Right, product};
use crate::op::InputGradients;
use crate::winograd::pieces;

/// Floats of a block's inputs and outputs: 128 KiB.
const BLOCK_FLOATS: usize = 32 * 1024;
/// Largest number of partial sums of the weight's gradient, which are then added in a fixed order.
const PARTS: usize = 16;

/// Some pixels of one image, and the slices for their results, channel by channel.
struct Block<'a> {
    image: usize,
    first: usize,
    count: usize,
    out: Vec<&'a mut [f32]>,
}

impl Convolution {
    /// The result of a 1×1 convolution.
    pub(super) fn pointwise(&self, x: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let (Self { inputs, outputs, .. }, pixels) = (*self, self.pixels());
        let mut out = take(self.batch * outputs * pixels);
        self.blocks(Some((&mut out, outputs))).into_par_iter().for_each(|block| {
            let (n, x) = (block.count, &x[block.image * inputs * pixels + block.first..]);
            let mut read = Floats::new(if self.rectified { inputs * n } else { 0 });
            let mut results = Floats::new(outputs * n);
            let x = Right::new(self.in_bf16, [inputs, n], self.read(x, n, &mut read));
            product([outputs, n, inputs], (weight, [1, inputs]), &x, &mut results, false);
            for (c, (out, results)) in block.out.into_iter().zip(results.chunks_exact(n)).enumerate() {
                add_constant(results, bias.get(c).copied().unwrap_or(0.0), out);
            }
        });
        out
    }

    /// The gradients of a 1×1 convolution.
    pub(super) fn pointwise_gradients(&self, given: [&[f32]; 3], wanted: [bool; 3]) -> InputGradients {
        let [of_input, of_weight, of_bias] = wanted;
        let Self { inputs, outputs, .. } = *self;
        let mut dx = of_input.then(|| take(given[0].len()));
        let mut blocks = self.blocks(dx.as_deref_mut().map(|dx| (dx, inputs)));
        let size = blocks.len().div_ceil(PARTS);
        let parts: Vec<_> =
            blocks.par_chunks_mut(size).map(|part| self.of_blocks(part, given, wanted)).collect();
        [
            dx,
            of_weight.then(|| join(parts.iter().map(|(weights, _)| &weights[..]), outputs * inputs)),
            of_bias.then(|| join(parts.iter().map(|(_, biases)| &biases[..]), outputs)),
        ]
    }

    /// The gradients of some blocks. Returns the weight's and the bias's gradients, empty if unwanted.
    fn of_blocks(&self, part: &mut [Block], given: [&[f32]; 3], wanted: [bool; 3]) -> (Vec<f32>, Vec<f32>) {
        let ([x, weight, dy], [of_input, of_weight, of_bias]) = (given, wanted);
        let (Self { inputs, outputs, rectified, .. }, pixels) = (*self, self.pixels());
        let mut weights = vec![0.0; if of_weight { outputs * inputs } else { 0 }];
        let mut biases = vec![0.0; if of_bias { outputs } else { 0 }];
        let mut add = false;
        for Block { image, first, count: n, out } in part {
            let (n, x) = (*n, &x[*image * inputs * pixels..][..inputs * pixels]);
            let dy = &dy[*image * outputs * pixels..][..outputs * pixels];
            if of_weight {
                let mut read = Floats::new(if rectified { inputs * n } else { 0 });
                let (x, [_, stride]) = self.read(&x[*first..], n, &mut read);
                let (lhs, rhs) = ((&dy[*first..], [1, pixels]), Right::Plain((x, [stride, 1])));
                product([outputs, inputs, n], lhs, &rhs, &mut weights, add);
                add = true;
            }
            if of_bias {
                for (bias, dy) in biases.iter_mut().zip(dy.chunks_exact(pixels)) {
                    *bias += total(&dy[*first..][..n]);
                }
            }
            if of_input {
                let mut results = Floats::new(inputs * n);
                let rhs = &Right::Plain((&dy[*first..], [1, pixels]));
                product([inputs, n, outputs], (weight, [inputs, 1]), rhs, &mut results, false);
                let channels = out.iter_mut().zip(results.chunks_exact(n)).zip(x.chunks_exact(pixels));
                for ((out, results), x) in channels {
                    out.copy_from_slice(results);
                    if rectified {
                        mask(&x[*first..][..n], out);
                    }
                }
            }
        }
        (weights, biases)
    }

    /// The first `n` pixels of the (rectified) input: values and their (column, row) strides.
    fn read<'a>(&self, x: &'a [f32], n: usize, read: &'a mut [f32]) -> (&'a [f32], [usize; 2]) {
        if !self.rectified {
            return (x, [1, self.pixels()]);
        }
        for (read, x) in read.chunks_exact_mut(n).zip(x.chunks(self.pixels())) {
            rectify(&x[..n], read);
        }
        (read, [1, n])
    }

    /// All blocks, with their slices of `out` `[B, channels, H, W]`, if there is an output.
    fn blocks<'a>(&self, out: Option<(&'a mut [f32], usize)>) -> Vec<Block<'a>> {
        let (batch, pixels) = (self.batch, self.pixels());
        let piece = (BLOCK_FLOATS / (self.inputs + self.outputs)).next_multiple_of(64).min(pixels);
        let mut blocks: Vec<_> = (0..batch)
            .flat_map(|image| (0..pixels).step_by(piece).map(move |first| (image, first)))
            .map(|(image, first)| Block { image, first, count: piece.min(pixels - first), out: Vec::new() })
            .collect();
        if let Some((out, channels)) = out {
            let images = out.chunks_exact_mut(channels * pixels);
            let slices = images.flat_map(|image| pieces(image.chunks_exact_mut(pixels), pixels, piece));
            blocks.iter_mut().zip(slices).for_each(|(block, slices)| block.out = slices);
        }
        blocks
    }
}
