//! All metrics of a picture and its ground truth.

use burn::tensor::ops::PadMode;
use serde::{Deserialize, Serialize};

use crate::Result;
use crate::lpips::{Lpips, MIN_SIDE};
use crate::pictures::Picture;
use crate::region::Region;
use crate::similarity::{psnr, ssim};
use crate::statistics::mean;

/// Metrics of a view, or their means.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Score {
    /// dB; ∞ for equal pictures.
    #[serde(with = "crate::statistics::number")]
    pub psnr: f64,
    /// Absent if the region contains no whole window.
    pub ssim: Option<f64>,
    /// Absent without weights, and for windows that are too small for the network.
    pub lpips: Option<f64>,
}

impl Score {
    /// Compares an image with the ground truth in a region. LPIPS compares the region's box, with black pixels outside
    /// a mask. The box of a mask that is smaller than [`MIN_SIDE`] is padded with black.
    ///
    /// # Errors
    /// [`EvalError::Message`](crate::EvalError::Message) if the sizes differ.
    pub fn new(image: &Picture, target: &Picture, region: &Region, lpips: Option<&Lpips>) -> Result<Self> {
        let (psnr, ssim) = (psnr(image, target, region)?, ssim(image, target, region)?);
        let [.., width, height] = region.window;
        let short = [width, height].map(|side| MIN_SIDE.saturating_sub(side));
        let lpips = lpips.filter(|_| short == [0, 0] || region.inside.is_some()).map(|network| {
            let tensor = |picture: &Picture| {
                let part = picture.within(region).tensor(&network.device());
                part.pad((0, short[0], 0, short[1]), PadMode::Constant(0.0))
            };
            let distance = network.distance(tensor(image), tensor(target));
            f64::from(snapsnap_ops::host(distance)[0])
        });
        Ok(Self { psnr, ssim, lpips })
    }

    /// Means of the figures that all scores have; `None` without scores.
    pub fn mean(scores: &[Self]) -> Option<Self> {
        let over = |of: fn(&Self) -> Option<f64>| mean(&scores.iter().map(of).collect::<Option<Vec<_>>>()?);
        Some(Self { psnr: over(|s| Some(s.psnr))?, ssim: over(|s| s.ssim), lpips: over(|s| s.lpips) })
    }
}
