//! Attention with rotary position embedding. Each head of each sample is one task: queries and keys are rotated and
//! packed, then each block of queries takes two matrix products, with the softmax between them while the scores are in
//! cache. The forward pass keeps nothing but the logarithm of every row's sum of exponentials. The backward pass
//! computes the scores of each block of queries again (Dao, "FlashAttention-2"), so that scores never leave the cache.

use rayon::prelude::*;

use super::elements::LANES;
use crate::buffers::{Floats, take};
use crate::math::exp;
use crate::multiply::{Matrix, Right, product};
use crate::op::{Given, InputGradients, Kept, Kernel};
use crate::vectors::vectorized;

/// Queries per block of the forward pass: 128 × 1024 scores of 4 bytes fit a second-level cache.
const FORWARD_BLOCK: usize = 128;

/// Queries per block of the backward pass: 64 × 1024 scores and their gradients are of the same size.
const BLOCK: usize = 64;

/// Sizes of an attention and its rotations; tokens hold `heads · head_dim` channels.
#[derive(Debug)]
pub struct Attention {
    /// Samples.
    pub batch: usize,
    /// Tokens of a sample: queries, keys and values.
    pub tokens: usize,
    /// Heads.
    pub heads: usize,
    /// Channels of a head, a multiple of 4.
    pub head_dim: usize,
    /// Products in bf16, if the processor has the instructions.
    pub in_bf16: bool,
    /// Tables of cos and ±sin, `[tokens, head_dim]` each, as [`crate::Rope`] holds them.
    pub rope: [Vec<f32>; 2],
}

impl Kernel for Attention {
    /// softmax(rotated q · rotated kᵀ / √head_dim) · v of queries, keys and values `[B, tokens, C]` → `[B, tokens, C]`.
    /// Keeps the logarithms of the rows' sums of exponentials, `[B, heads, tokens]`.
    fn forward(&self, [q, k, v]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let Self { tokens, head_dim: d, .. } = *self;
        let mut by_head = Floats::new(self.batch * tokens * self.heads * d);
        let mut logarithms = vec![0.0; self.batch * self.heads * tokens];
        let heads = by_head.par_chunks_exact_mut(tokens * d).zip(logarithms.par_chunks_exact_mut(tokens));
        heads.enumerate().for_each(|(i, (out, logarithms))| {
            let [packed_q, packed_k] =
                [(q, self.scale()), (k, 1.0)].map(|(x, factor)| self.pack(x, i, factor));
            let across = self.right([d, tokens], (&packed_k, [d, 1]));
            let values = self.right([tokens, d], (self.head(v, i), [1, self.heads * d]));
            let mut scores = Floats::new(FORWARD_BLOCK.min(tokens) * tokens);
            let blocks = packed_q.chunks(FORWARD_BLOCK * d).zip(out.chunks_mut(FORWARD_BLOCK * d));
            for ((block, out), logarithms) in blocks.zip(logarithms.chunks_mut(FORWARD_BLOCK)) {
                let rows = logarithms.len();
                let scores = &mut scores[..rows * tokens];
                product([rows, tokens, d], (block, [1, d]), &across, scores, false);
                let sums = exponentials(scores, tokens, logarithms);
                product([rows, d, tokens], (scores, [1, tokens]), &values, out, false);
                for (row, sum) in out.chunks_exact_mut(d).zip(sums) {
                    row.iter_mut().for_each(|x| *x /= sum);
                }
            }
        });
        (self.by_token(&by_head), keep.then(|| Box::new(logarithms) as _))
    }

    /// Computes all gradients, wanted or not, because they share nearly all of the work.
    fn backward(&self, Given { inputs: [q, k, v], kept, upstream: dy, wanted }: Given) -> InputGradients {
        let kept = kept.and_then(|kept| kept.downcast::<Vec<f32>>().ok());
        let logarithms = kept.expect("kept by the forward pass");
        let Self { tokens, head_dim: d, .. } = *self;
        let width = self.heads * d;
        let mut by_head = [(); 3].map(|()| Floats::new(self.batch * tokens * width));
        let [dq, dk, dv] = &mut by_head;
        let heads = dq.par_chunks_exact_mut(tokens * d).zip(dk.par_chunks_exact_mut(tokens * d));
        let heads = heads.zip(dv.par_chunks_exact_mut(tokens * d)).enumerate();
        heads.for_each(|(i, ((dq, dk), dv))| {
            let [packed_q, packed_k] =
                [(q, self.scale()), (k, 1.0)].map(|(x, factor)| self.pack(x, i, factor));
            let (values, dy) = (self.head(v, i), self.head(dy, i));
            let across = [(&packed_k[..], [d, 1]), (values, [width, 1])].map(|x| self.right([d, tokens], x));
            let along = self.right([tokens, d], (&packed_k, [1, d]));
            let [mut scores, mut gradients] = [(); 2].map(|()| Floats::new(BLOCK.min(tokens) * tokens));
            let blocks = packed_q.chunks(BLOCK * d).zip(dq.chunks_mut(BLOCK * d));
            let logarithms = logarithms[i * tokens..][..tokens].chunks(BLOCK);
            for (b, ((block, dq), logarithms)) in blocks.zip(logarithms).enumerate() {
                let (rows, add) = (logarithms.len(), b > 0);
                let dy = (&dy[b * BLOCK * width..], [1, width]);
                let of_block = [(block, [1, d]), dy].map(|x| self.right([rows, d], x));
                let (scores, gradients) = (&mut scores[..rows * tokens], &mut gradients[..rows * tokens]);
                product([rows, tokens, d], (block, [1, d]), &across[0], scores, false);
                product([rows, tokens, d], dy, &across[1], gradients, false);
                softmax_gradient(scores, gradients, tokens, logarithms);
                product([rows, d, tokens], (gradients, [1, tokens]), &along, dq, false);
                product([tokens, d, rows], (gradients, [tokens, 1]), &of_block[0], dk, add);
                product([tokens, d, rows], (scores, [tokens, 1]), &of_block[1], dv, add);
            }
            rotate(dq, d, &self.rope, self.scale(), -1.0);
            rotate(dk, d, &self.rope, 1.0, -1.0);
        });
        [0, 1, 2].map(|i| wanted[i].then(|| self.by_token(&by_head[i])))
    }
}

impl Attention {
    fn right<'a>(&self, size: [usize; 2], matrix: Matrix<'a>) -> Right<'a> {
        Right::new(self.in_bf16, size, matrix)
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_dim as f32).sqrt()
    }

    /// The values from the first token of a head on; `i` counts the heads of all samples.
    fn head<'a>(&self, x: &'a [f32], i: usize) -> &'a [f32] {
        &x[(i / self.heads * self.tokens * self.heads + i % self.heads) * self.head_dim..]
    }

    /// The tokens `[tokens, head_dim]` of head `i`, rotated and multiplied by `factor`.
    fn pack(&self, x: &[f32], i: usize, factor: f32) -> Floats {
        let d = self.head_dim;
        let mut out = Floats::new(self.tokens * d);
        for (out, x) in out.chunks_exact_mut(d).zip(self.head(x, i).chunks(self.heads * d)) {
            out.copy_from_slice(&x[..d]);
        }
        rotate(&mut out, d, &self.rope, factor, 1.0);
        out
    }

    /// `[B, heads, tokens, head_dim]` → `[B, tokens, C]`.
    fn by_token(&self, by_head: &[f32]) -> Vec<f32> {
        /// Tokens per task.
        const TOKENS: usize = 64;
        let Self { tokens, heads, head_dim: d, .. } = *self;
        let mut out = take(by_head.len());
        out.par_chunks_mut(TOKENS * heads * d).enumerate().for_each(|(i, out)| {
            for (j, out) in out.chunks_exact_mut(heads * d).enumerate() {
                let (b, n) = ((i * TOKENS + j) / tokens, (i * TOKENS + j) % tokens);
                for (h, out) in out.chunks_exact_mut(d).enumerate() {
                    out.copy_from_slice(&by_head[((b * heads + h) * tokens + n) * d..][..d]);
                }
            }
        });
        out
    }
}

/// Rotates one head's tokens in place, and scales them. `sign`: 1, or −1 to rotate back.
fn rotate(x: &mut [f32], d: usize, rope: &[Vec<f32>; 2], factor: f32, sign: f32) {
    let quarter = d / 4;
    vectorized!(move || {
        let tables = rope[0].chunks_exact(d).zip(rope[1].chunks_exact(d));
        for (x, (cos, sin)) in x.chunks_exact_mut(d).zip(tables) {
            // Two halves (row, column). The two quarters of a half hold the members of its pairs.
            for half in [0, 2 * quarter] {
                let [cos, sin] = [cos, sin].map(|values| values[half..half + 2 * quarter].split_at(quarter));
                let (first, second) = x[half..half + 2 * quarter].split_at_mut(quarter);
                for k in 0..quarter {
                    let (a, b) = (first[k], second[k]);
                    first[k] = (a * cos.0[k] + b * (sign * sin.0[k])) * factor;
                    second[k] = (b * cos.1[k] + a * (sign * sin.1[k])) * factor;
                }
            }
        }
    });
}

/// Replaces scores by e^(score − row's maximum), and writes ln Σ e^score per row. Returns the sums of the new rows.
fn exponentials(scores: &mut [f32], keys: usize, logarithms: &mut [f32]) -> Vec<f32> {
    vectorized!(move || {
        let mut all = Vec::with_capacity(logarithms.len());
        for (row, logarithm) in scores.chunks_exact_mut(keys).zip(logarithms.iter_mut()) {
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
            *logarithm = most + sum.ln();
            all.push(sum);
        }
        all
    })
}

/// Replaces scores by their softmax p, and the gradient dp by the gradient of the scores, p · (dp − Σ p·dp).
fn softmax_gradient(scores: &mut [f32], gradients: &mut [f32], keys: usize, logarithms: &[f32]) {
    vectorized!(move || {
        let rows = scores.chunks_exact_mut(keys).zip(gradients.chunks_exact_mut(keys));
        for ((scores, gradients), logarithm) in rows.zip(logarithms) {
            let mut sums = [0.0_f32; LANES];
            let (chunks, rest) = scores.as_chunks_mut::<LANES>();
            let (given, given_rest) = gradients.as_chunks::<LANES>();
            for (chunk, given) in chunks.iter_mut().zip(given) {
                for ((s, x), g) in sums.iter_mut().zip(chunk).zip(given) {
                    *x = exp(*x - logarithm);
                    *s += *x * g;
                }
            }
            let mut sum: f32 = sums.iter().sum();
            for (x, g) in rest.iter_mut().zip(given_rest) {
                *x = exp(*x - logarithm);
                sum += *x * g;
            }
            for (g, p) in gradients.iter_mut().zip(scores) {
                *g = *p * (*g - sum);
            }
        }
    });
}
