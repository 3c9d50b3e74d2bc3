//! Scores of rendered pictures.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use snapsnap_data::sample::Stage2Item;
use snapsnap_eval::EvalError;
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::{Region, margin};
use snapsnap_eval::similarity::{SquaredError, ssim_gaussian};
use snapsnap_ops::{host, mean};

use super::scene::targets;

/// Scores of pictures, as sums over samples.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(super) struct Scores {
    samples: f64,
    /// PSNR in dB of whole pictures, of the person with a margin, and of the person in the two sides; SSIM.
    sums: [f64; 4],
}

impl Scores {
    pub fn add(&mut self, item: &Stage2Item, image: Tensor<4>) -> Result<(), EvalError> {
        let (count, side) = (item.target_cameras.len(), item.target_side);
        let (target, _) = targets(item, &(0..count).collect::<Vec<_>>(), &image.device());
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
        let ssim = f64::from(host(mean(ssim_gaussian(image, target)))[0]);
        let scores = [full.psnr(), masked.psnr(), sides.psnr(), ssim];
        self.sums.iter_mut().zip(scores).for_each(|(sum, score)| *sum += score);
        Ok(())
    }

    /// Means over the samples of all sums.
    pub fn mean(all: &[Self]) -> [f64; 4] {
        let samples = all.iter().map(|scores| scores.samples).sum::<f64>();
        std::array::from_fn(|i| all.iter().map(|scores| scores.sums[i]).sum::<f64>() / samples)
    }
}
