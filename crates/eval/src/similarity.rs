//! PSNR and SSIM of two pictures (docs/method.md, "Evaluation").

use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;

use crate::pictures::Picture;
use crate::region::Region;
use crate::{EvalError, Result};

/// Side of the protocol's uniform window: scikit-image's default.
const UNIFORM: usize = 7;
/// Side of the loss's Gaussian window.
const GAUSSIAN: usize = 11;
/// Standard deviation of the Gaussian window in pixels.
const SIGMA: f64 = 1.5;
/// Constants of Wang et al. 2004 for values in [0, 1]: (0.01)² and (0.03)².
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Squared differences of pictures, summed over pixels and channels.
#[derive(Debug, Clone, Copy, Default)]
pub struct SquaredError {
    sum: f64,
    count: usize,
}

impl SquaredError {
    /// Adds the differences of two pictures in a region.
    ///
    /// # Errors
    /// [`EvalError::Message`] if the sizes differ.
    pub fn add(&mut self, image: &Picture, target: &Picture, region: &Region) -> Result<()> {
        check_sizes(image, target)?;
        let [x, y, width, height] = region.window;
        for (channel, row) in (0..3).flat_map(|channel| (y..y + height).map(move |row| (channel, row))) {
            let [a, b] = [image, target].map(|picture| &picture.plane(channel)[row * picture.width..]);
            let counted = (x..x + width).filter(|column| region.counts(*column, row));
            self.sum += counted.map(|i| (f64::from(a[i]) - f64::from(b[i])).powi(2)).sum::<f64>();
        }
        self.count += 3 * region.pixels();
        Ok(())
    }

    /// Peak signal-to-noise ratio in dB for a peak of 1; ∞ for equal pictures.
    pub fn psnr(self) -> f64 {
        -10.0 * (self.sum / self.count as f64).log10()
    }
}

/// Peak signal-to-noise ratio in dB over the pixels of a region and the three channels, for a peak of 1; ∞ for equal
/// pictures.
///
/// # Errors
/// [`EvalError::Message`] if the sizes differ.
pub fn psnr(image: &Picture, target: &Picture, region: &Region) -> Result<f64> {
    let mut error = SquaredError::default();
    error.add(image, target, region)?;
    Ok(error.psnr())
}

/// Checks that two pictures have one size.
///
/// # Errors
/// [`EvalError::Message`] if the sizes differ.
pub fn check_sizes(image: &Picture, target: &Picture) -> Result<()> {
    let size = |p: &Picture| format!("{}×{}", p.width, p.height);
    if size(image) == size(target) {
        return Ok(());
    }
    Err(EvalError::new(format!("the sizes differ: {} and {}", size(image), size(target))))
}

/// Structural similarity as scikit-image's `structural_similarity` computes it by default for values in [0, 1]:
/// uniform window of 7 × 7 pixels, sample covariances (N − 1), mean over pixels and channels. Without a mask, the
/// region is cropped first, and pixels whose window extends beyond the crop are left out. With a mask, windows may
/// extend beyond the mask. `None` if no pixel is left.
///
/// # Errors
/// [`EvalError::Message`] if the sizes differ.
pub fn ssim(image: &Picture, target: &Picture, region: &Region) -> Result<Option<f64>> {
    check_sizes(image, target)?;
    let [x, y, w, h] = region.window;
    let around = if region.inside.is_some() { UNIFORM / 2 } else { 0 };
    let [left, top] = [x.saturating_sub(around), y.saturating_sub(around)];
    let [right, bottom] = [(x + w + around).min(image.width), (y + h + around).min(image.height)];
    let (width, height) = (right - left, bottom - top);
    if width.min(height) < UNIFORM {
        return Ok(None);
    }
    let [image, target] = [image, target].map(|picture| picture.cropped([left, top, width, height]));
    let count = (UNIFORM * UNIFORM) as f64;
    let weights = vec![1.0 / UNIFORM as f64; UNIFORM];
    let window = Window { weights, correction: count / (count - 1.0), padded: false };
    Ok(mean_in_region(&image, &target, [left, top], region, &window))
}

/// [`ssim_gaussian`] of two pictures, computed in f64, mean over the pixels of a region and the channels.
///
/// # Errors
/// [`EvalError::Message`] if the sizes differ.
pub fn ssim_of_loss(image: &Picture, target: &Picture, region: &Region) -> Result<f64> {
    check_sizes(image, target)?;
    let window = Window { weights: gaussian(), correction: 1.0, padded: true };
    Ok(mean_in_region(image, target, [0, 0], region, &window).unwrap_or(f64::NAN))
}

/// Mean similarity over the channels and over the pixels of a region, for crops of two pictures that begin at column
/// `left` and row `top`. `None` if the crops contain no pixel of the region.
fn mean_in_region(
    image: &Picture,
    target: &Picture,
    [left, top]: [usize; 2],
    region: &Region,
    window: &Window,
) -> Option<f64> {
    let border = if window.padded { 0 } else { window.weights.len() / 2 };
    let size @ [height, _] = [image.height, image.width];
    let [_, y, _, h] = region.window;
    let rows = border.max(y - top)..(height - border).min(y + h - top);
    let lines = (0..3).flat_map(|c| rows.clone().map(move |row| (c, row)));
    let line = |(c, row): (usize, usize)| -> [f64; 2] {
        let similarities = line_of(image.plane(c), target.plane(c), size, row, window);
        let counts = |column: usize| region.counts(left + border + column, top + row);
        let counted = similarities.into_iter().enumerate().filter(|(column, _)| counts(*column));
        counted.fold([0.0; 2], |[sum, count], (_, s)| [sum + s, count + 1.0])
    };
    // Sums in the order of the rows do not depend on the number of threads.
    let sums: Vec<[f64; 2]> = lines.collect::<Vec<_>>().into_par_iter().map(line).collect();
    let [sum, count] = sums.iter().fold([0.0; 2], |[a, b], [c, d]| [a + c, b + d]);
    (count > 0.0).then(|| sum / count)
}

/// A window around a pixel.
struct Window {
    /// Weights along rows and along columns, with a sum of 1.
    weights: Vec<f64>,
    /// Factor of variances and covariances.
    correction: f64,
    /// Whether the picture is padded with zeros. Otherwise pixels whose window extends beyond it are left out.
    padded: bool,
}

/// Similarities of the pixels of row `y` of two planes `[H, W]`.
fn line_of(a: &[f32], b: &[f32], [height, width]: [usize; 2], y: usize, window: &Window) -> Vec<f64> {
    let Window { weights, correction, padded } = window;
    let half = weights.len() / 2;
    let border = if *padded { half } else { 0 };
    // Means over the window's rows, column by column: a, b, a², b², a·b.
    let mut columns = vec![[0.0_f64; 5]; width + 2 * border];
    for (weight, row) in weights.iter().zip(y as isize - half as isize..) {
        let Some(row) = usize::try_from(row).ok().filter(|row| *row < height) else { continue };
        let lines = a[row * width..][..width].iter().zip(&b[row * width..][..width]);
        for (sums, (a, b)) in columns[border..].iter_mut().zip(lines) {
            let (a, b) = (f64::from(*a), f64::from(*b));
            [a, b, a * a, b * b, a * b].iter().zip(sums).for_each(|(v, sum)| *sum += weight * v);
        }
    }
    let similarity = |columns: &[[f64; 5]]| {
        let mut means = [0.0; 5];
        for (weight, column) in weights.iter().zip(columns) {
            means.iter_mut().zip(column).for_each(|(mean, v)| *mean += weight * v);
        }
        let [ma, mb, maa, mbb, mab] = means;
        // E[a²] − E[a]² is negative by rounding where a picture is flat.
        let (va, vb) = ((maa - ma * ma).max(0.0), (mbb - mb * mb).max(0.0));
        let most = (va * vb).sqrt();
        let (va, vb) = (correction * va, correction * vb);
        let vab = correction * (mab - ma * mb).clamp(-most, most);
        let similarity =
            ((2.0 * ma * mb + C1) * (2.0 * vab + C2)) / ((ma * ma + mb * mb + C1) * (va + vb + C2));
        // By rounding, the similarity of equal pictures can exceed 1.
        similarity.min(1.0)
    };
    columns.windows(weights.len()).map(similarity).collect()
}

/// Structural similarity `[B,C,H,W]` of every pixel and channel of pictures `[B,C,H,W]` with values in [0, 1], for the
/// loss of stage 2: an 11×11 Gaussian window of σ = 1.5, zero padding, population variances. Differentiable.
pub fn ssim_gaussian(x: Tensor<4>, y: Tensor<4>) -> Tensor<4> {
    let (mx, my) = (blur(x.clone()), blur(y.clone()));
    let (mxx, myy, mxy) = (mx.clone().square(), my.clone().square(), mx * my);
    // E[x²] − E[x]² is negative by rounding where a picture is flat. The similarity would exceed 1.
    let variance = |t: Tensor<4>, m: &Tensor<4>| (blur(t.square()) - m.clone()).clamp_min(0.0);
    let (vx, vy) = (variance(x.clone(), &mxx), variance(y.clone(), &myy));
    let covariance = blur(x * y) - mxy.clone();
    let numerator = (mxy * 2.0 + C1) * (covariance * 2.0 + C2);
    numerator / ((mxx + myy + C1) * (vx + vy + C2))
}

/// Separable Gaussian blur: down the columns, then along the rows.
fn blur(x: Tensor<4>) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let kernel: Vec<f32> = gaussian().into_iter().map(|weight| weight as f32).collect();
    let kernel = |shape: [usize; 4]| {
        Tensor::<4>::from_data(TensorData::new(kernel.clone(), shape), &x.device()).cast(x.dtype())
    };
    let (down, across) = (kernel([1, 1, GAUSSIAN, 1]), kernel([1, 1, 1, GAUSSIAN]));
    let half = GAUSSIAN / 2;
    let planes = x.reshape([b * c, 1, h, w]);
    let rows = conv2d(planes, down, None, ConvOptions::new([1, 1], [half, 0], [1, 1], 1));
    conv2d(rows, across, None, ConvOptions::new([1, 1], [0, half], [1, 1], 1)).reshape([b, c, h, w])
}

/// Weights of the Gaussian window, with a sum of 1.
fn gaussian() -> Vec<f64> {
    let weight = |i: usize| {
        let d = i as f64 - (GAUSSIAN / 2) as f64;
        (-d * d / (2.0 * SIGMA * SIGMA)).exp()
    };
    let sum: f64 = (0..GAUSSIAN).map(weight).sum();
    (0..GAUSSIAN).map(|i| weight(i) / sum).collect()
}
