//! The operators of the networks: forward and backward passes as plain functions of f32 slices. (Burn computes the
//! backward pass of a convolution as a convolution whose kernel is the whole image, and the backward pass of attention
//! in many small steps.)
//!
//! Images are `[B, C, H, W]` and tokens `[B, N, C]`, contiguous, of any size. Every result has the same bits for any
//! number of threads: work is divided by sizes alone, and the sums of several tasks are added in a fixed order.

mod attention;
mod conv1x1;
mod conv3x3;
mod convolution;
mod elements;
mod im2col;
mod linear;
mod norm;
mod transposed;
mod weights3x3;

#[cfg(test)]
mod tests;

use rayon::prelude::*;

pub use attention::Attention;
pub use convolution::Convolution;
pub use linear::Linear;
pub use norm::LayerNorm;

/// The sum of parts of `len` values each, in the order of the parts.
fn join<'a>(parts: impl Iterator<Item = &'a [f32]>, len: usize) -> Vec<f32> {
    /// Values per task.
    const PIECE: usize = 1024;
    let parts: Vec<_> = parts.collect();
    let mut out = vec![0.0; len];
    out.par_chunks_mut(PIECE).enumerate().for_each(|(i, out)| {
        let mut sums = [0.0_f64; PIECE];
        for part in &parts {
            sums.iter_mut().zip(&part[i * PIECE..]).for_each(|(sum, x)| *sum += f64::from(*x));
        }
        out.iter_mut().zip(sums).for_each(|(out, sum)| *out = sum as f32);
    });
    out
}

/// The data in `count` pieces, or `count` times `None`.
fn parts(data: Option<&mut [f32]>, piece: usize, count: usize) -> Vec<Option<&mut [f32]>> {
    match data {
        Some(data) => data.chunks_mut(piece).map(Some).collect(),
        None => (0..count).map(|_| None).collect(),
    }
}
