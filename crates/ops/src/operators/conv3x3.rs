//! 3×3 convolutions with stride 1 and padding 1 by Winograd's F(4×4, 3×3) on images `[B, C, H, W]`: 36 instead of 144
//! multiplications per sixteen outputs and pair of channels.
//!
//! Filters are transformed once. Each task computes a band of rows: it transforms the inputs of a block of tiles,
//! multiplies by the filters of each of the 36 points, transforms the products and writes them. A block is so large
//! that reading all filters for it costs little, and so small that intermediate results stay in the cache.
//!
//! The gradient of the input is the same convolution with filters turned by 180°, and with inputs and outputs
//! exchanged. The gradient of the weight is the transposed method: the products of transformed inputs and transformed
//! output gradients are summed over all tiles, and the sum is transformed back. This takes 36 multiplications, too.

use pulp::Arch;
use rayon::prelude::*;

use super::Convolution;
use super::elements::channel_sums;
use crate::buffers::{Floats, take};
use crate::op::InputGradients;
use crate::winograd::planes::{Planes, Scatter};
use crate::winograd::product::{Left, PANEL, Panels, Product};
use crate::winograd::transforms::{self, Block, Inputs, Outputs, POINTS, TILE, lines};
use crate::winograd::{GROUP, pieces};

/// Floats of a block's transformed inputs and products together: 1 MiB, most of which fits a second-level cache.
const BLOCK_FLOATS: usize = 256 * 1024;

/// Up to this number of pixels of all images, the weight's gradient is summed tap by tap. If a channel is positive in a
/// few pixels only, the gradients of some taps are 0. Winograd's method would round, and AdamW scale up the rounding.
const FEW_PIXELS: usize = 1024;

impl Convolution {
    /// The result of a 3×3 convolution with stride 1.
    pub(super) fn winograd(&self, x: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let filters = self.transformed(weight, [9 * self.inputs, 9], false);
        self.run(x, &filters, bias, None)
    }

    /// The gradients of a 3×3 convolution with stride 1.
    pub(super) fn winograd_gradients(&self, given: [&[f32]; 3], wanted: [bool; 3]) -> InputGradients {
        let ([x, weight, dy], [of_input, of_weight, of_bias]) = (given, wanted);
        let input = of_input.then(|| {
            let back = Self { inputs: self.outputs, outputs: self.inputs, rectified: false, ..*self };
            let filters = back.transformed(weight, [9, 9 * self.inputs], true);
            back.run(dy, &filters, &[], self.rectified.then_some(x))
        });
        if of_weight && self.batch * self.pixels() <= FEW_PIXELS {
            let [_, weight, bias] = self.unfolded_gradients(given, [false, true, of_bias]);
            [input, weight, bias]
        } else if of_weight {
            // The gradient of the bias is a by-product.
            let [weight, bias] = self.weight_gradient(x, dy);
            [input, Some(weight), of_bias.then_some(bias)]
        } else {
            [input, None, of_bias.then(|| channel_sums(dy, self.batch, self.outputs))]
        }
    }

    /// The transformed filters `[panels][36][inputs in whole groups][32]`. `strides`: floats from one output to the
    /// next, and from one input to the next. `turned`: by 180°.
    fn transformed(&self, weight: &[f32], strides: [usize; 2], turned: bool) -> Floats {
        let panel = POINTS * self.inputs.next_multiple_of(GROUP) * PANEL;
        let mut filters = Floats::new(self.outputs.div_ceil(PANEL) * panel);
        filters.par_chunks_exact_mut(panel).enumerate().for_each(|(i, out)| {
            let weights = &weight[i * PANEL * strides[0]..];
            let outputs = PANEL.min(self.outputs - i * PANEL);
            transforms::filters(weights, [outputs, self.inputs], strides, turned, out);
        });
        filters
    }

    /// Winograd's method with transformed filters. The result is 0 where `mask` is not positive, if there is a mask.
    fn run(&self, x: &[f32], filters: &[f32], bias: &[f32], mask: Option<&[f32]>) -> Vec<f32> {
        let (Self { height, width, rectified, .. }, plane) = (*self, self.pixels());
        assert_eq!(x.len(), self.batch * self.inputs * plane);
        let mut padded = bias.to_vec();
        padded.resize(self.outputs.next_multiple_of(GROUP), 0.0);
        let mut out = take(self.batch * self.outputs * plane);
        let band = self.band_rows();
        let tasks: Vec<_> = out
            .chunks_exact_mut(self.outputs * plane)
            .zip(x.chunks_exact(self.inputs * plane))
            .enumerate()
            .flat_map(|(image, (out, x))| {
                let pieces = pieces(out.chunks_exact_mut(plane), plane, band * TILE * width);
                pieces.into_iter().enumerate().map(move |(i, out)| (image, x, i * band, out))
            })
            .collect();
        tasks.into_par_iter().for_each(|(image, data, row, mut out)| {
            let planes = Planes { data, height, width, rectified };
            let pixels = out[0].len();
            let mut grouped = Floats::new(padded.len() * pixels);
            let mut slices: Vec<_> = grouped.chunks_exact_mut(pixels * GROUP).collect();
            self.band(&planes, row, filters, &padded, &mut slices);
            for (group, planes) in out.chunks_mut(GROUP).enumerate() {
                let first = (image * self.outputs + group * GROUP) * plane + row * TILE * width;
                let mask = mask.map(|mask| (&mask[first..], plane));
                let pixels = &grouped[group * pixels * GROUP..][..pixels * GROUP];
                Arch::new().dispatch(Scatter { pixels, planes, mask });
            }
        });
        out
    }

    /// Computes output rows from tile row `row` on: `[rows][width][16]` per group. `bias` has whole groups.
    fn band(&self, source: &Planes, row: usize, filters: &[f32], bias: &[f32], out: &mut [&mut [f32]]) {
        let (arch, width) = (Arch::new(), self.width);
        let rows = (out[0].len() / (width * GROUP)).div_ceil(TILE);
        let columns = width.div_ceil(TILE);
        // If a row of tiles is longer than a block, it is divided into parts of equal width.
        let part = columns.div_ceil(columns.div_ceil(self.block_tiles()));
        let (inputs, outputs) = (self.inputs.next_multiple_of(GROUP), bias.len());
        // With an odd stride, the 36 points of a tile are in different sets of the cache.
        let stride = (rows * part) | 1;
        let mut read = Floats::new(lines(part));
        let mut points = Floats::new(POINTS * inputs * stride);
        let mut products = Floats::new(POINTS * outputs * stride);
        for column in (0..columns).step_by(part) {
            let block = Block { row, column, rows, columns: part.min(columns - column) };
            let lines = &mut read[..lines(block.columns)];
            arch.dispatch(Inputs { source, block, stride, lines, out: &mut points });
            let per_point =
                points.chunks_exact(inputs * stride).zip(products.chunks_exact_mut(outputs * stride));
            for (point, (values, products)) in per_point.enumerate() {
                let left =
                    Left { values, stride: stride * GROUP, groups: inputs / GROUP, rows: block.tiles() };
                let right =
                    Panels { values: &filters[point * inputs * PANEL..], stride: POINTS * inputs * PANEL };
                let out = &mut products.chunks_exact_mut(stride * GROUP).collect::<Vec<_>>();
                arch.dispatch(Product { left, right, out });
            }
            arch.dispatch(Outputs { products: &products, block, stride, bias, width, out });
        }
    }

    /// Tiles per block.
    pub(super) fn block_tiles(&self) -> usize {
        (BLOCK_FLOATS / (POINTS * (self.inputs + self.outputs))).max(GROUP)
    }

    /// Rows of tiles per task.
    pub(super) fn band_rows(&self) -> usize {
        (self.block_tiles() / self.width.div_ceil(TILE)).clamp(1, self.height.div_ceil(TILE))
    }
}
