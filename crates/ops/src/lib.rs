//! Operators that are slow on Burn's backends. Each operator is one function with two implementations: kernels with
//! their own gradients on Burn's `flex` device, and plain tensor code on every other device and in 16 bits. Tests
//! compare the two. [`gpu`] and [`rows`] have gradients for GPUs.

pub mod buffers;
pub mod conv;
pub mod gpu;
pub mod half;
pub mod layers;
mod lengths;
mod math;
mod multiply;
pub mod op;
pub mod orthogonal;
mod resize;
mod rope;
pub mod rows;
mod tracked;
pub mod train;
pub mod unet;
pub mod wide;

#[cfg(test)]
mod tests;

use std::f64::consts::FRAC_1_SQRT_2;

use burn::module::Param;
use burn::nn::Linear;
use burn::tensor::activation::gelu;
use burn::tensor::module::{attention, interpolate};
use burn::tensor::ops::{InterpolateMode, InterpolateOptions};
use burn::tensor::{DType, Device, FloatDType, Tensor, TensorData};

pub use lengths::mean_lengths;
pub use rope::Rope;
use snapsnap_base::bilinear::{Tap, taps};
use train::{Attention, Tokens};

/// Whether `x` runs on this crate's kernels without gradients: f32 on `flex`, without autodiff.
pub fn is_fast<const D: usize>(x: &Tensor<D>) -> bool {
    let device = x.device();
    x.dtype() == DType::F32 && !device.is_autodiff() && device == Device::flex()
}

/// Whether `x` runs on this crate's kernels with gradients: f32 on `flex`, with autodiff.
pub fn is_trained_fast<const D: usize>(x: &Tensor<D>) -> bool {
    let device = x.device();
    x.dtype() == DType::F32 && device.is_autodiff() && device.inner() == Device::flex()
}

/// Whether `x` runs on this crate's kernels, with gradients or without.
pub fn has_kernels<const D: usize>(x: &Tensor<D>) -> bool {
    is_fast(x) || is_trained_fast(x)
}

/// `x` in the float type of a layer's weight; on `flex` `x` itself, because kernels round their factors themselves.
pub fn as_weight<const D: usize, const W: usize>(x: Tensor<D>, weight: &Param<Tensor<W>>) -> Tensor<D> {
    if has_kernels(&x) { x } else { x.cast(weight.val().dtype()) }
}

/// Whether a layer's weight is bf16; then the layer's products are in bf16, too.
pub fn is_bf16<const D: usize>(weight: &Param<Tensor<D>>) -> bool {
    weight.val().dtype() == DType::BF16
}

/// Runs `compute` in f32 and casts the result back, if `x` has 16 bits. For norms and rotations.
pub fn in_f32<const D: usize>(x: Tensor<D>, compute: impl FnOnce(Tensor<D>) -> Tensor<D>) -> Tensor<D> {
    let dtype = x.dtype();
    let is_narrow = matches!(dtype, DType::F16 | DType::BF16);
    if is_narrow { compute(x.cast(FloatDType::F32)).cast(dtype) } else { compute(x) }
}

/// softmax(rope(q) · rope(k)ᵀ / √head_dim) · v: `q` `[B, N, C]`, `k` and `v` `[B, M, C]` → `[B, N, C]`, with the heads
/// side by side in the channels. Queries and keys lie on the same grid. `half`: products in bf16, if the CPU has them.
pub fn rotary_attention(
    q: Tensor<3>,
    k: Tensor<3>,
    v: Tensor<3>,
    rope: &Rope,
    heads: usize,
    half: bool,
) -> Tensor<3> {
    if is_trained_fast(&q) {
        return tracked::apart([q, k, v], rope, heads, half);
    }
    if !is_fast(&q) {
        return plain_attention(q, k, v, [rope, rope], heads);
    }
    let ([b, n, c], m, device) = (q.dims(), k.dims()[1], q.device());
    let (cos, sin) = (host(rope.cos.clone()), host(rope.sin.clone()));
    let attention = Attention { batch: b, queries: n, keys: m, heads, head_dim: c / heads, half };
    let [q, k, v] = [q, k, v].map(host);
    let (out, _) = attention.forward(Tokens::apart([&q, &k, &v], c), [&cos, &sin]);
    Tensor::from_data(TensorData::new(out, [b, n, c]), &device)
}

/// [`rotary_attention`] with queries, keys and values side by side in one tensor: `[B, N, 3·C]` → `[B, N, C]`.
pub fn rotary_self_attention(qkv: Tensor<3>, rope: &Rope, heads: usize, half: bool) -> Tensor<3> {
    if is_trained_fast(&qkv) {
        return tracked::together(qkv, rope, heads, half);
    }
    let c = qkv.dims()[2] / 3;
    let part = |i: usize| qkv.clone().narrow(2, i * c, c);
    rotary_attention(part(0), part(1), part(2), rope, heads, half)
}

fn plain_attention(q: Tensor<3>, k: Tensor<3>, v: Tensor<3>, ropes: [&Rope; 2], heads: usize) -> Tensor<3> {
    let [b, n, c] = q.dims();
    let split = |x: Tensor<3>| {
        let tokens = x.dims()[1];
        x.reshape([b, tokens, heads, c / heads]).swap_dims(1, 2)
    };
    let (q, k) = (ropes[0].apply(split(q)), ropes[1].apply(split(k)));
    let out = attention(q, k, split(v), None, None, Default::default());
    out.swap_dims(1, 2).reshape([b, n, c])
}

/// A linear layer followed by GELU (erf form): `[B, N, C]` → `[B, N, D]`.
pub fn linear_gelu(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    if has_kernels(&x) {
        return layers::linear_gelu(layer, x);
    }
    let has_gradient = x.device().is_autodiff();
    let x = layer.forward(x);
    if has_gradient {
        // On all backends but flex, Burn's GELU has the gradient of the approximation by tanh, which is 4e-4 off.
        return x.clone() * ((x * FRAC_1_SQRT_2).erf() + 1.0) * 0.5;
    }
    gelu(x)
}

/// Bilinear resize of `[B, C, H, W]` to `size` (rows, columns).
///
/// `align_corners`: the outermost samples coincide (inside the DPT head). Otherwise the outer edges of the pixels
/// coincide (everywhere else). [0, 1] becomes [0, ⅓, ⅔, 1] or [0, ¼, ¾, 1] (docs/method.md, "Check values").
pub fn bilinear(x: Tensor<4>, size: [usize; 2], align_corners: bool) -> Tensor<4> {
    let ([b, c, h, w], device) = (x.dims(), x.device());
    let [down, across] = [(h, size[0]), (w, size[1])].map(|(from, to)| taps(from, to, align_corners));
    if is_trained_fast(&x) {
        return tracked::resized(x, down, across);
    }
    if device.is_autodiff() {
        // Burn's own operator has no backward pass on GPUs. Products with constant matrices have one.
        let matrix = |taps: &[Tap], from: usize| {
            let data = TensorData::new(resize::matrix(taps, from), [taps.len(), from]);
            Tensor::<2>::from_data(data, &device).cast(x.dtype())
        };
        let (down, across) = (matrix(&down, h).unsqueeze(), matrix(&across, w).transpose().unsqueeze());
        return down.matmul(x).matmul(across);
    }
    if is_fast(&x) {
        let out = resize::resize(&host(x), [h, w], &down, &across);
        return Tensor::from_data(TensorData::new(out, [b, c, size[0], size[1]]), &device);
    }
    let options = InterpolateOptions::new(InterpolateMode::Bilinear).with_align_corners(align_corners);
    interpolate(x, options.with_output_size(size))
}

/// Sums over the last dimension in two steps: `[A, B, N]` → `[A, B, 1]`. A GPU uses one thread per sum of a step.
pub fn sum_last(x: Tensor<3>) -> Tensor<3> {
    let [a, b, n] = x.dims();
    let inner = near_root(n);
    x.reshape([a, b, inner, n / inner]).sum_dim(3).reshape([a, b, inner]).sum_dim(2)
}

/// Repeats the last dimension: `[A, B, 1]` → `[A, B, N]`. Its gradient is summed in two steps, as in [`sum_last`].
pub fn spread_last(x: Tensor<3>, n: usize) -> Tensor<3> {
    let [a, b, _] = x.dims();
    let inner = near_root(n);
    x.reshape([a, b, 1, 1]).expand([a, b, inner, n / inner]).reshape([a, b, n])
}

/// The largest divisor of `n` up to √n.
fn near_root(n: usize) -> usize {
    (1..=n.isqrt()).rev().find(|inner| n.is_multiple_of(*inner)).unwrap_or(1)
}

/// The mean of all values `[1]`, summed by [`sum_last`].
pub fn mean<const D: usize>(x: Tensor<D>) -> Tensor<1> {
    let count = x.dims().iter().product();
    sum_last(x.reshape([1, 1, count])).reshape([1]) / count as f64
}

/// The values on the host. There is no copy if the tensor is contiguous and has no other owner.
///
/// # Panics
/// If the values are not f32.
pub fn host<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_into_vec().expect("all tensors here are f32")
}
