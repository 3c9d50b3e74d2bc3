//! Scores of rendered pictures.

use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use snapsnap_data::sample::Stage2Item;
use snapsnap_eval::EvalError;
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::{Region, margin};
use snapsnap_eval::similarity::SquaredError;
use snapsnap_ops::host;

use super::scene::targets;
use crate::photometric::Photometric;

/// Scores of pictures, as sums or means over samples.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(super) struct Scores {
    samples: f64,
    /// PSNR in dB of whole pictures, of the person with a margin, and of the person in the two sides.
    pub full: f64,
    pub masked: f64,
    pub sides: f64,
    pub ssim: f64,
}

impl Scores {
    pub fn add(&mut self, item: &Stage2Item, image: Tensor<4>, device: &Device) -> Result<(), EvalError> {
        let (count, side) = (item.target_cameras.len(), item.target_side);
        let (target, _) = targets(item, &(0..count).collect::<Vec<_>>(), device);
        // Files and screens clamp values outside [0, 1].
        let shown = host(image.clone().clamp(0.0, 1.0));
        let [mut full, mut masked, mut sides] = [SquaredError::default(); 3];
        for view in 0..count {
            let size = [side, side];
            let of = |values: &[f32]| values[3 * view * side * side..3 * (view + 1) * side * side].to_vec();
            let shown = Picture::new(of(&shown), size, "render")?;
            let truth = Picture::new(of(&item.targets), size, "target")?;
            full.add(&shown, &truth, &Region::all(&truth))?;
            let mask = &item.target_masks[view * side * side..(view + 1) * side * side];
            // A view without a person.
            let Ok(person) = Region::masked(mask, size, margin(side)) else { continue };
            masked.add(&shown, &truth, &person)?;
            // The sides are the last views.
            if view >= count - 2 {
                sides.add(&shown, &truth, &person)?;
            }
        }
        self.samples += 1.0;
        self.full += full.psnr();
        self.masked += masked.psnr();
        self.sides += sides.psnr();
        self.ssim += f64::from(host(Photometric::new(image, target).ssim)[0]);
        Ok(())
    }

    /// Means over the samples of all sums.
    pub fn mean(all: &[Self]) -> Self {
        let sum = |of: fn(&Self) -> f64| all.iter().map(of).sum::<f64>();
        let samples = sum(|scores| scores.samples);
        let mean = |of| sum(of) / samples;
        Self {
            samples: 1.0,
            full: mean(|scores| scores.full),
            masked: mean(|scores| scores.masked),
            sides: mean(|scores| scores.sides),
            ssim: mean(|scores| scores.ssim),
        }
    }
}
