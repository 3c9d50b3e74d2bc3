//! 3×3 convolutions with stride 1 and padding 1 by Winograd's F(4×4, 3×3): 36 instead of 144 multiplications per
//! sixteen outputs and pair of channels.
//!
//! Filters are transformed once. Each task computes a band of rows: it transforms the inputs of a block of tiles,
//! multiplies by the filters of each of the 36 points, transforms the products and writes them. A block is so large
//! that reading all filters for it costs little, and so small that intermediate results stay in the cache.

use pulp::Arch;
use rayon::prelude::*;

use super::GROUP;
use super::product::{Left, PANEL, Product, Right};
use super::transforms::{Block, Filters, Inputs, Lines, Outputs, POINTS, TILE, lines};
use crate::buffers::{give, take};

/// Filters. `strides`: floats from one output to the next, and from one input to the next. `turned`: by 180°.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    pub values: &'a [f32],
    pub strides: [usize; 2],
    pub turned: bool,
}

impl Weights<'_> {
    /// The transformed filters `[panels][36][inputs in whole groups][32]`.
    pub fn transform(self, [inputs, outputs]: [usize; 2]) -> Vec<f32> {
        let Self { values, strides, turned } = self;
        let panel = POINTS * inputs.next_multiple_of(GROUP) * PANEL;
        let mut filters = take(outputs.div_ceil(PANEL) * panel);
        let arch = Arch::new();
        filters.par_chunks_exact_mut(panel).enumerate().for_each(|(i, out)| {
            let weights = &values[i * PANEL * strides[0]..];
            let outputs = PANEL.min(outputs - i * PANEL);
            arch.dispatch(Filters { weights, outputs, inputs, strides, turned, out });
        });
        filters
    }
}

/// A convolution of bands of rows.
#[derive(Debug, Clone, Copy)]
pub struct Bands<'a> {
    pub inputs: usize,
    /// From [`Weights::transform`].
    pub filters: &'a [f32],
    /// One value per output, in whole groups.
    pub bias: &'a [f32],
    /// Pixels of a row.
    pub width: usize,
    /// Tiles per block.
    pub tiles: usize,
}

impl Bands<'_> {
    /// Computes output rows from tile row `row` on. `out` has `[rows][width][16]` per group.
    pub fn run(&self, source: &impl Lines, row: usize, out: &mut [&mut [f32]]) {
        let Self { filters, bias, width, .. } = *self;
        let arch = Arch::new();
        let rows = (out[0].len() / (width * GROUP)).div_ceil(TILE);
        let columns = width.div_ceil(TILE);
        // If a row of tiles is longer than a block, it is divided into parts of equal width.
        let part = columns.div_ceil(columns.div_ceil(self.tiles));
        let (inputs, outputs) = (self.inputs.next_multiple_of(GROUP), bias.len());
        // With an odd stride, the 36 points of a tile are in different sets of the cache.
        let stride = (rows * part) | 1;
        let mut read = take(lines(part));
        let mut points = take(POINTS * inputs * stride);
        let mut products = take(POINTS * outputs * stride);
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
            arch.dispatch(Outputs { products, block, stride, bias, width, out });
        }
        [read, points, products].into_iter().for_each(give);
    }
}
