//! The gradients of one convolution, band by band.
//!
//! An input row affects three rows of the output. The gradients of these three rows, with the transposed weights, give
//! the gradient of the input row. Their products with the input row, which is activated again, give the gradient of the
//! weights. So the forward pass keeps nothing but the planes before normalisation.

use pulp::Arch;
use rayon::prelude::*;

use super::kernels::{Products, Row, Strided, Tap, square};
use super::rows::{Descend, Fill, Upstream, activate, double, halve, sum};
use super::weights::transpose;
use super::{CHANNELS, Plane, Source};
use crate::buffers::Floats;
use crate::vectors::vectorized;
use crate::winograd::pieces;

/// Columns that are processed while they are in the first-level cache; a multiple of every kernel's block of pixels.
const CHUNK: usize = 120;
/// If fewer columns than this would remain, the last chunk takes them.
const REST: usize = 12;
/// Pixels whose products are summed in f32 before they are added to the f64 sums.
const SINGLE: usize = 1024;

/// Which gradients are needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Needed {
    /// Gradients of the inputs.
    pub input: bool,
    /// Gradients of weights and biases.
    pub parameters: bool,
}

/// The backward pass of [`super::Conv`], without the shortcut.
pub struct Backward<'a> {
    /// Inputs of the forward pass.
    pub sources: &'a [Source<'a>],
    /// Weights of the forward pass.
    pub weights: &'a [f32],
    /// Gradient of the result before the shortcut was added.
    pub upstream: Upstream<'a>,
    /// 1 or 2.
    pub stride: usize,
    /// Whether the input was doubled first.
    pub enlarge: bool,
    /// Gradients to compute; the others stay empty.
    pub wanted: Needed,
}

/// Sums per channel over the gradient g of a source: Σ g, and Σ g·(x − the plane's mean, in f32). The backward pass of
/// its normalisation needs them.
pub type GradientSums = [[f64; CHANNELS]; 2];

/// Result of [`Backward::run`].
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// Per source `[height, width, 16]`: gradient of the plane, or of scale·x + shift if the plane is normalised.
    pub inputs: Vec<Floats>,
    /// Per source, sums over its gradient in `inputs`, if the plane is normalised.
    pub sums: Vec<GradientSums>,
    /// Gradient of the weights, `[source][row][column][channel in][16]`.
    pub weights: Vec<f64>,
    /// Gradient of the bias.
    pub bias: [f64; CHANNELS],
}

impl Plane {
    /// The mean that [`GradientSums`] subtract: the exact mean, rounded to f32.
    pub(super) fn centre(&self, channel: usize) -> f64 {
        f64::from(self.moments.mean[channel] as f32)
    }
}

impl Backward<'_> {
    /// Computes the gradients on all cores, with the same bits for any number of cores.
    pub fn run(&self) -> Gradients {
        let plane = self.sources[0].plane;
        let line = plane.width * CHANNELS;
        let count = if self.wanted.input { self.sources.len() } else { 0 };
        let mut inputs: Vec<_> = (0..count).map(|_| Floats::new(plane.height * line)).collect();
        // Enough bands for many cores, and few rows at the borders that two bands compute.
        let band = (plane.height / 16).clamp(4, 16);
        let outs = pieces(inputs.iter_mut().map(|input| &mut input[..]), plane.height * line, band * line);
        let transposed = if self.wanted.input { transpose(self.weights) } else { Vec::new() };
        let run = |(i, outs): (usize, _)| {
            let rows = band * i..(band * (i + 1)).min(plane.height);
            Band::new(self, &transposed, outs).run(rows)
        };
        let parts: Vec<Gradients> = outs.into_par_iter().enumerate().map(run).collect();
        // Added in the order of the rows, for the same bits with any number of threads.
        let mut parts = parts.into_iter();
        let mut all = parts.next().unwrap_or_default();
        for part in parts {
            all.weights.iter_mut().zip(&part.weights).for_each(|(a, b)| *a += b);
            all.bias.iter_mut().zip(&part.bias).for_each(|(a, b)| *a += b);
            let sums = all.sums.as_flattened_mut().as_flattened_mut().iter_mut();
            sums.zip(part.sums.as_flattened().as_flattened()).for_each(|(a, b)| *a += b);
        }
        Gradients { inputs, ..all }
    }
}

/// The backward pass of a band of rows, with its buffers.
struct Band<'a> {
    pass: &'a Backward<'a>,
    transposed: &'a [f32],
    /// The band's rows of the inputs' gradients.
    outs: Vec<&'a mut [f32]>,
    /// Three rows of the output's gradient in turn, `[columns + 2, 16]`, zero at both ends.
    slots: [Vec<f32>; 3],
    /// Which padded row each slot holds, and whether the output has this row.
    held: [(usize, bool); 3],
    values: Vec<f32>,
    slopes: Vec<f32>,
    doubled: Vec<f32>,
    /// Weight gradients of the last pixels in f32, and the number of these pixels.
    products: (Vec<f32>, usize),
    sums: Gradients,
}

impl<'a> Band<'a> {
    fn new(pass: &'a Backward<'a>, transposed: &'a [f32], outs: Vec<&'a mut [f32]>) -> Self {
        let columns = pass.sources[0].plane.width * if pass.enlarge { 2 } else { 1 };
        let chunk = || vec![0.0; (CHUNK + REST) * CHANNELS];
        let weights = if pass.wanted.parameters { pass.weights.len() } else { 0 };
        Self {
            pass,
            transposed,
            outs,
            slots: std::array::from_fn(|_| vec![0.0; (columns + 2) * CHANNELS]),
            held: [(usize::MAX, false); 3],
            values: chunk(),
            slopes: chunk(),
            doubled: chunk(),
            products: (vec![0.0; weights], 0),
            sums: Gradients {
                sums: vec![[[0.0; CHANNELS]; 2]; pass.sources.len()],
                weights: vec![0.0; weights],
                ..Gradients::default()
            },
        }
    }

    fn run(mut self, rows: std::ops::Range<usize>) -> Gradients {
        let factor = if self.pass.enlarge { 2 } else { 1 };
        let columns = self.pass.sources[0].plane.width * factor;
        for (row, part) in rows.clone().flat_map(|row| (0..factor).map(move |part| (row, part))) {
            let y = row * factor + part;
            (y..y + 3).for_each(|padded| self.hold(padded));
            let mut start = 0;
            while start < columns {
                let rest = columns - start;
                let pixels = if rest < CHUNK + REST { rest } else { CHUNK };
                if self.pass.wanted.parameters && self.held[(y + 1) % 3].1 {
                    let slot = &self.slots[(y + 1) % 3][(start + 1) * CHANNELS..][..pixels * CHANNELS];
                    self.sums.bias.iter_mut().zip(sum(slot)).for_each(|(all, s)| *all += f64::from(s));
                }
                for source in 0..self.pass.sources.len() {
                    self.chunk(source, [row, part], row - rows.start, start, pixels);
                }
                self.products.1 += pixels;
                start += pixels;
            }
            if self.products.1 >= SINGLE {
                self.flush();
            }
        }
        self.flush();
        self.sums
    }

    /// Adds the f32 sums to the f64 sums.
    fn flush(&mut self) {
        let (products, count) = &mut self.products;
        let weights = &mut self.sums.weights;
        vectorized!(|| {
            for (all, part) in weights.iter_mut().zip(products.iter_mut()) {
                *all += f64::from(std::mem::take(part));
            }
        });
        *count = 0;
    }

    /// Brings a row of the output's gradient into its slot. Row 0 is the padding above the image.
    fn hold(&mut self, padded: usize) {
        let slot = padded % 3;
        if self.held[slot].0 == padded {
            return;
        }
        let plane = self.pass.sources[0].plane;
        let rows = plane.height * if self.pass.enlarge { 2 } else { 1 };
        // With a stride of 2, every other row has no output.
        let exists = (1..=rows).contains(&padded) && (padded - 1).is_multiple_of(self.pass.stride);
        self.held[slot] = (padded, exists);
        if exists {
            let row = (padded - 1) / self.pass.stride;
            let (upstream, stride) = (self.pass.upstream, self.pass.stride);
            Arch::new().dispatch(Fill { upstream, row, stride, out: &mut self.slots[slot] });
        }
    }

    /// One source's gradients over `pixels` columns from `start` on. `row` is the image's row, `part` (0 or 1) one of
    /// its two copies if the input was doubled, and `line` the band's row.
    fn chunk(&mut self, source: usize, [row, part]: [usize; 2], line: usize, start: usize, pixels: usize) {
        let arch = Arch::new();
        let Source { plane, affine } = &self.pass.sources[source];
        let factor = if self.pass.enlarge { 2 } else { 1 };
        let (first, count) = (start / factor * CHANNELS, pixels / factor * CHANNELS);
        let input = &plane.data[row * plane.width * CHANNELS + first..][..count];
        let (values, slopes) = (&mut self.values[..pixels * CHANNELS], &mut self.slopes[..pixels * CHANNELS]);
        let values = match affine {
            Some(affine) => {
                activate(input, affine, values, slopes);
                values
            }
            None if factor == 2 => {
                double(input, values);
                values
            }
            None => input,
        };
        let y = row * factor + part;
        // The slots of the three output rows that this row affects, by the kernel's row.
        let reached = [0, 1, 2].map(|ky| (y + 2 - ky) % 3);
        let reached = || reached.into_iter().enumerate().filter(|(_, slot)| self.held[*slot].1);
        if self.pass.wanted.parameters {
            for (ky, slot) in reached() {
                let gradient = &self.slots[slot][start * CHANNELS..(start + pixels + 2) * CHANNELS];
                let size = 3 * CHANNELS * CHANNELS;
                let out = &mut self.products.0[(source * 3 + ky) * size..][..size];
                arch.dispatch(Products::<3> { input: values, gradient, out });
            }
        }
        if !self.pass.wanted.input {
            return;
        }
        let mut taps = Vec::with_capacity(9);
        for (ky, slot) in reached() {
            for kx in 0..3 {
                let row = &self.slots[slot][(start + 2 - kx) * CHANNELS..];
                taps.push(Tap { row, weights: square(self.transposed, (source * 3 + ky) * 3 + kx) });
            }
        }
        let out = &mut self.outs[source][line * plane.width * CHANNELS + first..][..count];
        let bias = &[0.0; CHANNELS];
        if factor == 2 {
            let doubled = &mut self.doubled[..pixels * CHANNELS];
            let row = Row { taps: &taps, bias, identity: None, scale: 1.0, out: doubled };
            arch.dispatch(Strided::<1>(row));
            halve(doubled, out, part == 1);
            return;
        }
        arch.dispatch(Strided::<1>(Row { taps: &taps, bias, identity: None, scale: 1.0, out }));
        if affine.is_some() {
            let centre = std::array::from_fn(|c| plane.centre(c) as f32);
            let slopes = &self.slopes[..pixels * CHANNELS];
            let sums = arch.dispatch(Descend { input, centre, slopes, out });
            let all = self.sums.sums[source].as_flattened_mut().iter_mut();
            all.zip(sums.as_flattened()).for_each(|(all, sum)| *all += f64::from(*sum));
        }
    }
}
