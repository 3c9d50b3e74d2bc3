//! Steps of the backward pass on a row of pixels, before and after the matrix products.

use pulp::{Simd, WithSimd};

use super::norm::Linear;
use super::{Affine, CHANNELS};
use crate::math::silu_and_slope;
use crate::vectors::vectorized;

/// Gradient of a convolution's output.
#[derive(Debug, Clone, Copy)]
pub enum Upstream<'a> {
    /// The gradient's data and a factor.
    Scaled(&'a [f32], f32),
    /// The next operator normalises the output: the gradient of the normalised values, the output, and the map.
    Normalised(&'a [f32], &'a [f32], &'a Linear),
}

/// Repeats every pixel.
pub fn double(input: &[f32], out: &mut [f32]) {
    let pairs = out.as_chunks_mut::<CHANNELS>().0.chunks_exact_mut(2);
    for (pixel, pair) in input.as_chunks::<CHANNELS>().0.iter().zip(pairs) {
        pair.fill(*pixel);
    }
}

/// Sums of two neighbouring pixels. `add`: added to the values of `out`, which are the sums of the row above.
pub fn halve(doubled: &[f32], out: &mut [f32], add: bool) {
    let pairs = doubled.as_chunks::<CHANNELS>().0.chunks_exact(2);
    for (pixel, pair) in out.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(pairs) {
        for c in 0..CHANNELS {
            pixel[c] = pair[0][c] + pair[1][c] + if add { pixel[c] } else { 0.0 };
        }
    }
}

/// Sum over pixels, as four sums side by side, because an addition takes several cycles.
pub fn sum(pixels: &[f32]) -> [f32; CHANNELS] {
    vectorized!(move || {
        let (quads, rest) = pixels.as_chunks::<{ 4 * CHANNELS }>();
        let mut sums = [0.0_f32; 4 * CHANNELS];
        for quad in quads {
            sums.iter_mut().zip(quad).for_each(|(s, x)| *s += x);
        }
        sums.iter_mut().zip(rest).for_each(|(s, x)| *s += x);
        let pair = |c: usize| sums[c] + sums[c + CHANNELS];
        std::array::from_fn::<_, CHANNELS, _>(|c| pair(c) + pair(c + 2 * CHANNELS))
    })
}

/// Writes a row of the output's gradient to every `stride`-th pixel of `out` `[columns + 2, 16]`; all others stay 0.
pub struct Fill<'a> {
    pub upstream: Upstream<'a>,
    pub row: usize,
    pub stride: usize,
    pub out: &'a mut [f32],
}

impl WithSimd for Fill<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let line = (self.out.len() / CHANNELS - 2).div_ceil(self.stride) * CHANNELS;
        let row = self.row * line..(self.row + 1) * line;
        let end = self.out.len() - CHANNELS;
        let (out, _) = self.out[CHANNELS..end].as_chunks_mut::<CHANNELS>();
        let out = out.iter_mut().step_by(self.stride);
        match self.upstream {
            Upstream::Scaled(data, factor) => {
                let factor = simd.splat_f32s(factor);
                for (out, x) in out.zip(data[row].as_chunks::<CHANNELS>().0) {
                    let ((out, _), (x, _)) = (S::as_mut_simd_f32s(out), S::as_simd_f32s(x));
                    for v in 0..CHANNELS / S::F32_LANES {
                        out[v] = simd.mul_f32s(factor, x[v]);
                    }
                }
            }
            Upstream::Normalised(gradient, plane, map) => {
                let [slope, curve, shift] = map.each_ref().map(|values| S::as_simd_f32s(values).0);
                let gradients = gradient[row.clone()].as_chunks::<CHANNELS>().0.iter();
                for ((out, g), x) in out.zip(gradients).zip(plane[row].as_chunks::<CHANNELS>().0) {
                    let ((out, _), (g, _), (x, _)) =
                        (S::as_mut_simd_f32s(out), S::as_simd_f32s(g), S::as_simd_f32s(x));
                    for v in 0..CHANNELS / S::F32_LANES {
                        let statistics = simd.mul_add_e_f32s(curve[v], x[v], shift[v]);
                        out[v] = simd.mul_add_e_f32s(slope[v], g[v], statistics);
                    }
                }
            }
        }
    }
}

/// silu(scale·x + shift) and the slope of SiLU.
pub fn activate(input: &[f32], [scale, shift]: &Affine, values: &mut [f32], slopes: &mut [f32]) {
    vectorized!(move || {
        let pixels = input.as_chunks::<CHANNELS>().0.iter();
        let values = values.as_chunks_mut::<CHANNELS>().0.iter_mut();
        let slopes = slopes.as_chunks_mut::<CHANNELS>().0.iter_mut();
        for ((pixel, value), slope) in pixels.zip(values).zip(slopes) {
            for c in 0..CHANNELS {
                [value[c], slope[c]] = silu_and_slope(pixel[c] * scale[c] + shift[c]);
            }
        }
    });
}

/// Multiplies the gradient of SiLU's result by the slope. Returns Σ g and Σ g·(x − centre) of the product g.
pub struct Descend<'a> {
    pub input: &'a [f32],
    pub centre: [f32; CHANNELS],
    pub slopes: &'a [f32],
    pub out: &'a mut [f32],
}

impl WithSimd for Descend<'_> {
    type Output = [[f32; CHANNELS]; 2];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let pixels = self.input.as_chunks::<CHANNELS>().0.iter();
        let slopes = self.slopes.as_chunks::<CHANNELS>().0.iter();
        let out = self.out.as_chunks_mut::<CHANNELS>().0.iter_mut();
        let (centre, _) = S::as_simd_f32s(&self.centre);
        let mut sums = [[0.0; CHANNELS]; 2];
        for ((out, slope), x) in out.zip(slopes).zip(pixels) {
            let ((out, _), (slope, _), (x, _)) =
                (S::as_mut_simd_f32s(out), S::as_simd_f32s(slope), S::as_simd_f32s(x));
            let [(gradient, _), (product, _)] = sums.each_mut().map(|sums| S::as_mut_simd_f32s(sums));
            for v in 0..CHANNELS / S::F32_LANES {
                out[v] = simd.mul_f32s(out[v], slope[v]);
                gradient[v] = simd.add_f32s(gradient[v], out[v]);
                product[v] = simd.mul_add_e_f32s(out[v], simd.sub_f32s(x[v], centre[v]), product[v]);
            }
        }
        sums
    }
}
