//! Wide 3×3 convolutions (stride 1, padding 1) by Winograd's minimal filtering F(2×2, 3×3): 16 instead of 36
//! multiplications per four outputs (Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks").
//!
//! Blocks of tiles small enough for the second-level cache go through: input transform, 16 matrix products, output
//! transform.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::multiply;

/// Transformed points per tile of 4×4 inputs and 2×2 outputs.
const POINTS: usize = 16;
/// Floats that a block's transformed input and output may take together: 2 MiB.
const BLOCK_FLOATS: usize = 512 * 1024;

/// Sizes of a convolution; height and width are even.
#[derive(Clone, Copy)]
pub struct Shape {
    pub batch: usize,
    pub inputs: usize,
    pub outputs: usize,
    pub height: usize,
    pub width: usize,
}

/// `x` `[batch, inputs, height, width]`, `weights` `[outputs, inputs, 3, 3]`, `bias` `[outputs]` →
/// `[batch, outputs, height, width]`. With `relu`, max(x, 0) is convolved.
pub fn conv3x3(s: Shape, x: &[f32], weights: &[f32], bias: &[f32], relu: bool) -> Vec<f32> {
    assert!(s.height.is_multiple_of(2) && s.width.is_multiple_of(2));
    let filters = transform_filters(weights, s.outputs * s.inputs);
    let columns = s.width / 2;
    let fit = (BLOCK_FLOATS / (POINTS * (s.inputs + s.outputs))).max(16);
    // Whole rows of tiles if several fit, else parts of one row.
    let (band, part) = if fit >= columns { ((fit / columns).min(s.height / 2), columns) } else { (1, fit) };
    let blocks: Vec<Block> = (0..s.batch)
        .flat_map(|sample| (0..s.height / 2).step_by(band).map(move |row| (sample, row)))
        .flat_map(|(sample, row)| (0..columns).step_by(part).map(move |column| (sample, row, column)))
        .map(|(sample, row, column)| Block {
            sample,
            row,
            column,
            rows: band.min(s.height / 2 - row),
            columns: part.min(columns - column),
        })
        .collect();
    let arch = Arch::new();
    let results: Vec<Vec<f32>> = blocks
        .par_iter()
        .map(|&block| {
            let tiles = block.rows * block.columns;
            let mut v = vec![0.0; POINTS * s.inputs * tiles];
            arch.dispatch(Input { s, block, x, relu, v: &mut v });
            let mut m = vec![0.0; POINTS * s.outputs * tiles];
            for point in 0..POINTS {
                let filter = &filters[point * s.outputs * s.inputs..][..s.outputs * s.inputs];
                let v = &v[point * s.inputs * tiles..][..s.inputs * tiles];
                let m = &mut m[point * s.outputs * tiles..][..s.outputs * tiles];
                multiply([s.outputs, tiles, s.inputs], filter, [1, s.inputs], v, [1, tiles], m);
            }
            let mut out = vec![0.0; s.outputs * tiles * 4];
            arch.dispatch(Output { s, block, m: &m, bias, out: &mut out });
            out
        })
        .collect();

    // Every block holds all channels of its tiles; the result wants channels outermost.
    let plane = s.height * s.width;
    let mut out = vec![0.0_f32; s.batch * s.outputs * plane];
    out.par_chunks_mut(plane).enumerate().for_each(|(i, out)| {
        let (sample, channel) = (i / s.outputs, i % s.outputs);
        for (block, result) in blocks.iter().zip(&results).filter(|(block, _)| block.sample == sample) {
            let (rows, columns) = (2 * block.rows, 2 * block.columns);
            let result = &result[channel * rows * columns..][..rows * columns];
            for (y, line) in result.chunks_exact(columns).enumerate() {
                let at = (2 * block.row + y) * s.width + 2 * block.column;
                out[at..at + columns].copy_from_slice(line);
            }
        }
    });
    out
}

/// A rectangle of tiles of one image.
#[derive(Clone, Copy)]
struct Block {
    sample: usize,
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
}

/// G·g·Gᵀ of every 3×3 filter: `[16][filter]`.
fn transform_filters(weights: &[f32], count: usize) -> Vec<f32> {
    let mut out = vec![0.0; POINTS * count];
    let column = |a: f32, b: f32, c: f32| [a, 0.5 * (a + b + c), 0.5 * (a - b + c), c];
    for (f, g) in weights.as_chunks::<9>().0.iter().enumerate() {
        let half: [[f32; 4]; 3] = [0, 1, 2].map(|x| column(g[x], g[3 + x], g[6 + x]));
        for i in 0..4 {
            let row = column(half[0][i], half[1][i], half[2][i]);
            for (j, value) in row.into_iter().enumerate() {
                out[(4 * i + j) * count + f] = value;
            }
        }
    }
    out
}

/// Bᵀ·d·B of every tile: `[16][inputs][tiles]`.
struct Input<'a> {
    s: Shape,
    block: Block,
    x: &'a [f32],
    relu: bool,
    v: &'a mut [f32],
}

impl WithSimd for Input<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { s, block, x, relu, v } = self;
        let (columns, tiles) = (block.columns, block.rows * block.columns);
        let span = 2 * columns + 2;
        // Input rows and columns start one before the first output.
        let left = (2 * block.column).checked_sub(1);
        let (from, skip) = (left.unwrap_or(0), usize::from(left.is_none()));
        let mut lines = [(); 4].map(|()| vec![0.0_f32; span]);
        let mut mixed = [(); 4].map(|()| vec![0.0_f32; span]);
        for channel in 0..s.inputs {
            let plane = &x[(block.sample * s.inputs + channel) * s.height * s.width..][..s.height * s.width];
            for tile_row in 0..block.rows {
                for (k, line) in lines.iter_mut().enumerate() {
                    let row = (2 * (block.row + tile_row) + k).checked_sub(1).filter(|row| *row < s.height);
                    line.fill(0.0);
                    if let Some(row) = row {
                        let source = &plane[row * s.width + from..(row + 1) * s.width];
                        let n = source.len().min(span - skip);
                        line[skip..skip + n].copy_from_slice(&source[..n]);
                    }
                    if relu {
                        line.iter_mut().for_each(|x| *x = if *x > 0.0 { *x } else { 0.0 });
                    }
                }
                for i in 0..span {
                    let d = [lines[0][i], lines[1][i], lines[2][i], lines[3][i]];
                    mixed[0][i] = d[0] - d[2];
                    mixed[1][i] = d[1] + d[2];
                    mixed[2][i] = d[2] - d[1];
                    mixed[3][i] = d[1] - d[3];
                }
                for (i, mixed) in mixed.iter().enumerate() {
                    let (pairs, _) = mixed.as_chunks::<2>();
                    let at = |j: usize| ((4 * i + j) * s.inputs + channel) * tiles + tile_row * columns;
                    let mut each = |j: usize, f: fn([f32; 2], [f32; 2]) -> f32| {
                        let out = &mut v[at(j)..][..columns];
                        for ((out, a), b) in out.iter_mut().zip(pairs).zip(&pairs[1..]) {
                            *out = f(*a, *b);
                        }
                    };
                    each(0, |a, b| a[0] - b[0]);
                    each(1, |a, b| a[1] + b[0]);
                    each(2, |a, b| b[0] - a[1]);
                    each(3, |a, b| a[1] - b[1]);
                }
            }
        }
    }
}

/// Aᵀ·m·A + bias of every tile: `[outputs][2·rows][2·columns]`.
struct Output<'a> {
    s: Shape,
    block: Block,
    m: &'a [f32],
    bias: &'a [f32],
    out: &'a mut [f32],
}

impl WithSimd for Output<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { s, block, m, bias, out } = self;
        let (columns, tiles) = (block.columns, block.rows * block.columns);
        for (channel, out) in out.chunks_exact_mut(4 * tiles).enumerate() {
            for (tile_row, out) in out.chunks_exact_mut(4 * columns).enumerate() {
                let line = |point: usize| {
                    &m[(point * s.outputs + channel) * tiles + tile_row * columns..][..columns]
                };
                let points: [&[f32]; POINTS] = std::array::from_fn(line);
                let (top, bottom) = out.split_at_mut(2 * columns);
                let (top, bottom) = (top.as_chunks_mut::<2>().0, bottom.as_chunks_mut::<2>().0);
                for t in 0..columns {
                    let row = |j: usize| {
                        let [a, b, c, d] =
                            [points[j][t], points[4 + j][t], points[8 + j][t], points[12 + j][t]];
                        [a + b + c, b - c - d]
                    };
                    let (a, b, c, d) = (row(0), row(1), row(2), row(3));
                    let across =
                        |k: usize| [a[k] + b[k] + c[k] + bias[channel], b[k] - c[k] - d[k] + bias[channel]];
                    top[t] = across(0);
                    bottom[t] = across(1);
                }
            }
        }
    }
}
