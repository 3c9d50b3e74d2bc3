//! Transposed convolutions whose kernel is as large as their stride, for training: every input pixel becomes a square of
//! its own, so that each pass is one matrix product per block of pixels and a rearrangement.

use rayon::prelude::*;

use super::elements::total;
use super::{Gradients, Wanted, join};
use crate::buffers::{give, take};
use crate::multiply::Multiply;
use crate::wide::pieces;

/// Floats of a block's inputs and squares: 256 KiB.
const BLOCK_FLOATS: usize = 64 * 1024;
/// Parts that the weight's gradient is summed in at most, before they are joined in their order.
const PARTS: usize = 16;

/// Sizes of a convolution.
#[derive(Debug, Clone, Copy)]
pub struct Enlarge {
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
    /// Side of the kernel, and how many times as large the output is.
    pub stride: usize,
}

/// Rows of the input of one image.
struct Block<'a> {
    image: usize,
    row: usize,
    rows: usize,
    /// Where results belong, channel by channel.
    out: Vec<&'a mut [f32]>,
}

impl Enlarge {
    /// `x` `[B, inputs, H, W]`, `weight` `[inputs, outputs, stride, stride]`, `bias` `[outputs]` →
    /// `[B, outputs, stride·H, stride·W]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let Self { inputs, outputs, width, stride: s, .. } = *self;
        let (plane, squares) = (self.height * width, s * s);
        let mut out = take(self.batch * outputs * plane * squares);
        self.blocks(Some((&mut out, outputs, squares))).into_par_iter().for_each(|block| {
            let n = block.rows * width;
            let x = &x[block.image * inputs * plane + block.row * width..];
            let mut places = take(outputs * squares * n);
            let lhs = (weight, [outputs * squares, 1]);
            Multiply { size: [outputs * squares, n, inputs], lhs, rhs: (x, [1, plane]), add: false }
                .write(&mut places, n);
            for (c, (out, places)) in block.out.into_iter().zip(places.chunks_exact(squares * n)).enumerate()
            {
                let bias = bias.map_or(0.0, |bias| bias[c]);
                for (y, row) in out.chunks_exact_mut(s * width).enumerate() {
                    for j in 0..s {
                        let places = &places[(y % s * s + j) * n + y / s * width..][..width];
                        let values = row[j..].iter_mut().step_by(s).zip(places);
                        values.for_each(|(out, x)| *out = x + bias);
                    }
                }
            }
            give(places);
        });
        out
    }

    /// Gradients from that of the output, `dy` `[B, outputs, stride·H, stride·W]`.
    pub fn backward(&self, x: &[f32], weight: &[f32], dy: &[f32], wanted: Wanted) -> Gradients {
        let mut dx = wanted.input.then(|| take(x.len()));
        let mut blocks = self.blocks(dx.as_deref_mut().map(|dx| (dx, self.inputs, 1)));
        let size = blocks.len().div_ceil(PARTS);
        let parts: Vec<_> =
            blocks.par_chunks_mut(size).map(|part| self.part(part, x, weight, dy, wanted)).collect();
        Gradients {
            input: dx,
            weight: wanted.weight.then(|| join(parts.iter().map(|(weights, _)| &weights[..]), weight.len())),
            bias: wanted.bias.then(|| join(parts.iter().map(|(_, biases)| &biases[..]), self.outputs)),
        }
    }

    /// One part's gradients; those of weight and bias are returned, empty where not wanted.
    fn part(
        &self,
        part: &mut [Block],
        x: &[f32],
        weight: &[f32],
        dy: &[f32],
        wanted: Wanted,
    ) -> (Vec<f32>, Vec<f32>) {
        let Self { inputs, outputs, width, stride: s, .. } = *self;
        let (plane, columns) = (self.height * width, outputs * s * s);
        let mut weights = vec![0.0; if wanted.weight { inputs * columns } else { 0 }];
        let mut biases = vec![0.0; if wanted.bias { outputs } else { 0 }];
        let mut add = false;
        for Block { image, row, rows, out } in part {
            let n = *rows * width;
            let x = &x[*image * inputs * plane + *row * width..];
            let mut places = take(columns * n);
            for (c, places) in places.chunks_exact_mut(s * s * n).enumerate() {
                let dy = &dy[((*image * outputs + c) * plane + *row * width) * s * s..][..n * s * s];
                for (y, line) in dy.chunks_exact(s * width).enumerate() {
                    for j in 0..s {
                        let places = &mut places[(y % s * s + j) * n + y / s * width..][..width];
                        places.iter_mut().zip(line[j..].iter().step_by(s)).for_each(|(out, x)| *out = *x);
                    }
                }
                if wanted.bias {
                    biases[c] += total(places);
                }
            }
            if wanted.weight {
                let (lhs, rhs) = ((x, [1, plane]), (&places[..], [n, 1]));
                Multiply { size: [inputs, columns, n], lhs, rhs, add }.write(&mut weights, columns);
                add = true;
            }
            if wanted.input {
                let mut results = take(inputs * n);
                let (lhs, rhs) = ((weight, [1, columns]), (&places[..], [1, n]));
                Multiply { size: [inputs, n, columns], lhs, rhs, add: false }.write(&mut results, n);
                out.iter_mut().zip(results.chunks_exact(n)).for_each(|(out, dx)| out.copy_from_slice(dx));
                give(results);
            }
            give(places);
        }
        (weights, biases)
    }

    /// All blocks, with the slices that belong to them of `out`, which has some channels and some floats per input pixel.
    fn blocks<'a>(&self, out: Option<(&'a mut [f32], usize, usize)>) -> Vec<Block<'a>> {
        let floats = self.width * (self.inputs + self.outputs * self.stride * self.stride);
        let band = (BLOCK_FLOATS / floats).clamp(1, self.height);
        let mut blocks: Vec<_> = (0..self.batch)
            .flat_map(|image| (0..self.height).step_by(band).map(move |row| (image, row)))
            .map(|(image, row)| Block { image, row, rows: band.min(self.height - row), out: Vec::new() })
            .collect();
        if let Some((out, channels, floats)) = out {
            let (plane, piece) = (self.height * self.width * floats, band * self.width * floats);
            let slices = out.chunks_exact_mut(channels * plane).flat_map(|image| pieces(image, plane, piece));
            blocks.iter_mut().zip(slices).for_each(|(block, slices)| block.out = slices);
        }
        blocks
    }
}
