//! 3×3 convolutions of 16 channels, which memory traffic bounds: normalisation, SiLU, convolution, shortcut and the
//! next normalisation's moments in one pass. A band of rows keeps its three activated input rows in cache.
//!
//! Pixels are stored with their channels together, so that one pixel is one vector of the widest kind.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::math::silu;

/// Channels of every plane.
pub const CHANNELS: usize = 16;
/// Output rows per task.
const BAND: usize = 16;

/// An image `[height, width, 16]` and the moments of its channels.
#[derive(Debug, Clone)]
pub struct Plane {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// `[height, width, 16]`.
    pub data: Vec<f32>,
    /// Of every channel.
    pub moments: Moments,
}

/// Mean and sum of squared deviations per channel.
#[derive(Debug, Clone, Default)]
pub struct Moments {
    /// How many pixels.
    pub count: f64,
    /// Mean.
    pub mean: [f64; CHANNELS],
    /// Sum of squared deviations.
    pub squares: [f64; CHANNELS],
}

impl Moments {
    /// Moments of a row of pixels. Two passes while the row is in cache: one-pass sums cancel when means are large.
    fn of_row(row: &[f32]) -> Self {
        let (pixels, _) = row.as_chunks::<CHANNELS>();
        let count = pixels.len() as f32;
        let mut mean = [0.0_f32; CHANNELS];
        for pixel in pixels {
            mean.iter_mut().zip(pixel).for_each(|(m, x)| *m += x);
        }
        let mean = mean.map(|m| m / count);
        let (mut squares, mut residue) = ([0.0_f32; CHANNELS], [0.0_f32; CHANNELS]);
        for pixel in pixels {
            for c in 0..CHANNELS {
                let d = pixel[c] - mean[c];
                residue[c] += d;
                squares[c] += d * d;
            }
        }
        let n = f64::from(count);
        // The deviations sum to what rounding took from the mean.
        let exact = |c: usize| f64::from(mean[c]) + f64::from(residue[c]) / n;
        let around = |c: usize| f64::from(squares[c]) - f64::from(residue[c]) * f64::from(residue[c]) / n;
        Self { count: n, mean: std::array::from_fn(exact), squares: std::array::from_fn(around) }
    }

    /// Joins the moments of two disjoint sets (Chan, Golub and LeVeque).
    fn join(mut self, other: &Self) -> Self {
        let total = self.count + other.count;
        if other.count > 0.0 {
            for c in 0..CHANNELS {
                let delta = other.mean[c] - self.mean[c];
                self.mean[c] += delta * other.count / total;
                self.squares[c] += other.squares[c] + delta * delta * self.count * other.count / total;
            }
        }
        Self { count: total, ..self }
    }
}

/// Normalisation of one plane: silu(scale·x + shift) per channel.
pub type Affine = [[f32; CHANNELS]; 2];

/// One input of a convolution.
pub struct Source<'a> {
    /// 16 channels.
    pub plane: &'a Plane,
    /// Applied before the convolution; without it the plane is taken as it is.
    pub affine: Option<Affine>,
}

/// What the result is added to before it is scaled.
pub enum Shortcut<'a> {
    /// Nothing.
    None,
    /// The plane itself.
    Identity(&'a Plane),
    /// 1×1 convolution of the planes, weights `[plane][channel in][16]`; its bias is part of the main bias.
    Project(&'a [&'a Plane], &'a [f32]),
}

/// A 3×3 convolution with padding 1.
pub struct Conv<'a> {
    /// Inputs, whose channels follow one another.
    pub sources: &'a [Source<'a>],
    /// `[source][row][column][channel in][16]`.
    pub weights: &'a [f32],
    /// Added to every pixel.
    pub bias: [f32; CHANNELS],
    /// 1, or 2 to halve the size.
    pub stride: usize,
    /// Doubles the input by repetition first.
    pub enlarge: bool,
    /// Added to the result.
    pub shortcut: Shortcut<'a>,
    /// Factor of the sum.
    pub scale: f32,
}

impl Conv<'_> {
    /// The convolution on all cores; the same bits for any number of them.
    pub fn run(&self) -> Plane {
        let factor = if self.enlarge { 2 } else { 1 };
        let input = self.sources[0].plane;
        let (rows, columns) = (input.height * factor, input.width * factor);
        let (height, width) = (rows.div_ceil(self.stride), columns.div_ceil(self.stride));
        let mut data = vec![0.0; height * width * CHANNELS];
        let band = |(i, out): (usize, &mut [f32])| self.band(i * BAND, [rows, columns], width, out);
        let moments: Vec<Moments> =
            data.par_chunks_mut(BAND * width * CHANNELS).enumerate().map(band).collect();
        // Joined in the order of the rows, whatever thread they ran on.
        let moments = moments.iter().fold(Moments::default(), Moments::join);
        Plane { height, width, data, moments }
    }

    /// Output rows from `first` on.
    fn band(&self, first: usize, [rows, columns]: [usize; 2], width: usize, out: &mut [f32]) -> Moments {
        let arch = Arch::new();
        let line = (columns + 2) * CHANNELS;
        // Three activated rows per source, in turn; `held` says which row each slot holds.
        let mut slots: Vec<[Vec<f32>; 3]> =
            self.sources.iter().map(|_| std::array::from_fn(|_| vec![0.0; line])).collect();
        let mut held = [usize::MAX; 3];
        let mut moments = Moments::default();
        for (i, out) in out.chunks_exact_mut(width * CHANNELS).enumerate() {
            let y = first + i;
            // Padded row numbers, one more than the image's.
            let window = [0, 1, 2].map(|k| y * self.stride + k);
            for padded in window {
                let slot = padded % 3;
                if held[slot] != padded {
                    held[slot] = padded;
                    for (source, slots) in self.sources.iter().zip(&mut slots) {
                        let row = (1..=rows).contains(&padded).then(|| padded - 1);
                        arch.dispatch(Fill { source, row, enlarge: self.enlarge, out: &mut slots[slot] });
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
            moments = moments.join(&arch.dispatch(|| Moments::of_row(out)));
        }
        moments
    }
}

/// The i-th 16×16 matrix.
fn square(weights: &[f32], i: usize) -> &[f32] {
    &weights[i * CHANNELS * CHANNELS..(i + 1) * CHANNELS * CHANNELS]
}

/// Activates one row of a source into `out` `[columns + 2, 16]`, zero at both ends; a missing row is zero throughout.
struct Fill<'a> {
    source: &'a Source<'a>,
    row: Option<usize>,
    enlarge: bool,
    out: &'a mut [f32],
}

impl WithSimd for Fill<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Some(row) = self.row else {
            self.out.fill(0.0);
            return;
        };
        let (plane, factor) = (self.source.plane, if self.enlarge { 2 } else { 1 });
        let line = plane.width * CHANNELS;
        let (pixels, _) = plane.data[row / factor * line..][..line].as_chunks::<CHANNELS>();
        let end = self.out.len() - CHANNELS;
        let (out, _) = self.out[CHANNELS..end].as_chunks_mut::<CHANNELS>();
        for (x, pixel) in pixels.iter().enumerate() {
            let mut value = *pixel;
            if let Some([scale, shift]) = &self.source.affine {
                for c in 0..CHANNELS {
                    value[c] = silu(value[c] * scale[c] + shift[c]);
                }
            }
            out[x * factor] = value;
            out[x * factor + factor - 1] = value;
        }
    }
}

/// A row of pixels and the 16×16 matrix that multiplies each of them.
struct Tap<'a> {
    row: &'a [f32],
    weights: &'a [f32],
}

/// One output row: (bias + Σ taps + identity) · scale.
struct Row<'a> {
    taps: &'a [Tap<'a>],
    bias: &'a [f32; CHANNELS],
    identity: Option<&'a [f32]>,
    scale: f32,
    out: &'a mut [f32],
}

/// Every output pixel reads the input STRIDE pixels further on.
struct Strided<'a, const STRIDE: usize>(Row<'a>);

impl<const STRIDE: usize> WithSimd for Strided<'_, STRIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors per pixel, and as many pixels at once as the registers hold accumulators for.
        match S::F32_LANES {
            16 => row::<S, 1, 12, STRIDE>(simd, self.0),
            8 => row::<S, 2, 5, STRIDE>(simd, self.0),
            4 => row::<S, 4, 4, STRIDE>(simd, self.0),
            _ => row::<S, 16, 1, STRIDE>(simd, self.0),
        }
    }
}

#[inline(always)]
fn row<S: Simd, const VECTORS: usize, const PIXELS: usize, const STRIDE: usize>(simd: S, mut row: Row) {
    let width = row.out.len() / CHANNELS;
    let mut x = 0;
    while x + PIXELS <= width {
        pixels::<S, VECTORS, PIXELS, STRIDE>(simd, &mut row, x);
        x += PIXELS;
    }
    while x < width {
        pixels::<S, VECTORS, 1, STRIDE>(simd, &mut row, x);
        x += 1;
    }
}

/// Output pixels x … x + PIXELS.
#[inline(always)]
fn pixels<S: Simd, const VECTORS: usize, const PIXELS: usize, const STRIDE: usize>(
    simd: S,
    row: &mut Row,
    x: usize,
) {
    let vectors = |values: &[f32]| -> [S::f32s; VECTORS] {
        let (vectors, _) = S::as_simd_f32s(values);
        std::array::from_fn(|v| vectors[v])
    };
    let mut sums = [vectors(row.bias); PIXELS];
    for tap in row.taps {
        let input = &tap.row[x * STRIDE * CHANNELS..][..((PIXELS - 1) * STRIDE + 1) * CHANNELS];
        let (weights, _) = tap.weights.as_chunks::<CHANNELS>();
        for c in 0..CHANNELS {
            let weights = vectors(&weights[c]);
            for (p, sums) in sums.iter_mut().enumerate() {
                let value = simd.splat_f32s(input[p * STRIDE * CHANNELS + c]);
                for v in 0..VECTORS {
                    sums[v] = simd.mul_add_e_f32s(value, weights[v], sums[v]);
                }
            }
        }
    }
    let scale = simd.splat_f32s(row.scale);
    for (p, sums) in sums.iter().enumerate() {
        let at = (x + p) * CHANNELS..(x + p + 1) * CHANNELS;
        let identity = row.identity.map(|identity| vectors(&identity[at.clone()]));
        let (out, _) = S::as_mut_simd_f32s(&mut row.out[at]);
        for v in 0..VECTORS {
            let sum = identity.map_or(sums[v], |identity| simd.add_f32s(sums[v], identity[v]));
            out[v] = simd.mul_f32s(sum, scale);
        }
    }
}
