//! Layers of the networks as functions of Burn's modules: kernels with their own gradients on `flex`, Burn's operators
//! on all other devices.
//!
//! Where gradients are computed on a GPU, parameters are expanded before they are added or multiplied. The gradient of
//! `expand` sums one dimension after the other. Burn's broadcasting sums all dimensions at once, with one thread per
//! parameter.

use std::f64::consts::FRAC_1_SQRT_2;

use burn::module::Param;
use burn::nn;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::activation::{gelu, relu};
use burn::tensor::{FloatDType, Tensor};

use crate::device::{has_kernels, in_f32, is_bf16, is_tracked_on_gpu};
use crate::gpu_convolution::convolve;
use crate::op::{self, Kernel};
use crate::operators::{Convolution, LayerNorm, Linear};

/// A linear layer: `[B, N, inputs]` → `[B, N, outputs]`.
pub fn linear(layer: &nn::Linear, x: Tensor<3>) -> Tensor<3> {
    if is_tracked_on_gpu(&x) {
        let y = burn::tensor::module::linear(x, layer.weight.val(), None);
        return match bias(&layer.bias) {
            Some(bias) => y.clone() + bias.unsqueeze::<3>().expand(y.dims()),
            None => y,
        };
    }
    if !has_kernels(&x) {
        return layer.forward(x);
    }
    linear_on_flex(layer, x, false)
}

/// A linear layer followed by GELU (erf form): `[B, N, inputs]` → `[B, N, outputs]`.
pub fn linear_gelu(layer: &nn::Linear, x: Tensor<3>) -> Tensor<3> {
    if has_kernels(&x) {
        return linear_on_flex(layer, x, true);
    }
    let has_gradient = x.device().is_autodiff();
    let x = layer.forward(x);
    if has_gradient {
        // On all backends but flex, Burn's GELU has the gradient of the approximation by tanh, which is 4e-4 off.
        return x.clone() * ((x * FRAC_1_SQRT_2).erf() + 1.0) * 0.5;
    }
    gelu(x)
}

fn linear_on_flex(layer: &nn::Linear, x: Tensor<3>, gelu: bool) -> Tensor<3> {
    let ([b, n, _], [inputs, outputs], in_bf16) = (x.dims(), layer.weight.dims(), is_bf16(&layer.weight));
    let sizes = Linear { rows: b * n, inputs, outputs, transposed: false, in_bf16, gelu };
    run(sizes, [b, n, outputs], x, layer.weight.val(), bias(&layer.bias))
}

/// Layer normalisation of tokens `[B, N, C]`. `epsilon` must be the layer's own value, which Burn keeps private.
pub fn layer_norm(layer: &nn::LayerNorm, epsilon: f64, x: Tensor<3>) -> Tensor<3> {
    let (weight, shape) = (layer.gamma.val(), x.dims());
    if let Some(bias) = layer.beta.as_ref().filter(|_| is_tracked_on_gpu(&x)) {
        let affine = [weight, bias.val()].map(|parameter| parameter.unsqueeze::<3>().expand(shape));
        return in_f32(x, |x| normalised(x, epsilon, affine));
    }
    // Without gradients, the results equal the results of Burn's operator.
    let is_tracked = x.device().is_autodiff() && has_kernels(&x);
    let Some(bias) = layer.beta.as_ref().filter(|_| is_tracked) else {
        return in_f32(x, |x| layer.forward(x));
    };
    let sizes = LayerNorm { channels: shape[2], epsilon: epsilon as f32 };
    run(sizes, shape, x, weight, Some(bias.val()))
}

fn normalised(x: Tensor<3>, epsilon: f64, [weight, bias]: [Tensor<3>; 2]) -> Tensor<3> {
    let centred = x.clone() - x.mean_dim(2);
    let variance = centred.clone().square().mean_dim(2);
    centred / (variance + epsilon).sqrt() * weight + bias
}

/// A convolution of images `[B, C, H, W]`; with `rectified`, a convolution of max(x, 0). A layer without dilation and
/// groups must have a padding of half a kernel.
pub fn conv2d(layer: &Conv2d, x: Tensor<4>, rectified: bool) -> Tensor<4> {
    let ([batch, inputs, height, width], [outputs, _, rows, columns]) = (x.dims(), layer.weight.dims());
    let (weight, bias) = (layer.weight.val(), bias(&layer.bias));
    let in_bf16 = is_bf16(&layer.weight);
    let is_plain = layer.groups == 1 && layer.dilation == [1, 1];
    let [down, across] = layer.stride;
    if is_plain && rows == columns && rows % 2 == 1 && down == across && is_tracked_on_gpu(&x) {
        let dtype = x.dtype();
        let x = if rectified { relu(x) } else { x };
        let y = convolve(x.cast(weight.dtype()), weight, down);
        return match bias {
            Some(bias) => y.clone() + bias.reshape([1, outputs, 1, 1]).expand(y.dims()),
            None => y,
        }
        .cast(dtype);
    }
    let is_known = matches!(([rows, columns], layer.stride), ([3, 3], [1, 1] | [2, 2]) | ([1, 1], [1, 1]));
    if is_plain && is_known && has_kernels(&x) {
        let (side, stride) = (rows, down);
        let shape = [batch, outputs, height.div_ceil(stride), width.div_ceil(stride)];
        let sizes = Convolution { batch, inputs, outputs, height, width, side, stride, rectified, in_bf16 };
        return run(sizes, shape, x, weight, bias);
    }
    let dtype = x.dtype();
    layer.forward(if rectified { relu(x) } else { x }.cast(weight.dtype())).cast(dtype)
}

/// A transposed convolution whose kernel is as large as its stride: `[B, C, H, W]` → `[B, D, stride·H, stride·W]`. The
/// squares of two pixels do not overlap, so a 1×1 convolution to `[B, D · stride · stride, H, W]` and a rearrangement
/// of its result are equivalent.
pub fn enlarge(layer: &ConvTranspose2d, x: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&x) {
        return layer.forward(x);
    }
    let ([batch, inputs, height, width], [_, outputs, s, _]) = (x.dims(), layer.weight.dims());
    assert_eq!(layer.stride, [s; 2], "the kernel is as large as the stride");
    let squares = outputs * s * s;
    let weight: Tensor<2> = layer.weight.val().reshape([inputs, squares]).transpose();
    let bias =
        layer.bias.as_ref().map(|bias| bias.val().reshape([outputs, 1]).repeat_dim(1, s * s).flatten(0, 1));
    let (side, stride, rectified, in_bf16) = (1, 1, false, is_bf16(&layer.weight));
    let sizes =
        Convolution { batch, inputs, outputs: squares, height, width, side, stride, rectified, in_bf16 };
    let enlarged = run(sizes, [batch, outputs, s, s, height, width], x, weight, bias);
    enlarged.permute([0, 1, 4, 2, 5, 3]).reshape([batch, outputs, s * height, s * width])
}

/// A convolution whose kernel is as large as its stride: images `[B, C, H, W]` → tokens `[B, H/side · W/side, D]`,
/// row-major.
pub fn patches(layer: &Conv2d, x: Tensor<4>) -> Tensor<3> {
    if !has_kernels(&x) {
        return layer.forward(x).flatten::<3>(2, 3).swap_dims(1, 2);
    }
    let ([batch, channels, height, width], [outputs, _, side, _]) = (x.dims(), layer.weight.dims());
    assert_eq!(layer.stride, [side; 2], "the kernel is as large as the stride");
    let (rows, columns, inputs) = (height / side, width / side, channels * side * side);
    let patches = x.reshape([batch, channels, rows, side, columns, side]).permute([0, 2, 4, 1, 3, 5]);
    let in_bf16 = is_bf16(&layer.weight);
    let sizes =
        Linear { rows: batch * rows * columns, inputs, outputs, transposed: true, in_bf16, gelu: false };
    let x: Tensor<2> = patches.reshape([sizes.rows, inputs]);
    run(sizes, [batch, rows * columns, outputs], x, layer.weight.val(), bias(&layer.bias))
}

fn bias(bias: &Option<Param<Tensor<1>>>) -> Option<Tensor<1>> {
    bias.as_ref().map(Param::val)
}

fn run<const A: usize, const W: usize, const D: usize>(
    layer: impl Kernel,
    shape: [usize; D],
    x: Tensor<A>,
    weight: Tensor<W>,
    bias: Option<Tensor<1>>,
) -> Tensor<D> {
    // Kernels read f32 and round the factors themselves.
    let (weight, bias) = (weight.cast(FloatDType::F32), bias.map(|bias| bias.cast(FloatDType::F32)));
    op::run(layer, shape, x, Some(weight), bias)
}
