//! Inner loops of both passes over rows of pixels, in vectors as wide as the processor's.

use pulp::{Simd, WithSimd};

use super::CHANNELS;

/// The i-th 16×16 matrix.
pub fn square(weights: &[f32], i: usize) -> &[f32] {
    &weights[i * CHANNELS * CHANNELS..(i + 1) * CHANNELS * CHANNELS]
}

/// A row of pixels and the 16×16 matrix that multiplies each of them.
pub struct Tap<'a> {
    /// `[pixels, 16]`.
    pub row: &'a [f32],
    /// `[16 in][16 out]`.
    pub weights: &'a [f32],
}

/// One output row: (bias + Σ taps + identity) · scale.
pub struct Row<'a> {
    /// Rows may be longer than the output.
    pub taps: &'a [Tap<'a>],
    /// Added to every pixel.
    pub bias: &'a [f32; CHANNELS],
    /// Added pixel by pixel.
    pub identity: Option<&'a [f32]>,
    /// Factor of the sum.
    pub scale: f32,
    /// `[pixels, 16]`.
    pub out: &'a mut [f32],
}

/// A [`Row`] whose neighbouring output pixels read input pixels STRIDE apart.
pub struct Strided<'a, const STRIDE: usize>(pub Row<'a>);

impl<const STRIDE: usize> WithSimd for Strided<'_, STRIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors per pixel, and pixels at once: as many as there are registers for their sums.
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
    let whole = width - width % PIXELS;
    for x in (0..whole).step_by(PIXELS) {
        pixels::<S, VECTORS, PIXELS, STRIDE>(simd, &mut row, x);
    }
    if whole < width && width > PIXELS {
        // Computes some pixels twice, which is still faster than the remaining pixels one by one.
        pixels::<S, VECTORS, PIXELS, STRIDE>(simd, &mut row, width - PIXELS);
    } else {
        for x in whole..width {
            pixels::<S, VECTORS, 1, STRIDE>(simd, &mut row, x);
        }
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

/// The gradient of the matrices of TAPS neighbouring taps:
/// out`[tap][in][out]` += Σ over pixels x of input`[x][in]` · gradient`[x + TAPS − 1 − tap][out]`.
pub struct Products<'a, const TAPS: usize> {
    /// `[pixels, 16]`.
    pub input: &'a [f32],
    /// `[pixels + TAPS − 1, 16]`.
    pub gradient: &'a [f32],
    /// `[TAPS][16 in][16 out]`.
    pub out: &'a mut [f32],
}

impl<const TAPS: usize> WithSimd for Products<'_, TAPS> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors per pixel, and input channels at once: as many as there are registers for their sums.
        match S::F32_LANES {
            16 => products::<S, 1, 8, TAPS>(simd, self),
            8 => products::<S, 2, 4, TAPS>(simd, self),
            4 => products::<S, 4, 4, TAPS>(simd, self),
            _ => products::<S, 16, 1, TAPS>(simd, self),
        }
    }
}

#[inline(always)]
fn products<S: Simd, const VECTORS: usize, const INPUTS: usize, const TAPS: usize>(
    simd: S,
    products: Products<TAPS>,
) {
    let (pixels, _) = products.input.as_chunks::<CHANNELS>();
    let (gradients, _) = products.gradient.as_chunks::<CHANNELS>();
    assert_eq!(gradients.len(), pixels.len() + TAPS - 1);
    let (out, _) = products.out.as_chunks_mut::<CHANNELS>();
    for v in 0..VECTORS {
        for first in (0..CHANNELS).step_by(INPUTS) {
            let mut sums = [[simd.splat_f32s(0.0); INPUTS]; TAPS];
            for (pixel, window) in pixels.iter().zip(gradients.windows(TAPS)) {
                let window: [S::f32s; TAPS] =
                    std::array::from_fn(|tap| S::as_simd_f32s(&window[TAPS - 1 - tap]).0[v]);
                for i in 0..INPUTS {
                    let value = simd.splat_f32s(pixel[first + i]);
                    for tap in 0..TAPS {
                        sums[tap][i] = simd.mul_add_e_f32s(value, window[tap], sums[tap][i]);
                    }
                }
            }
            for (tap, sums) in sums.iter().enumerate() {
                for (i, sum) in sums.iter().enumerate() {
                    let (out, _) = S::as_mut_simd_f32s(&mut out[tap * CHANNELS + first + i]);
                    out[v] = simd.add_f32s(out[v], *sum);
                }
            }
        }
    }
}
