//! 3×3 convolutions of 16 channels, which memory traffic bounds: normalisation, SiLU, convolution, shortcut and the
//! next normalisation's moments in one pass. A band of rows keeps its three activated input rows in cache.
//!
//! Pixels are stored with their channels together, so that one pixel is one vector of the widest kind.
//! `forward` and `backward` are the two passes over bands. Both use `kernels` for a row. `norm` is the arithmetic of group
//! normalisation between two passes. `merge` joins the gradients of a plane that several operators read.

use pulp::{Simd, WithSimd};

mod backward;
mod forward;
mod kernels;
mod merge;
mod norm;
mod rows;
mod weights;

pub use backward::{Backward, Gradients, Sums, Wanted};
pub use forward::{Conv, Shortcut};
pub use merge::{Branch, Merge, add};
pub use norm::{GroupNorm, Layer, Linear, NormGradients};
pub use rows::Upstream;
pub use weights::{arrange, rearrange, transpose};

/// Channels of every plane.
pub const CHANNELS: usize = 16;

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

/// The moments of a row of pixels `[width, 16]`.
struct RowMoments<'a>(&'a [f32]);

impl WithSimd for RowMoments<'_> {
    type Output = Moments;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> Moments {
        Moments::of_row(self.0)
    }
}

impl Moments {
    /// Moments of a row of pixels. Two passes while the row is in cache: one-pass sums cancel when means are large.
    #[inline(always)]
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
        // The sum of the deviations is the rounding error of the mean.
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
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// 16 channels.
    pub plane: &'a Plane,
    /// Applied before the convolution; without it the plane is taken as it is.
    pub affine: Option<Affine>,
}
