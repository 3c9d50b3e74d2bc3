//! Stage 2: the difference of rendered and true pictures (docs/method.md, "Losses of stage 2").

use burn::tensor::Tensor;
use snapsnap_eval::similarity::ssim_gaussian;
use snapsnap_ops::mean;

/// The parts of the loss, each `[1]`.
#[derive(Debug, Clone)]
pub struct Photometric {
    /// Mean absolute difference.
    pub l1: Tensor<1>,
    /// Mean structural similarity.
    pub ssim: Tensor<1>,
}

impl Photometric {
    /// Compares pictures `[B,C,H,W]` with values in [0, 1].
    pub fn new(image: Tensor<4>, target: Tensor<4>) -> Self {
        let l1 = mean((image.clone() - target.clone()).abs());
        Self { l1, ssim: mean(ssim_gaussian(image, target)) }
    }

    /// β·L1 + (1 − β)·(1 − SSIM).
    pub fn loss(&self, beta: f64) -> Tensor<1> {
        self.l1.clone() * beta + (1.0 - self.ssim.clone()) * (1.0 - beta)
    }
}
