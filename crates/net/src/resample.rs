//! Shrinking of photographs to the network's resolution.

use burn::tensor::Tensor;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;

use crate::config::Downsample;

/// Shrinks `[B, C, H, W]` by `factor`, a divisor of H and W.
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
            let cells = x.reshape([b, c, h, factor, w, factor]);
            cells.narrow(3, 0, 1).narrow(5, 0, 1).reshape([b, c, h, w])
        }
    }
}
