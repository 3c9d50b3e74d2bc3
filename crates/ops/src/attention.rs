//! Attention with rotary positions, one head after the other: rotate while packing, two matrix products per block of
//! queries, softmax in between while the scores are in cache.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::math::exp;
use super::multiply;

/// Queries per block: 128 × 1024 scores of 4 bytes fit a second-level cache.
const BLOCK: usize = 128;

/// Sizes of an attention; tokens hold `heads · head_dim` channels.
pub struct Shape {
    pub batch: usize,
    pub queries: usize,
    pub keys: usize,
    pub heads: usize,
    pub head_dim: usize,
}

/// `q` `[batch, queries, heads·head_dim]`, `k` and `v` `[batch, keys, …]`, rotation tables (cos, ±sin)
/// `[tokens, head_dim]` → `[batch, queries, …]`.
pub fn attend(s: &Shape, q: &[f32], k: &[f32], v: &[f32], rope: [&[f32]; 2]) -> Vec<f32> {
    let (d, width) = (s.head_dim, s.heads * s.head_dim);
    let arch = Arch::new();
    // Head-major, so that every head owns one contiguous piece.
    let mut by_head = vec![0.0_f32; s.batch * s.heads * s.queries * d];
    by_head.par_chunks_mut(s.queries * d).enumerate().for_each(|(i, out)| {
        let (b, h) = (i / s.heads, i % s.heads);
        let pack = |x: &[f32], tokens: usize, factor: f32| {
            let mut packed = vec![0.0; tokens * d];
            let tokens = &x[b * tokens * width..(b + 1) * tokens * width];
            arch.dispatch(Rotate { x: &tokens[h * d..], width, d, rope, factor, out: &mut packed });
            packed
        };
        let queries = pack(q, s.queries, 1.0 / (d as f32).sqrt());
        let keys = pack(k, s.keys, 1.0);
        let values = &v[b * s.keys * width + h * d..];
        let mut scores = vec![0.0; BLOCK.min(s.queries) * s.keys];
        for (queries, out) in queries.chunks(BLOCK * d).zip(out.chunks_mut(BLOCK * d)) {
            let rows = queries.len() / d;
            let scores = &mut scores[..rows * s.keys];
            multiply([rows, s.keys, d], queries, [1, d], &keys, [d, 1], scores);
            let sums = arch.dispatch(Softmax { scores, keys: s.keys });
            multiply([rows, d, s.keys], scores, [1, s.keys], values, [1, width], out);
            for (row, sum) in out.chunks_exact_mut(d).zip(sums) {
                row.iter_mut().for_each(|x| *x /= sum);
            }
        }
    });
    let mut out = vec![0.0; by_head.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(token, out)| {
        let (b, n) = (token / s.queries, token % s.queries);
        for (h, out) in out.chunks_exact_mut(d).enumerate() {
            out.copy_from_slice(&by_head[((b * s.heads + h) * s.queries + n) * d..][..d]);
        }
    });
    out
}

/// One head's tokens, rotated, scaled and packed.
struct Rotate<'a> {
    x: &'a [f32],
    width: usize,
    d: usize,
    rope: [&'a [f32]; 2],
    factor: f32,
    out: &'a mut [f32],
}

impl WithSimd for Rotate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let (d, quarter) = (self.d, self.d / 4);
        for (token, out) in self.out.chunks_exact_mut(d).enumerate() {
            let x = &self.x[token * self.width..][..d];
            let (cos, sin) = (&self.rope[0][token * d..][..d], &self.rope[1][token * d..][..d]);
            // Two halves (row, column), each of two quarters whose members pair up.
            for half in [0, 2 * quarter] {
                for k in 0..quarter {
                    let (i, j) = (half + k, half + quarter + k);
                    out[i] = (x[i] * cos[i] + x[j] * sin[i]) * self.factor;
                    out[j] = (x[j] * cos[j] + x[i] * sin[j]) * self.factor;
                }
            }
        }
    }
}

/// Rows of scores → e^(score − row's maximum); returns the rows' sums.
struct Softmax<'a> {
    scores: &'a mut [f32],
    keys: usize,
}

/// Independent accumulators of a reduction, as many as the widest vector has lanes.
const LANES: usize = 16;

impl WithSimd for Softmax<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> Vec<f32> {
        let row = |row: &mut [f32]| {
            let mut most = [f32::NEG_INFINITY; LANES];
            let (chunks, rest) = row.as_chunks::<LANES>();
            for chunk in chunks {
                for (m, x) in most.iter_mut().zip(chunk) {
                    *m = if *x > *m { *x } else { *m };
                }
            }
            let most = most.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max);
            let mut sums = [0.0_f32; LANES];
            let (chunks, rest) = row.as_chunks_mut::<LANES>();
            for chunk in chunks {
                for (s, x) in sums.iter_mut().zip(chunk) {
                    *x = exp(*x - most);
                    *s += *x;
                }
            }
            let mut sum: f32 = sums.iter().sum();
            for x in rest {
                *x = exp(*x - most);
                sum += *x;
            }
            sum
        };
        self.scores.chunks_exact_mut(self.keys).map(row).collect()
    }
}
