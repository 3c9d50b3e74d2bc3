//! Fused 3×3 convolutions of 16 channels: normalisation, SiLU, convolution, shortcut and the moments for the next
//! normalisation in one pass, because memory traffic limits the speed. A band keeps its three activated rows in cache.
//!
//! The 16 channels of a pixel are adjacent, so that one pixel is one vector of the widest kind.
//! `forward` and `backward` are the two passes over bands. Both use `kernels` for a row. `norm` is the arithmetic of
//! group normalisation between two passes. `merge` adds the gradients of a plane that several operators read.

mod backward;
mod forward;
mod kernels;
mod merge;
mod norm;
mod rows;
mod weights;

use crate::buffers::Floats;

pub use backward::{Backward, GradientSums, Gradients, Needed};
pub use forward::{Conv, Shortcut};
pub use merge::{Branch, Merge, add};
pub use norm::{GROUPS, GroupNorm, GroupStatistics, Linear};
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
    pub data: Floats,
    /// The moments of every channel.
    pub moments: Moments,
}

/// Mean and sum of squared deviations per channel.
#[derive(Debug, Clone, Default)]
pub struct Moments {
    /// Number of pixels.
    pub count: f64,
    /// Mean.
    pub mean: [f64; CHANNELS],
    /// Sum of squared deviations.
    pub squares: [f64; CHANNELS],
}

impl Moments {
    /// Moments of a row of pixels `[width, 16]` in two passes. The sums of a single pass would cancel where means are
    /// large.
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

    /// The moments of the union of two disjoint sets (Chan, Golub and LeVeque).
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

/// Scale and shift per channel of a normalised plane, which a convolution reads as silu(scale·x + shift).
pub type Affine = [[f32; CHANNELS]; 2];

/// One input of a convolution.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The image.
    pub plane: &'a Plane,
    /// Applied before the convolution, with SiLU. `None`: the convolution reads the plane itself.
    pub affine: Option<Affine>,
}
