//! 3×3 convolutions with padding 1 by im2col: matrix products with the unfolded input, in which the nine taps of a
//! channel follow one another. Winograd's method needs stride 1; this method takes any stride. The DPT heads have one
//! layer with stride 2; the convolutional body has one between every two levels.

use rayon::prelude::*;

use super::Convolution;
use super::elements::{add_constant, channel_sums, mask, rectify};
use crate::buffers::{Floats, take};
use crate::multiply::{Right, product};
use crate::op::InputGradients;
use crate::winograd::pieces;

/// Taps of a filter.
const TAPS: usize = 9;
/// Most tasks per image in the forward pass, and fewest pixels per task.
const BANDS: usize = 4;
const PIXELS: usize = 64;
/// Channels per task in the backward pass.
const CHANNELS: usize = 16;

impl Convolution {
    /// The result of a 3×3 convolution.
    pub(super) fn unfolded(&self, x: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let (Self { inputs, outputs, .. }, plane) = (*self, self.pixels());
        let [rows, columns] = self.size();
        let mut out = take(self.batch * outputs * rows * columns);
        let band = rows.div_ceil(BANDS).max(PIXELS.div_ceil(columns)).min(rows);
        let tasks: Vec<_> = out
            .chunks_exact_mut(outputs * rows * columns)
            .enumerate()
            .flat_map(|(image, out)| {
                let planes = out.chunks_exact_mut(rows * columns);
                let bands = pieces(planes, rows * columns, band * columns).into_iter().enumerate();
                bands.map(move |(i, out)| (image, i * band, out))
            })
            .collect();
        tasks.into_par_iter().for_each(|(image, row, out)| {
            let n = out[0].len();
            let mut taps = Floats::new(inputs * TAPS * n);
            self.unfold(&x[image * inputs * plane..][..inputs * plane], row, &mut taps);
            let mut results = Floats::new(outputs * n);
            let lhs = (weight, [1, inputs * TAPS]);
            let rhs = Right::Plain((&taps, [1, n]));
            product([outputs, n, inputs * TAPS], lhs, &rhs, &mut results, false);
            for (c, (out, results)) in out.into_iter().zip(results.chunks_exact(n)).enumerate() {
                add_constant(results, bias.get(c).copied().unwrap_or(0.0), out);
            }
        });
        out
    }

    /// The gradients of a 3×3 convolution.
    pub(super) fn unfolded_gradients(&self, given: [&[f32]; 3], wanted: [bool; 3]) -> InputGradients {
        let ([x, weight, dy], [of_input, of_weight, of_bias]) = (given, wanted);
        let Self { batch, inputs, outputs, .. } = *self;
        let [rows, columns] = self.size();
        let (plane, n) = (self.pixels(), rows * columns);
        let mut dx = of_input.then(|| take(x.len()));
        // Every task computes some input channels of all images.
        let images = dx.iter_mut().flat_map(|dx| dx.chunks_exact_mut(inputs * plane));
        let slices = pieces(images, inputs * plane, CHANNELS * plane);
        let task = |(block, mut dx): (usize, Vec<&mut [f32]>)| {
            let first = block * CHANNELS;
            let channels = CHANNELS.min(inputs - first);
            let width = channels * TAPS;
            let mut sums = Floats::new(if of_weight { outputs * width } else { 0 });
            let mut taps = Floats::new(width * n);
            for image in 0..batch {
                let x = &x[(image * inputs + first) * plane..][..channels * plane];
                let dy = &dy[image * outputs * n..][..outputs * n];
                if of_weight {
                    self.unfold(x, 0, &mut taps);
                    let rhs = &Right::Plain((&taps, [n, 1]));
                    product([outputs, width, n], (dy, [1, n]), rhs, &mut sums, image > 0);
                }
                if let Some(dx) = dx.get_mut(image) {
                    let lhs = (&weight[first * TAPS..], [inputs * TAPS, 1]);
                    let rhs = &Right::Plain((dy, [1, n]));
                    product([width, n, outputs], lhs, rhs, &mut taps, false);
                    self.fold(&taps, dx);
                    if self.rectified {
                        mask(x, dx);
                    }
                }
            }
            sums
        };
        let sums: Vec<_> = slices.into_par_iter().enumerate().map(task).collect();
        let weight = of_weight.then(|| {
            let mut weight = take(outputs * inputs * TAPS);
            weight.par_chunks_exact_mut(inputs * TAPS).enumerate().for_each(|(output, out)| {
                for (out, sums) in out.chunks_mut(CHANNELS * TAPS).zip(&sums) {
                    out.copy_from_slice(&sums[output * out.len()..][..out.len()]);
                }
            });
            weight
        });
        let bias = of_bias.then(|| channel_sums(dy, batch, outputs));
        [dx, weight, bias]
    }

    /// Rows and columns of the output.
    fn size(&self) -> [usize; 2] {
        [self.height.div_ceil(self.stride), self.width.div_ceil(self.stride)]
    }

    /// Writes the inputs of the nine taps of every channel, `[channels, 9, rows, columns]`, for the output rows from
    /// `row` on.
    fn unfold(&self, x: &[f32], row: usize, taps: &mut [f32]) {
        let (plane, [_, columns]) = (self.pixels(), self.size());
        let mut positive = Floats::new(if self.rectified { x.len() } else { 0 });
        let x = if self.rectified {
            rectify(x, &mut positive);
            &positive[..]
        } else {
            x
        };
        let size = taps.len() / (x.len() / plane * TAPS);
        for (i, out) in taps.chunks_exact_mut(size).enumerate() {
            let (x, tap) = (&x[i / TAPS * plane..][..plane], i % TAPS);
            let (first, last, from) = self.columns(tap);
            for (y, out) in out.chunks_exact_mut(columns).enumerate() {
                // One more than the image's row.
                let line = self.stride * (row + y) + tap / 3;
                if !(1..=self.height).contains(&line) {
                    out.fill(0.0);
                    continue;
                }
                let line = &x[(line - 1) * self.width + from..line * self.width];
                out[..first].fill(0.0);
                out[last..].fill(0.0);
                let values = line.iter().step_by(self.stride);
                out[first..last].iter_mut().zip(values).for_each(|(out, x)| *out = *x);
            }
        }
    }

    /// The transpose of `unfold` (col2im), for all rows and without max(x, 0).
    fn fold(&self, taps: &[f32], x: &mut [f32]) {
        let [rows, columns] = self.size();
        x.fill(0.0);
        for (i, taps) in taps.chunks_exact(rows * columns).enumerate() {
            let (x, tap) = (&mut x[i / TAPS * self.pixels()..], i % TAPS);
            let (first, last, from) = self.columns(tap);
            for (y, taps) in taps.chunks_exact(columns).enumerate() {
                let line = self.stride * y + tap / 3;
                if (1..=self.height).contains(&line) {
                    let line = &mut x[(line - 1) * self.width + from..line * self.width];
                    let places = line.iter_mut().step_by(self.stride);
                    places.zip(&taps[first..last]).for_each(|(out, x)| *out += x);
                }
            }
        }
    }

    /// The first and one after the last output column for which a tap lies inside the image, and the input column that
    /// the tap reads for the first one.
    fn columns(&self, tap: usize) -> (usize, usize, usize) {
        let [_, columns] = self.size();
        let shift = tap % 3;
        let first = usize::from(shift == 0);
        // stride · x + shift − 1 < width.
        let last = (self.width + 1 - shift).div_ceil(self.stride).min(columns);
        (first.min(last), last, (self.stride * first + shift - 1).min(self.width - 1))
    }
}
