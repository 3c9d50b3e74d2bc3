//! 3×3 convolutions with stride 1 and padding 1 by Winograd's F(4×4, 3×3): 36 instead of 144 multiplications per
//! sixteen outputs and pair of channels.
//!
//! Filters are transformed once. Then tasks take bands of rows: transform the inputs of a block of tiles, multiply by the
//! filters of each of the 36 points, transform the products and write them where they belong. A block is large enough
//! that reading all filters for it costs little, and small enough that what lies between the steps stays in the cache.

use pulp::Arch;
use rayon::prelude::*;

use super::image::{Image, Source};
use super::pointwise::Pointwise;
use super::product::{Left, PANEL, Product, Right};
use super::transforms::{Block, Filters, Inputs, Lines, Outputs, POINTS, TILE, Then, lines};
use super::{Buffers, GROUP, pieces};

/// Floats that a block's transformed inputs and products take together: 2 MiB.
const BLOCK_FLOATS: usize = 512 * 1024;

/// A convolution with its filters transformed.
#[derive(Debug)]
pub struct Conv3x3 {
    inputs: usize,
    outputs: usize,
    /// `[panels][36][inputs in whole groups][32]`.
    filters: Vec<f32>,
    bias: Vec<f32>,
}

impl Conv3x3 {
    /// `weights` `[outputs, inputs, 3, 3]`, `bias` `[outputs]` or nothing.
    pub fn new(weights: &[f32], bias: &[f32], [inputs, outputs]: [usize; 2], buffers: &Buffers) -> Self {
        let weights = Weights { values: weights, strides: [9 * inputs, 9], turned: false };
        let filters = weights.transform([inputs, outputs], buffers);
        let mut bias = bias.to_vec();
        bias.resize(outputs.next_multiple_of(GROUP), 0.0);
        Self { inputs, outputs, filters, bias }
    }

    /// `[inputs, H, W]` → `[outputs, H, W]`. The layer's memory goes back to `buffers`.
    pub fn run(self, source: &Source, buffers: &Buffers) -> Image {
        let mut out = Image::take(self.outputs, source.size(), buffers);
        self.into_image(source, &mut out, Then::Store, buffers);
        out
    }

    /// Adds the result to `out` `[outputs, H, W]`.
    pub fn add_to(self, out: &mut Image, source: &Source, buffers: &Buffers) {
        self.into_image(source, out, Then::Add, buffers);
    }

    fn into_image(self, source: &Source, out: &mut Image, then: Then, buffers: &Buffers) {
        let [_, width] = source.size();
        let (plane, band) = (out.plane(), self.band_rows(width));
        pieces(&mut out.data, plane, band * TILE * width * GROUP)
            .into_par_iter()
            .enumerate()
            .for_each(|(i, mut out)| self.band(source, i * band, then, &mut out, buffers));
        buffers.give(self.filters);
    }

    /// last(max(result, 0)) as planes `[last's outputs, H, W]`; the result itself, which would be large, is never stored.
    pub fn rectified_into(self, last: &Pointwise, source: &Source, buffers: &Buffers) -> Vec<f32> {
        let [height, width] = source.size();
        let band = self.band_rows(width);
        let mut planes = vec![0.0; last.outputs() * height * width];
        let pieces = pieces(&mut planes, height * width, band * TILE * width);
        pieces.into_par_iter().enumerate().for_each(|(i, mut out)| {
            let plane = out[0].len() * GROUP;
            let mut features = buffers.take(self.bias.len() * out[0].len());
            let mut slices: Vec<&mut [f32]> = features.chunks_exact_mut(plane).collect();
            self.band(source, i * band, Then::Rectify, &mut slices, buffers);
            let mut pixels = buffers.take(last.width() * out[0].len());
            last.pixels(&features, plane, &mut pixels.chunks_exact_mut(plane).collect::<Vec<_>>());
            for (c, out) in out.iter_mut().enumerate() {
                let (pixels, _) = pixels[c / GROUP * plane..].as_chunks::<GROUP>();
                out.iter_mut().zip(pixels).for_each(|(out, pixel)| *out = pixel[c % GROUP]);
            }
            buffers.give(features);
            buffers.give(pixels);
        });
        buffers.give(self.filters);
        planes
    }

    /// Tiles per block.
    fn block_tiles(&self) -> usize {
        (BLOCK_FLOATS / (POINTS * (self.inputs + self.outputs))).max(GROUP)
    }

    /// Rows of tiles per task.
    fn band_rows(&self, width: usize) -> usize {
        (self.block_tiles() / width.div_ceil(TILE)).max(1)
    }

    /// Output rows from tile row `row` on, as many as `out` holds per group.
    fn band(&self, source: &Source, row: usize, then: Then, out: &mut [&mut [f32]], buffers: &Buffers) {
        let Self { inputs, filters, bias, .. } = self;
        let [_, width] = source.size();
        let tiles = self.block_tiles();
        Bands { inputs: *inputs, filters, bias, width, tiles, then }.run(source, row, out, buffers);
    }
}

/// Filters, `strides` floats from one output to the next and from one input to the next, perhaps turned by 180°.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    pub values: &'a [f32],
    pub strides: [usize; 2],
    pub turned: bool,
}

impl Weights<'_> {
    /// `[panels][36][inputs in whole groups][32]`.
    pub fn transform(self, [inputs, outputs]: [usize; 2], buffers: &Buffers) -> Vec<f32> {
        let Self { values, strides, turned } = self;
        let panel = POINTS * inputs.next_multiple_of(GROUP) * PANEL;
        let mut filters = buffers.take(outputs.div_ceil(PANEL) * panel);
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
    /// Of [`Weights::transform`].
    pub filters: &'a [f32],
    /// Of all outputs in whole groups.
    pub bias: &'a [f32],
    /// Pixels of a row.
    pub width: usize,
    /// Tiles per block.
    pub tiles: usize,
    pub then: Then,
}

impl Bands<'_> {
    /// Output rows from tile row `row` on, as many as `out` `[rows][width][16]` holds per group.
    pub fn run(&self, source: &impl Lines, row: usize, out: &mut [&mut [f32]], buffers: &Buffers) {
        let Self { filters, bias, width, then, .. } = *self;
        let arch = Arch::new();
        let rows = (out[0].len() / (width * GROUP)).div_ceil(TILE);
        let columns = width.div_ceil(TILE);
        // Parts of equal width if a row of tiles is more than a block.
        let part = columns.div_ceil(columns.div_ceil(self.tiles));
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
            arch.dispatch(Outputs { products, block, stride, bias, then, width, out });
        }
        [read, points, products].into_iter().for_each(|buffer| buffers.give(buffer));
    }
}
