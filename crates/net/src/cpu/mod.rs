//! Faster CPU roads for inference on Burn's `flex` device: attention with rotary positions, GELU, and the regressor's
//! thin convolutions. They compute what the plain tensor code beside each call computes, which remains the road for
//! every other device and for training; tests hold the two together.

mod attention;
mod conv;
mod gelu;
mod math;
mod unet;

use burn::nn::Linear;
use burn::tensor::{Device, Tensor, TensorData};

use crate::network::Rope;

pub(crate) use unet::regress;

/// Width of the UNet that the thin-convolution kernel is written for.
pub(crate) const UNET_CHANNELS: usize = conv::CHANNELS;

/// Whether `x` lives where the functions of this module apply: on `flex`, with nothing tracked for gradients.
pub(crate) fn is_fast<const D: usize>(x: &Tensor<D>) -> bool {
    let device = x.device();
    !device.is_autodiff() && device == Device::flex()
}

/// softmax(rope(q) · rope(k)ᵀ / √head_dim) · v for `q` `[B, N, C]`, `k` and `v` `[B, M, C]` → `[B, N, C]`; both sides
/// share one grid, hence one table.
pub(crate) fn rotary_attention(q: Tensor<3>, k: Tensor<3>, v: Tensor<3>, rope: &Rope, heads: usize) -> Tensor<3> {
    let ([b, n, c], m, device) = (q.dims(), k.dims()[1], q.device());
    let (cos, sin) = (host(rope.cos.clone()), host(rope.sin.clone()));
    let shape = attention::Shape { batch: b, queries: n, keys: m, heads, head_dim: c / heads };
    let out = attention::attend(&shape, &host(q), &host(k), &host(v), [&cos, &sin]);
    Tensor::from_data(TensorData::new(out, [b, n, c]), &device)
}

/// GELU (erf form) of a linear layer with bias: `[B, N, C]` → `[B, N, D]`.
pub(crate) fn linear_gelu(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    let ([b, n, c], device) = (x.dims(), x.device());
    let weight = layer.weight.val();
    let width = weight.dims()[1];
    let mut values = host(x.reshape([b * n, c]).matmul(weight));
    let bias = layer.bias.as_ref().map_or_else(|| vec![0.0; width], |bias| host(bias.val()));
    gelu::bias_gelu(&mut values, &bias);
    Tensor::from_data(TensorData::new(values, [b, n, width]), &device)
}

/// Values on the host; without a copy if the tensor is contiguous and nobody else holds it.
fn host<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_into_vec().expect("all tensors here are f32")
}
