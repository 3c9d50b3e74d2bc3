//! 3×3 convolutions with padding 1 in bf16, with stride 1 or 2: products with the windows of the image where they lie.
//!
//! Pixels are the columns of the right factor and pairs of channels its rows, so that planes need no transposition on the
//! way in or out, and a tap only shifts the first window. The gradient of the input is the same with the roles of inputs and
//! outputs exchanged; with stride 2, each of the four kinds of pixels (even or odd row, even or odd column) meets one, two
//! or four taps. The gradient of the weight sums over pixels, so that there pairs of pixels are the inner dimension.

use rayon::prelude::*;

use super::elements::{channel_sums, rectify};
use super::{Gradients, Unfolded, Wanted, join};
use crate::buffers::{give, give_words, take, take_words};
use crate::half::{self, BLOCK, Edge, Left, PAIRS, PANEL, Right, SLACK, Source, Unit};
use crate::wide::pieces;

/// Taps of a filter.
const TAPS: usize = 9;
/// Words of a band's factors: 256 KiB, which leaves the second-level cache room for filters.
const BAND_WORDS: usize = 64 * 1024;
/// Tasks at least, if bands can be as low.
const TASKS: usize = 8;
/// Parts that the weight's gradient is summed in at most.
const PARTS: usize = 16;

/// A convolution and what computes it.
#[derive(Debug, Clone, Copy)]
pub struct Windows {
    /// Sizes; the stride is 1 or 2.
    pub sizes: Unfolded,
    /// What computes.
    pub unit: Unit,
}

/// Filters as a left factor: `[taps][blocks of channels][rows]`.
struct Filters {
    words: Vec<u32>,
    /// Rows from one block to the next.
    rows: usize,
    /// Blocks of a tap.
    blocks: usize,
}

/// A tap: which filter, and the row and the place in a line of its first window.
type Tap = (usize, usize, usize);

/// One pass over windows.
struct Pass<'a> {
    unit: Unit,
    /// `[B, channels, height, width]`.
    source: &'a [f32],
    channels: usize,
    size: [usize; 2],
    rectified: bool,
    /// Rows of windows per row of the result. With 2, even columns of a line lie before the odd ones.
    stride: usize,
    filters: &'a Filters,
    /// Per kind of pixels of the result (row, column).
    kinds: Vec<([usize; 2], Vec<Tap>)>,
    /// Rows and columns of the result per row and column of windows.
    spread: usize,
    /// Channels, rows and columns of the result.
    result: [usize; 3],
    bias: Option<&'a [f32]>,
    /// The result is 0 where this is not positive.
    mask: Option<&'a [f32]>,
}

impl Windows {
    /// `x` `[B, inputs, H, W]`, `weight` `[outputs, inputs, 3, 3]`, `bias` `[outputs]` →
    /// `[B, outputs, ⌈H/stride⌉, ⌈W/stride⌉]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let Unfolded { inputs, outputs, width, height, rectified, stride, .. } = self.sizes;
        let filters = Filters::new(weight, [outputs, inputs], [TAPS * inputs, TAPS]);
        // Column c of a line, which has a border of one, is the c/2-th of its half.
        let half = (width + 2).div_ceil(2);
        let place = |c: usize| if stride == 2 { c % 2 * half + c / 2 } else { c };
        let taps = (0..TAPS).map(|tap| (tap, tap / 3, place(tap % 3))).collect();
        let [rows, columns] = self.sizes.size();
        let pass = Pass {
            unit: self.unit,
            source: x,
            channels: inputs,
            size: [height, width],
            rectified,
            stride,
            filters: &filters,
            kinds: vec![([0, 0], taps)],
            spread: 1,
            result: [outputs, rows, columns],
            bias,
            mask: None,
        };
        let out = pass.run();
        give_words(filters.words);
        out
    }

    /// Gradients from that of the output, `dy` `[B, outputs, ⌈H/stride⌉, ⌈W/stride⌉]`.
    pub fn backward(&self, x: &[f32], weight: &[f32], dy: &[f32], wanted: Wanted) -> Gradients {
        Gradients {
            input: wanted.input.then(|| self.input_gradient(x, weight, dy)),
            weight: wanted.weight.then(|| self.weight_gradient(x, dy)),
            bias: wanted.bias.then(|| channel_sums(dy, self.sizes.batch, self.sizes.outputs)),
        }
    }

    fn input_gradient(&self, x: &[f32], weight: &[f32], dy: &[f32]) -> Vec<f32> {
        let Unfolded { inputs, outputs, height, width, stride, rectified, .. } = self.sizes;
        let filters = Filters::new(weight, [inputs, outputs], [TAPS, TAPS * inputs]);
        // Tap t of pixel i reads row (i + 1 − t) / stride of dy, which is one later with its border.
        let along = |i: usize| {
            let read = move |t: usize| (i + stride + 1 - t, t);
            (0..3).map(read).filter(|(row, _)| row.is_multiple_of(stride)).map(|(row, t)| (row / stride, t))
        };
        let kind = |[i, j]: [usize; 2]| {
            let taps =
                along(i).flat_map(|(row, ky)| along(j).map(move |(column, kx)| (3 * ky + kx, row, column)));
            ([i, j], taps.collect())
        };
        let kinds = (0..stride).flat_map(|i| (0..stride).map(move |j| [i, j])).map(kind).collect();
        let pass = Pass {
            unit: self.unit,
            source: dy,
            channels: outputs,
            size: self.sizes.size(),
            rectified: false,
            stride: 1,
            filters: &filters,
            kinds,
            spread: stride,
            result: [inputs, height, width],
            bias: None,
            mask: rectified.then_some(x),
        };
        let out = pass.run();
        give_words(filters.words);
        out
    }

    /// The images are cut into a fixed number of parts, whose sums are joined in their order.
    fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        let Unfolded { batch, inputs, outputs, stride, .. } = self.sizes;
        let [rows, columns] = self.sizes.size();
        let row = columns.next_multiple_of(BLOCK) * (3 * inputs * stride + outputs) / 2;
        let band = (BAND_WORDS / row).clamp(1, rows);
        let band = band.min((batch * rows).div_ceil(TASKS)).max(1);
        let bands: Vec<_> = (0..batch)
            .flat_map(|image| {
                (0..rows).step_by(band).map(move |first| (image, first, band.min(rows - first)))
            })
            .collect();
        let parts: Vec<_> =
            bands.par_chunks(bands.len().div_ceil(PARTS)).map(|bands| self.part(x, dy, bands)).collect();
        let sums = join(parts.iter().map(Vec::as_slice), TAPS * inputs * outputs);
        parts.into_iter().for_each(give);
        let mut weight = take(sums.len());
        for (output, weight) in weight.chunks_exact_mut(inputs * TAPS).enumerate() {
            for (input, weight) in weight.as_chunks_mut::<TAPS>().0.iter_mut().enumerate() {
                *weight = std::array::from_fn(|tap| sums[(tap * inputs + input) * outputs + output]);
            }
        }
        weight
    }

    /// Sums `[9][inputs][outputs]` over bands of rows (image, first row, rows).
    fn part(&self, x: &[f32], dy: &[f32], bands: &[(usize, usize, usize)]) -> Vec<f32> {
        let Unfolded { inputs, outputs, height, width, stride, rectified, .. } = self.sizes;
        let [rows, columns] = self.sizes.size();
        let blocks = columns.div_ceil(BLOCK);
        let (packed, panels) = (inputs.next_multiple_of(PAIRS), outputs.div_ceil(PANEL));
        let most = bands.iter().map(|(_, _, rows)| *rows).max().unwrap_or(0);
        let read = |rows: usize| stride * (rows - 1) + 3;
        // Windows `[column of the tap][row][block][input]`, and the output's gradient `[row][panel][block · 16][32]`.
        let mut left = take_words((3 * read(most) * blocks * packed + SLACK) * PAIRS);
        let mut right = take_words(most * panels * blocks * PAIRS * PANEL);
        // Rows of all inputs with their borders, and zeros as far as blocks reach.
        let line = stride * blocks * BLOCK + 2;
        let mut lines = take(inputs * line);
        let mut sums = take(TAPS * inputs * outputs);
        for (i, &(image, first, count)) in bands.iter().enumerate() {
            for row in 0..read(count) {
                let y = (stride * first + row).checked_sub(1).filter(|y| *y < height);
                for (c, line) in lines.chunks_exact_mut(line).enumerate() {
                    line.fill(0.0);
                    if let Some(y) = y {
                        let x = &x[((image * inputs + c) * height + y) * width..][..width];
                        let line = &mut line[1..=width];
                        if rectified { rectify(x, line) } else { line.copy_from_slice(x) }
                    }
                }
                for kx in 0..3 {
                    let (depth, values) = (blocks * BLOCK, &lines[kx..]);
                    let source = Source { values, stride: line, inner: stride, count: inputs, depth };
                    let size = blocks * packed;
                    let words = &mut left[(kx * read(count) + row) * size * PAIRS..][..size * PAIRS];
                    source.pack_left(words.as_chunks_mut().0);
                }
            }
            let size = panels * blocks * PAIRS * PANEL;
            for (row, words) in right.chunks_exact_mut(size).take(count).enumerate() {
                let values = &dy[(image * outputs * rows + first + row) * columns..];
                let source =
                    Source { values, stride: rows * columns, inner: 1, count: outputs, depth: columns };
                source.pack_right(words.as_chunks_mut().0);
            }
            let firsts: Vec<_> = (0..count)
                .flat_map(|row| (0..blocks).map(move |block| row * size + block * PAIRS * PANEL))
                .collect();
            let right = Right { values: &right, starts: &firsts, pair: PANEL, panel: blocks * PAIRS * PANEL };
            for (tap, sums) in sums.chunks_exact_mut(inputs * outputs).enumerate() {
                let first = tap % 3 * read(count) + tap / 3;
                let starts: Vec<_> = (0..count)
                    .flat_map(|row| {
                        (0..blocks).map(move |block| ((first + stride * row) * blocks + block) * packed)
                    })
                    .collect();
                let left = Left { values: left.as_chunks().0, starts: &starts, rows: inputs };
                let edge = if i > 0 { Edge::Add } else { Edge::Write };
                half::product(self.unit, left, right, outputs, |input, output, values| {
                    edge.write(values, &mut sums[input * outputs + output..][..values.len()]);
                });
            }
        }
        give(lines);
        [left, right].into_iter().for_each(give_words);
        sums
    }
}

impl Filters {
    /// Of filters `[rows][channels]`, `strides` apart.
    fn new(weight: &[f32], [count, channels]: [usize; 2], [stride, inner]: [usize; 2]) -> Self {
        let source = |tap: usize| Source { values: &weight[tap..], stride, inner, count, depth: channels };
        let (rows, blocks) = (source(0).packed_rows(), source(0).blocks());
        let mut words = take_words((TAPS * blocks * rows + SLACK) * PAIRS);
        let taps = words.par_chunks_exact_mut(blocks * rows * PAIRS).take(TAPS).enumerate();
        taps.for_each(|(tap, words)| source(tap).pack_left(words.as_chunks_mut().0));
        Self { words, rows, blocks }
    }
}

impl Pass<'_> {
    fn run(&self) -> Vec<f32> {
        let [height, width] = self.size;
        let [results, rows, columns] = self.result;
        let batch = self.source.len() / (self.channels * height * width);
        let line = self.line();
        // Rows of windows per task.
        let all = rows.div_ceil(self.spread);
        let words = self.filters.blocks * PAIRS * line * self.stride;
        let band = (BAND_WORDS / words).max(2).min((batch * all).div_ceil(TASKS)).min(all).max(1);
        let mut out = take(batch * results * rows * columns);
        let tasks: Vec<_> = out
            .chunks_exact_mut(results * rows * columns)
            .enumerate()
            .flat_map(|(image, out)| {
                let bands = pieces(out, rows * columns, band * self.spread * columns).into_iter().enumerate();
                bands.map(move |(i, out)| (image, i * band, out))
            })
            .collect();
        tasks.into_par_iter().for_each(|(image, first, out)| self.band(image, first, out));
        out
    }

    /// Words of a packed line: the image's columns and a border, in two halves if the stride is 2.
    fn line(&self) -> usize {
        if self.stride == 2 { 2 * (self.size[1] + 2).div_ceil(2) } else { self.size[1] + 2 }
    }

    /// Windows from row `first` on, for the rows of one image that `out` has of every result.
    fn band(&self, image: usize, first: usize, mut out: Vec<&mut [f32]>) {
        let [results, height, width] = self.result;
        let rows = (out[0].len() / width).div_ceil(self.spread);
        let (line, count) = (self.line(), self.stride * (rows - 1) + 3);
        // An odd number of cache lines puts pairs into different sets of the cache.
        let pair = (count * line).next_multiple_of(2 * PAIRS) + PAIRS;
        let blocks = self.filters.blocks;
        let mut words = take_words(blocks * PAIRS * pair + PANEL);
        self.pack(image, self.stride * first, [count, pair], &mut words);
        for (row, (kind, taps)) in (0..rows).flat_map(|row| self.kinds.iter().map(move |kind| (row, kind))) {
            // The row and the columns of the result.
            let y = self.spread * row + kind[0];
            let columns = (width - kind[1].min(width)).div_ceil(self.spread);
            if y * width >= out[0].len() || columns == 0 {
                continue;
            }
            let steps = taps.iter().flat_map(|tap| (0..blocks).map(move |block| (*tap, block)));
            let (starts, firsts): (Vec<_>, Vec<_>) = steps
                .map(|((filter, down, across), block)| {
                    let place = (self.stride * row + down) * line + across;
                    ((filter * blocks + block) * self.filters.rows, block * PAIRS * pair + place)
                })
                .unzip();
            let left = Left { values: self.filters.words.as_chunks().0, starts: &starts, rows: results };
            let right = Right { values: &words, starts: &firsts, pair, panel: PANEL };
            half::product(self.unit, left, right, columns, |result, column, sums| {
                let at = y * width + kind[1] + self.spread * column;
                let beside = |mask| {
                    let mask: &[f32] = mask;
                    &mask[((image * results + result) * height + self.spread * first) * width + at..]
                };
                let out = &mut out[result][at..];
                if self.spread == 1 {
                    let edge = match (self.mask, self.bias) {
                        (Some(mask), _) => Edge::Mask(&beside(mask)[..sums.len()]),
                        (_, Some(bias)) => Edge::Bias(bias[result]),
                        _ => Edge::Write,
                    };
                    edge.write(sums, &mut out[..sums.len()]);
                } else {
                    let out = out.iter_mut().step_by(self.spread).zip(sums);
                    match self.mask {
                        Some(mask) => out
                            .zip(beside(mask).iter().step_by(self.spread))
                            .for_each(|((out, sum), mask)| *out = if *mask > 0.0 { *sum } else { 0.0 }),
                        None => out.for_each(|(out, sum)| *out = *sum),
                    }
                }
            });
        }
        give_words(words);
    }

    /// Pairs of channels of `count` rows, the first of which is row `first` of an image with its border, every `pair`
    /// words.
    fn pack(&self, image: usize, first: usize, [count, pair]: [usize; 2], words: &mut [u32]) {
        let ([height, width], line, half) = (self.size, self.line(), self.line() / 2);
        let mut whole = vec![0; if self.stride == 2 { line } else { 0 }];
        for (i, words) in words.chunks_exact_mut(pair).take(self.filters.blocks * PAIRS).enumerate() {
            for (row, words) in words.chunks_exact_mut(line).take(count).enumerate() {
                let y = (first + row).checked_sub(1).filter(|y| *y < height);
                let Some(y) = y.filter(|_| 2 * i < self.channels) else {
                    words.fill(0);
                    continue;
                };
                let plane = |c: usize| {
                    let first = ((image * self.channels + c) * height + y) * width;
                    (c < self.channels).then(|| &self.source[first..][..width])
                };
                let out = if self.stride == 2 { &mut whole[..] } else { &mut *words };
                [out[0], out[width + 1]] = [0; 2];
                half::pack_pairs(plane(2 * i), plane(2 * i + 1), self.rectified, &mut out[1..=width]);
                if self.stride == 2 {
                    for (k, words) in words.chunks_exact_mut(half).enumerate() {
                        words
                            .iter_mut()
                            .zip(whole[k..].iter().step_by(2))
                            .for_each(|(out, pair)| *out = *pair);
                    }
                }
            }
        }
    }
}
