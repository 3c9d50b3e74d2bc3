//! The gradient of a plane that several operators read: a normalisation, a shortcut, and a skip connection.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::CHANNELS;
use super::kernels::{Products, Row, Strided, Tap};
use super::norm::Linear;
use crate::vectors::vectorized;

/// Pixels that are processed while they are in the first-level cache; a multiple of every kernel's block of pixels.
const CHUNK: usize = 60;
/// Pixels per task.
const TASK: usize = 32 * CHUNK;

/// The shortcut around a residual block.
#[derive(Debug, Clone, Copy)]
pub struct Branch<'a> {
    /// Gradient of the block's result, a scaled sum.
    pub upstream: &'a [f32],
    /// Factor of that sum.
    pub scale: f32,
    /// Transposed 1×1 weights `[16 out][16 in]` if the shortcut projects.
    pub projection: Option<&'a [f32]>,
}

/// Adds up the gradients of the plane x `[pixels, 16]`.
pub struct Merge<'a> {
    /// The plane x.
    pub plane: &'a [f32],
    /// The gradient through the plane's normalisation, as a map.
    pub map: &'a Linear,
    /// The gradient through a shortcut.
    pub shortcut: Option<Branch<'a>>,
    /// The gradient of other readers.
    pub other: Option<&'a [f32]>,
    /// Whether a projection's weight gradient is needed.
    pub parameters: bool,
}

impl Merge<'_> {
    /// Turns the gradient of the normalisation's result into the gradient of the plane, on all cores, with the same
    /// bits for any number of cores. Returns the gradient `[16 in][16 out]` of a projection's weight; empty without a
    /// projection or without [`Self::parameters`].
    pub fn run(&self, gradient: &mut [f32]) -> Vec<f64> {
        let task = |(i, out): (usize, &mut [f32])| self.task(i * TASK * CHANNELS, out);
        let parts: Vec<Vec<f64>> = gradient.par_chunks_mut(TASK * CHANNELS).enumerate().map(task).collect();
        let mut parts = parts.into_iter();
        let mut all = parts.next().unwrap_or_default();
        for part in parts {
            all.iter_mut().zip(&part).for_each(|(a, b)| *a += b);
        }
        all
    }

    fn task(&self, first: usize, out: &mut [f32]) -> Vec<f64> {
        let arch = Arch::new();
        let mut branch = [0.0; CHUNK * CHANNELS];
        let projects = self.shortcut.is_some_and(|branch| branch.projection.is_some());
        let mut sums = vec![0.0; if projects && self.parameters { CHANNELS * CHANNELS } else { 0 }];
        for (i, out) in out.chunks_mut(CHUNK * CHANNELS).enumerate() {
            let range = first + i * CHUNK * CHANNELS..first + i * CHUNK * CHANNELS + out.len();
            let plane = &self.plane[range.clone()];
            let branch = &mut branch[..out.len()];
            match self.shortcut {
                None => branch.fill(0.0),
                Some(Branch { upstream, scale, projection: None }) => {
                    let upstream = &upstream[range.clone()];
                    vectorized!(|| branch.iter_mut().zip(upstream).for_each(|(b, g)| *b = g * scale));
                }
                Some(Branch { upstream, scale, projection: Some(weights) }) => {
                    let row = &upstream[range.clone()];
                    if self.parameters {
                        arch.dispatch(Products::<1> { input: plane, gradient: row, out: &mut sums });
                    }
                    let (taps, bias) = (&[Tap { row, weights }], &[0.0; CHANNELS]);
                    arch.dispatch(Strided::<1>(Row { taps, bias, identity: None, scale, out: branch }));
                }
            }
            if let Some(other) = self.other {
                let other = &other[range];
                vectorized!(|| branch.iter_mut().zip(other).for_each(|(b, g)| *b += g));
            }
            arch.dispatch(Descend { map: self.map, plane, branch, out });
        }
        // The forward pass scaled the sum of projection and convolution.
        let scale = self.shortcut.map_or(1.0, |branch| f64::from(branch.scale));
        sums.iter().map(|&sum| f64::from(sum) * scale).collect()
    }
}

/// out = slope·out + curve·x + shift + branch, in fused multiply-adds.
struct Descend<'a> {
    map: &'a Linear,
    plane: &'a [f32],
    branch: &'a [f32],
    out: &'a mut [f32],
}

impl WithSimd for Descend<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [slope, curve, shift] = self.map.each_ref().map(|values| S::as_simd_f32s(values).0);
        let pixels = self.plane.as_chunks::<CHANNELS>().0.iter();
        let branches = self.branch.as_chunks::<CHANNELS>().0.iter();
        let out = self.out.as_chunks_mut::<CHANNELS>().0.iter_mut();
        for ((out, x), branch) in out.zip(pixels).zip(branches) {
            let (out, _) = S::as_mut_simd_f32s(out);
            let ((x, _), (branch, _)) = (S::as_simd_f32s(x), S::as_simd_f32s(branch));
            for v in 0..CHANNELS / S::F32_LANES {
                let sum = simd.mul_add_e_f32s(curve[v], x[v], simd.add_f32s(shift[v], branch[v]));
                out[v] = simd.mul_add_e_f32s(slope[v], out[v], sum);
            }
        }
    }
}

/// Adds `other` to `gradient` on all cores.
pub fn add(gradient: &mut [f32], other: &[f32]) {
    let pieces = gradient.par_chunks_mut(TASK * CHANNELS).zip(other.par_chunks(TASK * CHANNELS));
    pieces.for_each(|(out, other)| out.iter_mut().zip(other).for_each(|(a, b)| *a += b));
}
