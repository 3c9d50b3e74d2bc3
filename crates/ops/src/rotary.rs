//! Attention with rotary position embedding in two dimensions. The first half of a head's channels is rotated by the
//! token's row, the second half by its column (docs/method.md, "Patch embedding and RoPE").

use burn::tensor::module::attention;
use burn::tensor::{Device, Tensor, TensorData};

use crate::device::{has_kernels, host, in_f32};
use crate::op;
use crate::operators::Attention;

/// Cosines and sines of every token's rotation angles, for one grid and one head size.
#[derive(Debug, Clone)]
pub struct Rope {
    /// `[N, head_dim]`: cos θ for both members of each rotated pair.
    pub cos: Tensor<2>,
    /// `[N, head_dim]`: −sin θ for the first member of each pair, +sin θ for the second.
    pub sin: Tensor<2>,
}

impl Rope {
    /// Tables for a grid of `rows` × `columns` tokens, row-major, with `head_dim` channels per head (a multiple of 4).
    ///
    /// The angles are computed in f64: token positions reach the hundreds on large canvases.
    pub fn new(rows: usize, columns: usize, head_dim: usize, base: f64, device: &Device) -> Self {
        assert_eq!(head_dim % 4, 0, "head_dim {head_dim} must be a multiple of 4");
        let pairs = head_dim / 4;
        let (mut cos, mut sin) = (Vec::new(), Vec::new());
        for token in 0..rows * columns {
            for position in [token / columns, token % columns] {
                let angles = (0..pairs).map(|k| position as f64 * base.powf(-(k as f64) / pairs as f64));
                let (s, c): (Vec<f32>, Vec<f32>) =
                    angles.map(f64::sin_cos).map(|(s, c)| (s as f32, c as f32)).unzip();
                cos.extend(c.iter().chain(&c));
                sin.extend(s.iter().map(|v| -v));
                sin.extend(s);
            }
        }
        let tensor = |values| Tensor::from_data(TensorData::new(values, [rows * columns, head_dim]), device);
        Self { cos: tensor(cos), sin: tensor(sin) }
    }

    /// Rotates queries or keys `[B, heads, N, head_dim]`.
    pub fn apply(&self, x: Tensor<4>) -> Tensor<4> {
        let [b, h, n, d] = x.dims();
        in_f32(x, |x| {
            // In each half (row, column), channels k and k + d/4 are a pair. The sine multiplies the other member.
            let swapped = x.clone().reshape([b * h * n, 2, 2, d / 4]).flip([2]).reshape([b, h, n, d]);
            x * self.cos.clone().unsqueeze() + swapped * self.sin.clone().unsqueeze()
        })
    }
}

/// softmax(rope(q) · rope(k)ᵀ / √head_dim) · v of `q`, `k` and `v` `[B, N, C]` → `[B, N, C]`, with the heads side by
/// side in the channels. Queries and keys lie on the same grid. `in_bf16`: products in bf16, if the CPU has them.
pub fn rotary_attention([q, k, v]: [Tensor<3>; 3], rope: &Rope, heads: usize, in_bf16: bool) -> Tensor<3> {
    if !has_kernels(&q) {
        return plain_attention([q, k, v], rope, heads);
    }
    let [batch, tokens, c] = q.dims();
    assert_eq!([k.dims(), v.dims()], [q.dims(); 2], "queries, keys and values of one grid");
    let rope = [&rope.cos, &rope.sin].map(|table| host(table.clone()));
    let kernel = Attention { batch, tokens, heads, head_dim: c / heads, in_bf16, rope };
    op::run(kernel, q.dims(), q, Some(k), Some(v))
}

/// [`rotary_attention`] with queries, keys and values side by side in one tensor: `[B, N, 3·C]` → `[B, N, C]`.
pub fn rotary_self_attention(qkv: Tensor<3>, rope: &Rope, heads: usize, in_bf16: bool) -> Tensor<3> {
    let c = qkv.dims()[2] / 3;
    rotary_attention([0, 1, 2].map(|part| qkv.clone().narrow(2, part * c, c)), rope, heads, in_bf16)
}

/// [`rotary_attention`] in Burn's operators.
pub(crate) fn plain_attention([q, k, v]: [Tensor<3>; 3], rope: &Rope, heads: usize) -> Tensor<3> {
    let [b, n, c] = q.dims();
    let split = |x: Tensor<3>| x.reshape([b, n, heads, c / heads]).swap_dims(1, 2);
    let (q, k) = (rope.apply(split(q)), rope.apply(split(k)));
    let out = attention(q, k, split(v), None, None, Default::default());
    out.swap_dims(1, 2).reshape([b, n, c])
}
