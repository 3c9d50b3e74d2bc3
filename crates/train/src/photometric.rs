//! Stage 2: how far rendered pictures are from the true ones (SNAPSNAP §9.2).

use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Tensor, TensorData};

/// Side of the Gaussian window.
const WINDOW: usize = 11;
/// Its standard deviation in pixels.
const SIGMA: f64 = 1.5;
/// Constants of Wang et al. for values in [0, 1].
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

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
        let l1 = (image.clone() - target.clone()).abs().mean();
        Self { l1, ssim: ssim(image, target).mean() }
    }

    /// β·L1 + (1 − β)·(1 − SSIM).
    pub fn loss(&self, beta: f64) -> Tensor<1> {
        self.l1.clone() * beta + (1.0 - self.ssim.clone()) * (1.0 - beta)
    }
}

/// Peak signal-to-noise ratio in dB of pictures `[B,C,H,W]` with values in [0, 1], over the pixels where `mask` `[B,H,W]` is 1;
/// ∞ for equal ones.
pub fn psnr(image: Tensor<4>, target: Tensor<4>, mask: &Tensor<3>) -> f64 {
    let channels = image.dims()[1];
    // Values beyond what a picture can hold are no error: files and screens cut them.
    let squares = (image.clamp(0.0, 1.0) - target).square() * mask.clone().unsqueeze_dim::<4>(1);
    let sum = |x: Tensor<1>| f64::from(x.into_scalar::<f32>());
    let (error, count) = (sum(squares.sum()), sum(mask.clone().sum()));
    -10.0 * (error / (count * channels as f64)).log10()
}

/// Structural similarity of every pixel and channel, `[B,C,H,W]`: an 11×11 Gaussian window of σ = 1.5, beyond the border
/// zeros, population variances.
pub fn ssim(x: Tensor<4>, y: Tensor<4>) -> Tensor<4> {
    let mean = |t: Tensor<4>| blur(t);
    let (mx, my) = (mean(x.clone()), mean(y.clone()));
    let (mxx, myy, mxy) = (mx.clone().square(), my.clone().square(), mx * my);
    // E[x²] − E[x]² is negative by rounding where a picture is flat, and would carry the similarity above 1.
    let variance = |t: Tensor<4>, m: &Tensor<4>| (mean(t.square()) - m.clone()).clamp_min(0.0);
    let (vx, vy) = (variance(x.clone(), &mxx), variance(y.clone(), &myy));
    let covariance = mean(x * y) - mxy.clone();
    let numerator = (mxy * 2.0 + C1) * (covariance * 2.0 + C2);
    numerator / ((mxx + myy + C1) * (vx + vy + C2))
}

/// Gaussian means over the window, rows and columns one after the other.
fn blur(x: Tensor<4>) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let weight = |i: usize| {
        let d = i as f64 - (WINDOW / 2) as f64;
        (-d * d / (2.0 * SIGMA * SIGMA)).exp()
    };
    let sum: f64 = (0..WINDOW).map(weight).sum();
    let kernel: Vec<f32> = (0..WINDOW).map(|i| (weight(i) / sum) as f32).collect();
    let kernel = |shape: [usize; 4]| {
        Tensor::<4>::from_data(TensorData::new(kernel.clone(), shape), &x.device()).cast(x.dtype())
    };
    let (down, across) = (kernel([1, 1, WINDOW, 1]), kernel([1, 1, 1, WINDOW]));
    let half = WINDOW / 2;
    let planes = x.reshape([b * c, 1, h, w]);
    let rows = conv2d(planes, down, None, ConvOptions::new([1, 1], [half, 0], [1, 1], 1));
    conv2d(rows, across, None, ConvOptions::new([1, 1], [0, half], [1, 1], 1)).reshape([b, c, h, w])
}
