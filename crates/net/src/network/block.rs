//! Pre-norm transformer blocks of the encoder and the decoders (docs/method.md, "Transformer blocks").

use burn::module::Module;
use burn::nn::{LayerNorm, LayerNormConfig, Linear, LinearConfig};
use burn::tensor::{Device, Tensor};

use super::attention::{CrossAttention, SelfAttention};
use snapsnap_ops::layers::{self, linear};
use snapsnap_ops::{Rope, linear_gelu};

/// Epsilon of every layer normalisation.
const NORM_EPSILON: f64 = 1e-6;
/// Hidden channels of an MLP, as a multiple of its token channels.
const MLP_RATIO: usize = 4;

pub(crate) fn layer_norm(dim: usize, device: &Device) -> LayerNorm {
    LayerNormConfig::new(dim).with_epsilon(NORM_EPSILON).init(device)
}

/// Normalises tokens `[B, N, dim]`.
pub(crate) fn normalise(norm: &LayerNorm, x: Tensor<3>) -> Tensor<3> {
    layers::layer_norm(norm, NORM_EPSILON, x)
}

/// Linear → GELU (erf form) → Linear.
#[derive(Module, Debug)]
pub struct Mlp {
    fc1: Linear,
    fc2: Linear,
}

impl Mlp {
    fn new(dim: usize, device: &Device) -> Self {
        Self {
            fc1: LinearConfig::new(dim, MLP_RATIO * dim).init(device),
            fc2: LinearConfig::new(MLP_RATIO * dim, dim).init(device),
        }
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        linear(&self.fc2, linear_gelu(&self.fc1, x))
    }
}

/// x + SA(LN₁ x), then x + MLP(LN₂ x).
#[derive(Module, Debug)]
pub struct EncoderBlock {
    norm1: LayerNorm,
    attn: SelfAttention,
    norm2: LayerNorm,
    mlp: Mlp,
}

impl EncoderBlock {
    pub(crate) fn new(dim: usize, heads: usize, device: &Device) -> Self {
        Self {
            norm1: layer_norm(dim, device),
            attn: SelfAttention::new(dim, heads, device),
            norm2: layer_norm(dim, device),
            mlp: Mlp::new(dim, device),
        }
    }

    /// `[B, N, dim]` → `[B, N, dim]`.
    pub(crate) fn forward(&self, x: Tensor<3>, rope: &Rope) -> Tensor<3> {
        let x = x.clone() + self.attn.forward(normalise(&self.norm1, x), rope);
        x.clone() + self.mlp.forward(normalise(&self.norm2, x))
    }
}

/// x + SA(LN₁ x), then x + CA(LN₂ x, LN_y y), then x + MLP(LN₃ x); `y` are the other photograph's tokens.
#[derive(Module, Debug)]
pub struct DecoderBlock {
    norm1: LayerNorm,
    attn: SelfAttention,
    norm2: LayerNorm,
    norm_y: LayerNorm,
    cross_attn: CrossAttention,
    norm3: LayerNorm,
    mlp: Mlp,
}

impl DecoderBlock {
    pub(crate) fn new(dim: usize, heads: usize, device: &Device) -> Self {
        Self {
            norm1: layer_norm(dim, device),
            attn: SelfAttention::new(dim, heads, device),
            norm2: layer_norm(dim, device),
            norm_y: layer_norm(dim, device),
            cross_attn: CrossAttention::new(dim, heads, device),
            norm3: layer_norm(dim, device),
            mlp: Mlp::new(dim, device),
        }
    }

    /// `x`, `y` `[B, N, dim]` → `[B, N, dim]`.
    pub(crate) fn forward(&self, x: Tensor<3>, y: Tensor<3>, rope: &Rope) -> Tensor<3> {
        let x = x.clone() + self.attn.forward(normalise(&self.norm1, x), rope);
        let x =
            x.clone() + self.cross_attn.forward(normalise(&self.norm2, x), normalise(&self.norm_y, y), rope);
        x.clone() + self.mlp.forward(normalise(&self.norm3, x))
    }
}
