//! Changing the size of images and point maps.

use burn::tensor::module::{avg_pool2d, interpolate};
use burn::tensor::ops::{AvgPoolOptions, InterpolateMode, InterpolateOptions};
use burn::tensor::{Device, Tensor, TensorData};

use crate::config::Downsample;

/// Bilinear resize of `[B, C, H, W]` to `size` (rows, columns).
///
/// `align_corners`: the outermost samples coincide (inside the DPT head); otherwise pixel areas do (everything else).
/// Check values (SNAPSNAP §13.4): [0, 1] → [0, ⅓, ⅔, 1] and [0, ¼, ¾, 1].
pub fn bilinear(x: Tensor<4>, size: [usize; 2], align_corners: bool) -> Tensor<4> {
    if x.device().is_autodiff() {
        return bilinear_by_products(x, size, align_corners);
    }
    let options = InterpolateOptions::new(InterpolateMode::Bilinear).with_align_corners(align_corners);
    interpolate(x, options.with_output_size(size))
}

/// The same as two products with constant matrices: Burn's own operator has no backward pass on GPUs.
fn bilinear_by_products(x: Tensor<4>, [rows, columns]: [usize; 2], align_corners: bool) -> Tensor<4> {
    let [_, _, h, w] = x.dims();
    let device = x.device();
    let down = weights(h, rows, align_corners, &device).unsqueeze();
    let across = weights(w, columns, align_corners, &device).transpose().unsqueeze();
    down.matmul(x).matmul(across)
}

/// Interpolation weights `[to, from]` along one axis.
fn weights(from: usize, to: usize, align_corners: bool, device: &Device) -> Tensor<2> {
    let mut values = vec![0.0_f32; to * from];
    for i in 0..to {
        let position = if align_corners {
            if to > 1 { i as f64 * (from - 1) as f64 / (to - 1) as f64 } else { 0.0 }
        } else {
            ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64)
        };
        let low = (position.floor() as usize).min(from - 1);
        let high = (low + 1).min(from - 1);
        let fraction = (position - low as f64) as f32;
        values[i * from + low] += 1.0 - fraction;
        values[i * from + high] += fraction;
    }
    Tensor::from_data(TensorData::new(values, [to, from]), device)
}

/// Shrinks `[B, C, H, W]` by the whole number `factor`.
pub fn shrink(x: Tensor<4>, factor: usize, method: Downsample) -> Tensor<4> {
    if factor == 1 {
        return x;
    }
    match method {
        Downsample::Area => avg_pool2d(x, AvgPoolOptions::new([factor, factor]).with_stride([factor, factor])),
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
