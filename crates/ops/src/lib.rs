//! Operators that are slow on Burn's backends. Each operator is one function with two implementations: kernels with
//! their own gradients on Burn's `flex` device, and plain tensor code on every other device and in 16 bits. Tests
//! compare the two. [`gpu_convolution`] and [`gather`] have gradients for GPUs.

pub mod bf16;
mod buffers;
mod device;
pub mod fused;
pub mod gather;
pub mod gpu_convolution;
pub mod layers;
mod math;
mod mean_lengths;
mod multiply;
pub mod op;
mod operators;
pub mod orthogonal;
pub mod regressor;
mod resize;
mod rotary;
mod vectors;
mod winograd;

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;

use burn::tensor::Tensor;

pub use buffers::release_buffers;
pub use device::{as_weight, has_kernels, host, is_bf16, is_cpu};
pub use layers::linear_gelu;
pub use mean_lengths::mean_lengths;
pub use resize::bilinear;
pub use rotary::{Rope, rotary_attention, rotary_self_attention};

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
