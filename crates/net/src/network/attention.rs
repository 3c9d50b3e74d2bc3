//! Multi-head attention with rotary positions: self-attention with one fused projection, cross-attention with three
//! (docs/method.md, "Transformer blocks"). The scale is head_dim^(−½). There is no mask.

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::{Device, Tensor};

use snapsnap_ops::layers::linear;
use snapsnap_ops::{Rope, is_bf16, rotary_attention, rotary_self_attention};

/// Self-attention; `qkv`'s output rows are all queries, all keys, all values.
#[derive(Module, Debug)]
pub struct SelfAttention {
    qkv: Linear,
    proj: Linear,
    heads: usize,
}

impl SelfAttention {
    pub(crate) fn new(dim: usize, heads: usize, device: &Device) -> Self {
        Self {
            qkv: LinearConfig::new(dim, 3 * dim).init(device),
            proj: LinearConfig::new(dim, dim).init(device),
            heads,
        }
    }

    /// `[B, N, dim]` → `[B, N, dim]`.
    pub(crate) fn forward(&self, x: Tensor<3>, rope: &Rope) -> Tensor<3> {
        let is_bf16 = is_bf16(&self.proj.weight);
        linear(&self.proj, rotary_self_attention(linear(&self.qkv, x), rope, self.heads, is_bf16))
    }
}

/// Cross-attention: queries from one photograph's tokens, keys and values from the other's tokens.
#[derive(Module, Debug)]
pub struct CrossAttention {
    projq: Linear,
    projk: Linear,
    projv: Linear,
    proj: Linear,
    heads: usize,
}

impl CrossAttention {
    pub(crate) fn new(dim: usize, heads: usize, device: &Device) -> Self {
        let square = || LinearConfig::new(dim, dim).init(device);
        Self { projq: square(), projk: square(), projv: square(), proj: square(), heads }
    }

    /// Queries `x` `[B, N, dim]`, memory `y` `[B, M, dim]` → `[B, N, dim]`.
    pub(crate) fn forward(&self, x: Tensor<3>, y: Tensor<3>, rope: &Rope) -> Tensor<3> {
        let (q, k, v) = (linear(&self.projq, x), linear(&self.projk, y.clone()), linear(&self.projv, y));
        linear(&self.proj, rotary_attention([q, k, v], rope, self.heads, is_bf16(&self.proj.weight)))
    }
}
