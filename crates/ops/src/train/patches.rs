//! The patch embedding for training: a convolution whose kernel is as large as its stride, from images to tokens. Patches
//! are gathered into rows, which a linear layer multiplies.

use rayon::prelude::*;

use super::{Gradients, Linear, Wanted};
use crate::buffers::{give, take};

/// Sizes of an embedding.
#[derive(Debug, Clone, Copy)]
pub struct Patches {
    /// Images.
    pub batch: usize,
    /// Channels of the images.
    pub inputs: usize,
    /// Channels of a token.
    pub outputs: usize,
    /// Rows of the images, a multiple of `side`.
    pub height: usize,
    /// Columns of the images, a multiple of `side`.
    pub width: usize,
    /// Rows and columns of a patch.
    pub side: usize,
}

impl Patches {
    /// `x` `[B, inputs, H, W]`, `weight` `[outputs, inputs, side, side]`, `bias` `[outputs]` → tokens
    /// `[B, H/side · W/side, outputs]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let rows = self.gather(x);
        let out = self.layer().forward(&rows, weight, bias);
        give(rows);
        out
    }

    /// Gradients from that of the tokens, `dy` `[B, H/side · W/side, outputs]`.
    pub fn backward(&self, x: &[f32], weight: &[f32], dy: &[f32], wanted: Wanted) -> Gradients {
        let rows = wanted.weight.then(|| self.gather(x));
        let given = rows.as_deref().unwrap_or_default();
        let gradients = self.layer().backward(given, weight, None, dy, wanted);
        rows.into_iter().for_each(give);
        let input = gradients.input.map(|rows| {
            let mut dx = take(x.len());
            dx.par_chunks_exact_mut(self.side * self.width).enumerate().for_each(|(band, dx)| {
                for (at, patch) in self.places(band) {
                    for (y, line) in dx.chunks_exact_mut(self.width).enumerate() {
                        let line = &mut line[at..][..self.side];
                        line.copy_from_slice(&rows[patch + y * self.side..][..self.side]);
                    }
                }
            });
            give(rows);
            dx
        });
        Gradients { input, ..gradients }
    }

    fn layer(&self) -> Linear {
        let (inputs, outputs) = (self.inputs * self.side * self.side, self.outputs);
        let rows = self.batch * (self.height / self.side) * (self.width / self.side);
        Linear { rows, inputs, outputs, transposed: true }
    }

    /// Patches as rows `[B · H/side · W/side, inputs · side · side]`.
    fn gather(&self, x: &[f32]) -> Vec<f32> {
        let (area, width) = (self.side * self.side, self.width);
        let (rows, columns) = (self.height / self.side, width / self.side);
        let mut out = take(x.len());
        // One task writes the patches of one row of them.
        out.par_chunks_exact_mut(columns * self.inputs * area).enumerate().for_each(|(i, out)| {
            let (image, row) = (i / rows, i % rows);
            for (j, out) in out.chunks_exact_mut(area).enumerate() {
                let (column, channel) = (j / self.inputs, j % self.inputs);
                let plane = (image * self.inputs + channel) * self.height + row * self.side;
                for (y, out) in out.chunks_exact_mut(self.side).enumerate() {
                    let from = (plane + y) * width + column * self.side;
                    out.copy_from_slice(&x[from..][..self.side]);
                }
            }
        });
        out
    }

    /// Columns of a band of `side` lines (counted through all planes of all images) where patches begin, and where their
    /// values are among the rows of patches.
    fn places(&self, band: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (rows, columns, side, inputs) =
            (self.height / self.side, self.width / self.side, self.side, self.inputs);
        let (plane, row) = (band / rows, band % rows);
        let (image, channel) = (plane / inputs, plane % inputs);
        (0..columns).map(move |column| {
            let patch = (image * rows + row) * columns + column;
            (column * side, (patch * inputs + channel) * side * side)
        })
    }
}
