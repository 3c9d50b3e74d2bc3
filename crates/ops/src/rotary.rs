//! Attention with rotary position embedding.

use burn::tensor::Tensor;
use burn::tensor::module::attention;

use crate::device::{has_kernels, host};
use crate::op::{self, Given, InputGradients, Kept, Kernel};
use crate::operators::Attention;
use crate::rope::Rope;

/// softmax(rope(q) · rope(k)ᵀ / √head_dim) · v of `q`, `k` and `v` `[B, N, C]` → `[B, N, C]`, with the heads side by
/// side in the channels. Queries and keys lie on the same grid. `in_bf16`: products in bf16, if the CPU has them.
pub fn rotary_attention(
    q: Tensor<3>,
    k: Tensor<3>,
    v: Tensor<3>,
    rope: &Rope,
    heads: usize,
    in_bf16: bool,
) -> Tensor<3> {
    if !has_kernels(&q) {
        return plain_attention(q, k, v, rope, heads);
    }
    let [batch, tokens, c] = q.dims();
    assert_eq!([k.dims(), v.dims()], [q.dims(); 2], "queries, keys and values of one grid");
    let sizes = Attention { batch, tokens, heads, head_dim: c / heads, in_bf16 };
    let tables = [&rope.cos, &rope.sin].map(|table| host(table.clone()));
    op::run(Attend { sizes, tables }, q.dims(), q, Some(k), Some(v))
}

/// [`rotary_attention`] with queries, keys and values side by side in one tensor: `[B, N, 3·C]` → `[B, N, C]`.
pub fn rotary_self_attention(qkv: Tensor<3>, rope: &Rope, heads: usize, in_bf16: bool) -> Tensor<3> {
    let c = qkv.dims()[2] / 3;
    let [q, k, v] = [0, 1, 2].map(|part| qkv.clone().narrow(2, part * c, c));
    rotary_attention(q, k, v, rope, heads, in_bf16)
}

/// [`rotary_attention`] in Burn's operators.
pub(crate) fn plain_attention(
    q: Tensor<3>,
    k: Tensor<3>,
    v: Tensor<3>,
    rope: &Rope,
    heads: usize,
) -> Tensor<3> {
    let [b, n, c] = q.dims();
    let split = |x: Tensor<3>| x.reshape([b, n, heads, c / heads]).swap_dims(1, 2);
    let (q, k) = (rope.apply(split(q)), rope.apply(split(k)));
    let out = attention(q, k, split(v), None, None, Default::default());
    out.swap_dims(1, 2).reshape([b, n, c])
}

/// Rotary attention.
#[derive(Debug)]
struct Attend {
    sizes: Attention,
    /// Tables of cos and ±sin, as in [`Rope`].
    tables: [Vec<f32>; 2],
}

impl Kernel for Attend {
    fn forward(&self, inputs: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let tables = self.tables.each_ref().map(Vec::as_slice);
        let (out, logarithms) = self.sizes.forward(inputs, tables);
        (out, keep.then(|| Box::new(logarithms) as _))
    }

    fn backward(&self, Given { inputs, kept, upstream, wanted }: Given) -> InputGradients {
        let logarithms =
            kept.and_then(|kept| kept.downcast::<Vec<f32>>().ok()).expect("kept by the forward pass");
        let tables = self.tables.each_ref().map(Vec::as_slice);
        let gradients = self.sizes.backward(inputs, tables, &logarithms, upstream);
        let mut wanted = wanted.into_iter();
        gradients.map(|gradient| wanted.next().expect("three of each").then_some(gradient))
    }
}
