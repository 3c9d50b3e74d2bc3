//! How like the truth rendered pictures are.

use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use snapsnap_data::sample::Stage2Item;
use snapsnap_ops::host;

use super::scene::targets;
use crate::photometric::{Photometric, psnr};

/// How like the truth pictures are, summed or averaged over samples.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Scores {
    samples: f64,
    /// dB, over whole pictures, where the person is and a little around it, and there in the two sides alone.
    pub full: f64,
    pub masked: f64,
    pub sides: f64,
    pub ssim: f64,
}

/// 1 where masks `[V,h,w]` are not 0, and 8 pixels of 1024 around it (EVALUATION.md, protocol `masked`).
fn around(mask: Tensor<3>) -> Tensor<3> {
    let reach = (8 * mask.dims()[2]).div_ceil(1024);
    let inside = mask.greater_elem(0.0).float().unsqueeze_dim(1);
    let side = 2 * reach + 1;
    let options = MaxPoolOptions::new([side, side]).with_stride([1, 1]).with_padding([reach, reach]);
    max_pool2d(inside, options).squeeze_dim(1)
}

impl Scores {
    pub fn add(&mut self, item: &Stage2Item, image: Tensor<4>, device: &Device) {
        let count = item.target_cameras.len();
        let (target, mask) = targets(item, &(0..count).collect::<Vec<_>>(), device);
        let inside = around(mask.clone());
        let there = |from: usize| {
            let part = |x: &Tensor<4>| x.clone().narrow(0, from, count - from);
            psnr(part(&image), part(&target), &inside.clone().narrow(0, from, count - from))
        };
        self.samples += 1.0;
        self.masked += there(0);
        // The sides' views are the last ones.
        self.sides += there(count - 2);
        self.full += psnr(image.clone(), target.clone(), &mask.ones_like());
        self.ssim += f64::from(host(Photometric::new(image, target).ssim)[0]);
    }

    pub fn mean(self) -> Self {
        let mean = |sum: f64| sum / self.samples;
        Self {
            samples: 1.0,
            full: mean(self.full),
            masked: mean(self.masked),
            sides: mean(self.sides),
            ssim: mean(self.ssim),
        }
    }
}
