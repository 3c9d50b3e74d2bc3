//! All metrics of a picture and the true one.

use burn::tensor::Device;
use burn::tensor::ops::PadMode;
use serde::Serialize;

use crate::EvalError;
use crate::lpips::{Lpips, MIN_SIDE};
use crate::pictures::Picture;
use crate::region::Region;
use crate::similarity::{psnr, ssim};
use crate::statistics::number;

/// What is reported of a view, or means of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Score {
    /// dB; ∞ for equal pictures.
    #[serde(with = "number")]
    pub psnr: f64,
    /// Absent where the region holds no whole window.
    #[serde(with = "number::optional")]
    pub ssim: Option<f64>,
    /// Absent without weights, and where a window is too small for the network.
    #[serde(with = "number::optional")]
    pub lpips: Option<f64>,
}

impl Score {
    /// Compares an image with the true one where `region` says. LPIPS sees the region's box, black where the region's mask is
    /// not set, in both, and on to the network's least size.
    ///
    /// # Errors
    /// [`EvalError::Sizes`].
    pub fn new(
        image: &Picture,
        target: &Picture,
        region: &Region,
        lpips: Option<&Lpips>,
    ) -> Result<Self, EvalError> {
        let (psnr, ssim) = (psnr(image, target, region)?, ssim(image, target, region)?);
        let seen = |picture: &Picture| {
            let part = picture.cropped(region.window);
            match &region.inside {
                Some(inside) => part.only(inside),
                None => part,
            }
        };
        let [.., width, height] = region.window;
        // Black around a mask may as well go on to the network's least size.
        let short = [width, height].map(|side| MIN_SIDE.saturating_sub(side));
        let lpips = lpips.filter(|_| short == [0, 0] || region.inside.is_some()).map(|network| {
            let device: &Device = &network.device();
            let tensor = |picture| {
                seen(picture).tensor(device).pad((0, short[0], 0, short[1]), PadMode::Constant(0.0))
            };
            let distance = network.distance(tensor(image), tensor(target));
            f64::from(snapsnap_ops::host(distance)[0])
        });
        Ok(Self { psnr, ssim, lpips })
    }

    /// Means, of the figures that all have; `None` without any.
    pub fn mean(scores: &[Self]) -> Option<Self> {
        let n = scores.len() as f64;
        let all =
            |of: fn(&Self) -> Option<f64>| scores.iter().map(of).sum::<Option<f64>>().map(|sum| sum / n);
        (!scores.is_empty()).then(|| Self {
            psnr: scores.iter().map(|score| score.psnr).sum::<f64>() / n,
            ssim: all(|score| score.ssim),
            lpips: all(|score| score.lpips),
        })
    }
}
