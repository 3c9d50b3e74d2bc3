//! Layer normalisation, forward and backward.

use rayon::prelude::*;

use super::elements::sum;
use super::{join, parts};
use crate::buffers::take;
use crate::op::{Given, InputGradients, Kept, Kernel};
use crate::vectors::vectorized;

/// Rows per task.
const ROWS: usize = 64;

/// (x − mean) / √(variance + epsilon) · weight + bias over the channels of every row.
#[derive(Debug, Clone, Copy)]
pub struct LayerNorm {
    /// Channels of a row.
    pub channels: usize,
    /// Added to the variance.
    pub epsilon: f32,
}

/// Mean and 1 / √(variance + epsilon) of a row.
type Statistics = [f32; 2];

impl Kernel for LayerNorm {
    /// `x` `[rows, channels]`, `weight` and `bias` `[channels]` → `[rows, channels]`. Keeps each row's statistics.
    fn forward(&self, [x, weight, bias]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let mut out = take(x.len());
        let mut statistics = vec![[0.0; 2]; x.len() / self.channels];
        let piece = ROWS * self.channels;
        let tasks = out.par_chunks_mut(piece).zip(x.par_chunks(piece)).zip(statistics.par_chunks_mut(ROWS));
        tasks.for_each(|((out, x), statistics)| self.normalise(x, [weight, bias], out, statistics));
        (out, keep.then(|| Box::new(statistics) as _))
    }

    /// If the gradient of weight or bias is wanted, both are computed.
    fn backward(&self, given: Given) -> InputGradients {
        let Given { inputs: [x, weight, _], kept, upstream: dy, wanted: [of_input, of_weight, of_bias] } =
            given;
        let kept = kept.and_then(|kept| kept.downcast::<Vec<Statistics>>().ok());
        let statistics = kept.expect("kept by the forward pass");
        let (c, piece) = (self.channels, ROWS * self.channels);
        let blocks = statistics.len().div_ceil(ROWS);
        let summed = of_weight || of_bias;
        let mut sums = vec![0.0; if summed { 2 * blocks * c } else { 0 }];
        let mut dx = of_input.then(|| take(x.len()));
        let results = parts(dx.as_deref_mut(), piece, blocks).into_par_iter();
        let totals = parts(summed.then_some(&mut sums), 2 * c, blocks);
        let given = x.par_chunks(piece).zip(dy.par_chunks(piece)).zip(statistics.par_chunks(ROWS));
        results.zip(totals).zip(given).for_each(|((dx, sums), ((x, dy), statistics))| {
            if let Some(sums) = sums {
                column_sums(x, dy, statistics, sums.split_at_mut(c));
            }
            if let Some(dx) = dx {
                derive(x, dy, weight, statistics, dx);
            }
        });
        let mut joined = join(sums.chunks_exact(2 * c), 2 * c);
        let bias = of_bias.then(|| joined.split_off(c));
        joined.truncate(c);
        [dx, of_weight.then_some(joined), bias]
    }
}

impl LayerNorm {
    /// Normalises rows, and writes their statistics.
    fn normalise(self, x: &[f32], factors: [&[f32]; 2], out: &mut [f32], statistics: &mut [Statistics]) {
        let (c, [weight, bias]) = (self.channels, factors);
        vectorized!(move || {
            let rows = x.chunks_exact(c).zip(out.chunks_exact_mut(c)).zip(statistics.iter_mut());
            for ((x, out), statistics) in rows {
                let mean = sum([x], |[x]| x) / c as f32;
                let variance = sum([x], |[x]| (x - mean) * (x - mean)) / c as f32;
                let scale = 1.0 / (variance + self.epsilon).sqrt();
                *statistics = [mean, scale];
                for (((out, x), w), b) in out.iter_mut().zip(x).zip(weight).zip(bias) {
                    *out = (x - mean) * scale * w + b;
                }
            }
        });
    }
}

/// dx = scale · (g − mean(g) − h · mean(g·h)), with the normalised row h and g = dy·weight.
fn derive(x: &[f32], dy: &[f32], weight: &[f32], statistics: &[Statistics], dx: &mut [f32]) {
    let c = weight.len();
    vectorized!(move || {
        let rows = x.chunks_exact(c).zip(dy.chunks_exact(c)).zip(dx.chunks_exact_mut(c));
        for (((x, dy), dx), &[mean, scale]) in rows.zip(statistics) {
            let constant = sum([dy, weight], |[dy, w]| dy * w) / c as f32;
            let slope = sum([dy, weight, x], |[dy, w, x]| dy * w * ((x - mean) * scale)) / c as f32;
            for (((dx, x), dy), w) in dx.iter_mut().zip(x).zip(dy).zip(weight) {
                *dx = (dy * w - constant - (x - mean) * scale * slope) * scale;
            }
        }
    });
}

/// Column sums of dy·h (`weight`) and dy (`bias`), with the normalised row h.
fn column_sums(x: &[f32], dy: &[f32], statistics: &[Statistics], (weight, bias): (&mut [f32], &mut [f32])) {
    let c = weight.len();
    vectorized!(move || {
        for ((x, dy), &[mean, scale]) in x.chunks_exact(c).zip(dy.chunks_exact(c)).zip(statistics) {
            for (((weight, bias), x), dy) in weight.iter_mut().zip(&mut *bias).zip(x).zip(dy) {
                *weight += dy * ((x - mean) * scale);
                *bias += dy;
            }
        }
    });
}
