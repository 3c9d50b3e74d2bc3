//! 3×3 convolutions with stride 1 and padding 1 for training: Winograd's F(4×4, 3×3) as in `wide`, on images as Burn
//! stores them.
//!
//! The gradient of the input is the same convolution with filters turned by 180° and the roles of inputs and outputs
//! exchanged. The weight gradient is the transpose of the method: the products of transformed inputs and transformed
//! output gradients are summed over all tiles before they are transformed back, 36 instead of 144 multiplications per
//! sixteen pixels and pair of channels there, too.

use pulp::Arch;
use rayon::prelude::*;

use super::elements::channel_sums;
use super::planes::{Planes, Scatter, Transposer};
use super::{Gradients, Wanted};
use crate::wide::product::{Left, PANEL, Product, Right};
use crate::wide::transforms::{Block, Filters, Inputs, Outputs, POINTS, TILE, Then, lines};
use crate::wide::{Buffers, GROUP, pieces};

/// Floats that a block's transformed inputs and products take together: 1 MiB, of which a core's second-level cache
/// holds most.
const BLOCK_FLOATS: usize = 256 * 1024;

/// Sizes of a convolution, and whether it reads max(x, 0) instead of its input x.
#[derive(Debug, Clone, Copy)]
pub struct Conv3x3 {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Reads max(x, 0).
    pub rectified: bool,
}

impl Conv3x3 {
    /// `x` `[B, inputs, H, W]`, `weight` `[outputs, inputs, 3, 3]`, `bias` `[outputs]` → `[B, outputs, H, W]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>, buffers: &Buffers) -> Vec<f32> {
        let filters = Weights { values: weight, strides: [9 * self.inputs, 9], turned: false };
        self.run(x, self.rectified, filters, bias, None, buffers)
    }

    /// Gradients from that of the output, `dy` `[B, outputs, H, W]`.
    pub fn backward(
        &self,
        x: &[f32],
        weight: &[f32],
        dy: &[f32],
        wanted: Wanted,
        buffers: &Buffers,
    ) -> Gradients {
        let input = wanted.input.then(|| {
            let filters = Weights { values: weight, strides: [9, 9 * self.inputs], turned: true };
            let back = Self { inputs: self.outputs, outputs: self.inputs, ..*self };
            back.run(dy, false, filters, None, self.rectified.then_some(x), buffers)
        });
        if wanted.weight {
            // The bias's gradient is a by-product.
            let [weight, bias] = self.weight_gradient(x, dy, buffers);
            Gradients { input, weight: Some(weight), bias: wanted.bias.then_some(bias) }
        } else {
            let bias = wanted.bias.then(|| channel_sums(dy, self.batch, self.outputs));
            Gradients { input, weight: None, bias }
        }
    }

    /// Winograd's method with any filters; where `mask` is given and not positive, the result is 0.
    fn run(
        &self,
        x: &[f32],
        rectified: bool,
        filters: Weights,
        bias: Option<&[f32]>,
        mask: Option<&[f32]>,
        buffers: &Buffers,
    ) -> Vec<f32> {
        let (plane, width) = (self.height * self.width, self.width);
        assert_eq!(x.len(), self.batch * self.inputs * plane);
        let transformed = filters.transform([self.inputs, self.outputs], buffers);
        let mut padded = bias.unwrap_or_default().to_vec();
        padded.resize(self.outputs.next_multiple_of(GROUP), 0.0);
        let mut out = buffers.take(self.batch * self.outputs * plane);
        let (band, transposer) = (self.band_rows(), Transposer::new());
        let tasks: Vec<_> = out
            .chunks_exact_mut(self.outputs * plane)
            .zip(x.chunks_exact(self.inputs * plane))
            .enumerate()
            .flat_map(|(image, (out, x))| {
                let bands = pieces(out, plane, band * TILE * width).into_iter().enumerate();
                bands.map(move |(i, out)| (image, x, i * band, out))
            })
            .collect();
        tasks.into_par_iter().for_each(|(image, data, row, mut out)| {
            let planes = Planes { data, height: self.height, width, rectified, transposer };
            let pixels = out[0].len();
            let mut grouped = buffers.take(padded.len() * pixels);
            let mut slices: Vec<_> = grouped.chunks_exact_mut(pixels * GROUP).collect();
            self.band(&planes, row, &transformed, &padded, &mut slices, buffers);
            for (group, planes) in out.chunks_mut(GROUP).enumerate() {
                let first = (image * self.outputs + group * GROUP) * plane + row * TILE * width;
                let mask = mask.map(|mask| (&mask[first..], plane));
                let pixels = &grouped[group * pixels * GROUP..][..pixels * GROUP];
                Scatter { pixels, planes, mask }.run(transposer);
            }
            buffers.give(grouped);
        });
        buffers.give(transformed);
        out
    }

    /// Tiles per block.
    pub(super) fn block_tiles(&self) -> usize {
        (BLOCK_FLOATS / (POINTS * (self.inputs + self.outputs))).max(GROUP)
    }

    /// Rows of tiles per task.
    pub(super) fn band_rows(&self) -> usize {
        (self.block_tiles() / self.width.div_ceil(TILE)).clamp(1, self.height.div_ceil(TILE))
    }

    /// Output rows from tile row `row` on, as many as `out` `[rows][width][16]` holds per group.
    fn band(
        &self,
        source: &Planes,
        row: usize,
        filters: &[f32],
        bias: &[f32],
        out: &mut [&mut [f32]],
        buffers: &Buffers,
    ) {
        let (arch, width) = (Arch::new(), self.width);
        let rows = (out[0].len() / (width * GROUP)).div_ceil(TILE);
        let columns = width.div_ceil(TILE);
        // Parts of equal width if a row of tiles is more than a block.
        let part = columns.div_ceil(columns.div_ceil(self.block_tiles()));
        let (inputs, outputs) = (self.inputs.next_multiple_of(GROUP), bias.len());
        // An odd distance puts the 36 points of a tile into different sets of the cache.
        let stride = (rows * part) | 1;
        let mut read = buffers.take(lines(part));
        let mut points = buffers.take(POINTS * inputs * stride);
        let mut products = buffers.take(POINTS * outputs * stride);
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
                    Right { values: &filters[point * inputs * PANEL..], stride: POINTS * inputs * PANEL };
                let out = &mut products.chunks_exact_mut(stride * GROUP).collect::<Vec<_>>();
                arch.dispatch(Product { left, right, bias: None, out });
            }
            let products = &products;
            arch.dispatch(Outputs { products, block, stride, bias, then: Then::Store, width, out });
        }
        [read, points, products].into_iter().for_each(|buffer| buffers.give(buffer));
    }
}

/// Filters, `strides` floats from one output to the next and from one input to the next.
struct Weights<'a> {
    values: &'a [f32],
    strides: [usize; 2],
    turned: bool,
}

impl Weights<'_> {
    /// `[panels][36][inputs in whole groups][32]`.
    fn transform(&self, [inputs, outputs]: [usize; 2], buffers: &Buffers) -> Vec<f32> {
        let panel = POINTS * inputs.next_multiple_of(GROUP) * PANEL;
        let mut filters = buffers.take(outputs.div_ceil(PANEL) * panel);
        let arch = Arch::new();
        filters.par_chunks_exact_mut(panel).enumerate().for_each(|(i, out)| {
            let weights = &self.values[i * PANEL * self.strides[0]..];
            let outputs = PANEL.min(outputs - i * PANEL);
            let (strides, turned) = (self.strides, self.turned);
            arch.dispatch(Filters { weights, outputs, inputs, strides, turned, out });
        });
        filters
    }
}
