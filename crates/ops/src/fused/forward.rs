//! The forward pass of one convolution, band by band.

use pulp::Arch;
use rayon::prelude::*;

use super::kernels::{Row, Strided, Tap, square};
use super::{CHANNELS, Moments, Plane, Source};
use crate::buffers::Floats;
use crate::math::silu;
use crate::vectors::vectorized;

/// Output rows per task.
const BAND: usize = 16;

/// What is added to the convolution before scaling.
pub enum Shortcut<'a> {
    /// Nothing.
    None,
    /// A plane.
    Identity(&'a Plane),
    /// A 1×1 convolution of planes with weights `[plane][channel in][16]`. Its bias is part of [`Conv::bias`].
    Project(&'a [&'a Plane], &'a [f32]),
}

/// A 3×3 convolution with padding 1.
pub struct Conv<'a> {
    /// Inputs, stacked along the channels.
    pub sources: &'a [Source<'a>],
    /// `[source][row][column][channel in][16]`.
    pub weights: &'a [f32],
    /// Added to every pixel.
    pub bias: [f32; CHANNELS],
    /// 1, or 2 to halve the size.
    pub stride: usize,
    /// Doubles the input's size by repetition before the convolution.
    pub enlarge: bool,
    /// Added to the result.
    pub shortcut: Shortcut<'a>,
    /// Factor of the sum.
    pub scale: f32,
}

impl Conv<'_> {
    /// Computes the convolution on all cores, with the same bits for any number of cores.
    pub fn run(&self) -> Plane {
        let factor = if self.enlarge { 2 } else { 1 };
        let input = self.sources[0].plane;
        let (rows, columns) = (input.height * factor, input.width * factor);
        let (height, width) = (rows.div_ceil(self.stride), columns.div_ceil(self.stride));
        let mut data = Floats::new(height * width * CHANNELS);
        let band = |(i, out): (usize, &mut [f32])| self.band(i * BAND, [rows, columns], width, out);
        let moments: Vec<Moments> =
            data.par_chunks_mut(BAND * width * CHANNELS).enumerate().map(band).collect();
        // Joined in the order of the rows, for the same bits with any number of threads.
        let moments = moments.iter().fold(Moments::default(), Moments::join);
        Plane { height, width, data, moments }
    }

    /// Output rows from `first` on.
    fn band(&self, first: usize, [rows, columns]: [usize; 2], width: usize, out: &mut [f32]) -> Moments {
        let arch = Arch::new();
        let line = (columns + 2) * CHANNELS;
        // The last three activated rows of each source. `held` has the row number of each slot.
        let mut slots: Vec<[Vec<f32>; 3]> =
            self.sources.iter().map(|_| std::array::from_fn(|_| vec![0.0; line])).collect();
        let mut held = [usize::MAX; 3];
        let mut moments = Moments::default();
        for (i, out) in out.chunks_exact_mut(width * CHANNELS).enumerate() {
            let y = first + i;
            // Row numbers of the padded image, one more than in the image.
            let window = [0, 1, 2].map(|k| y * self.stride + k);
            for padded in window {
                let slot = padded % 3;
                if held[slot] != padded {
                    held[slot] = padded;
                    for (source, slots) in self.sources.iter().zip(&mut slots) {
                        let row = (1..=rows).contains(&padded).then(|| padded - 1);
                        fill(source, row, self.enlarge, &mut slots[slot]);
                    }
                }
            }
            let mut taps = Vec::with_capacity(9 * self.sources.len() + 2);
            for (s, slots) in slots.iter().enumerate() {
                for (ky, padded) in window.into_iter().enumerate() {
                    for kx in 0..3 {
                        let row = &slots[padded % 3][kx * CHANNELS..];
                        taps.push(Tap { row, weights: square(self.weights, (s * 3 + ky) * 3 + kx) });
                    }
                }
            }
            let line = y * width * CHANNELS..(y + 1) * width * CHANNELS;
            let mut identity = None;
            match self.shortcut {
                Shortcut::None => {}
                Shortcut::Identity(plane) => identity = Some(&plane.data[line]),
                Shortcut::Project(planes, weights) => {
                    for (s, plane) in planes.iter().enumerate() {
                        taps.push(Tap { row: &plane.data[line.clone()], weights: square(weights, s) });
                    }
                }
            }
            let row = Row { taps: &taps, bias: &self.bias, identity, scale: self.scale, out };
            match self.stride {
                1 => arch.dispatch(Strided::<1>(row)),
                _ => arch.dispatch(Strided::<2>(row)),
            }
            let of_row = vectorized!(|| Moments::of_row(out));
            moments = moments.join(&of_row);
        }
        moments
    }
}

/// Writes one activated row of a source to `out` `[columns + 2, 16]`, with 0 at both ends. Without a row, all is 0.
fn fill(source: &Source, row: Option<usize>, enlarge: bool, out: &mut [f32]) {
    let Some(row) = row else {
        out.fill(0.0);
        return;
    };
    let (plane, affine, factor) = (source.plane, source.affine, if enlarge { 2 } else { 1 });
    let line = plane.width * CHANNELS;
    let (pixels, _) = plane.data[row / factor * line..][..line].as_chunks::<CHANNELS>();
    let end = out.len() - CHANNELS;
    let (out, _) = out[CHANNELS..end].as_chunks_mut::<CHANNELS>();
    vectorized!(move || {
        for (x, pixel) in pixels.iter().enumerate() {
            let mut value = *pixel;
            if let Some([scale, shift]) = &affine {
                for c in 0..CHANNELS {
                    value[c] = silu(value[c] * scale[c] + shift[c]);
                }
            }
            out[x * factor] = value;
            out[x * factor + factor - 1] = value;
        }
    });
}
