//! Changing the size of images and point maps.

use burn::tensor::module::{avg_pool2d, interpolate};
use burn::tensor::ops::{AvgPoolOptions, InterpolateMode, InterpolateOptions};
use burn::tensor::{Device, Tensor, TensorData};

use crate::config::Downsample;
use crate::cpu::{self, Tap};

/// Bilinear resize of `[B, C, H, W]` to `size` (rows, columns).
///
/// `align_corners`: the outermost samples coincide (inside the DPT head); otherwise pixel areas do (everything else).
/// Check values (SNAPSNAP §13.4): [0, 1] → [0, ⅓, ⅔, 1] and [0, ¼, ¾, 1].
pub fn bilinear(x: Tensor<4>, size: [usize; 2], align_corners: bool) -> Tensor<4> {
    let [_, _, h, w] = x.dims();
    if x.device().is_autodiff() {
        // Burn's own operator has no backward pass on GPUs; products with constant matrices have.
        let down = matrix(&taps(h, size[0], align_corners), h, &x.device());
        let across = matrix(&taps(w, size[1], align_corners), w, &x.device()).transpose();
        return down.unsqueeze().matmul(x).matmul(across.unsqueeze());
    }
    if cpu::is_fast(&x) {
        return cpu::bilinear(x, &taps(h, size[0], align_corners), &taps(w, size[1], align_corners));
    }
    let options = InterpolateOptions::new(InterpolateMode::Bilinear).with_align_corners(align_corners);
    interpolate(x, options.with_output_size(size))
}

/// Samples and weights of every target position along one axis.
fn taps(from: usize, to: usize, align_corners: bool) -> Vec<Tap> {
    let position = |i: usize| match align_corners {
        true if to > 1 => i as f64 * (from - 1) as f64 / (to - 1) as f64,
        true => 0.0,
        false => ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64),
    };
    let tap = |at: f64| {
        let low = (at as usize).min(from - 1);
        (low, (low + 1).min(from - 1), (at - low as f64) as f32)
    };
    (0..to).map(position).map(tap).collect()
}

/// The same as a matrix `[to, from]`.
fn matrix(taps: &[Tap], from: usize, device: &Device) -> Tensor<2> {
    let mut values = vec![0.0_f32; taps.len() * from];
    for (row, &(low, high, weight)) in values.chunks_exact_mut(from).zip(taps) {
        row[low] += 1.0 - weight;
        row[high] += weight;
    }
    Tensor::from_data(TensorData::new(values, [taps.len(), from]), device)
}

/// Shrinks `[B, C, H, W]` by the whole number `factor`.
pub fn shrink(x: Tensor<4>, factor: usize, method: Downsample) -> Tensor<4> {
    if factor == 1 {
        return x;
    }
    match method {
        Downsample::Area => {
            avg_pool2d(x, AvgPoolOptions::new([factor, factor]).with_stride([factor, factor]))
        }
        Downsample::Nearest => {
            let [b, c, h, w] = x.dims();
            let (h, w) = (h / factor, w / factor);
            x.reshape([b * c, h, factor, w * factor])
                .narrow(2, 0, 1)
                .reshape([b * c, h, w, factor])
                .narrow(3, 0, 1)
                .reshape([b, c, h, w])
        }
    }
}
