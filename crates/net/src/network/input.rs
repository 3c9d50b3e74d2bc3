//! Photographs on their canvas → the input of the point predictor.

use burn::tensor::Tensor;

use super::View;
use super::rays::Rays;
use crate::config::{Config, OPPOSITE};
use crate::resample::shrink;
use crate::window::Window;

/// Input of the point predictor: B pairs of photographs.
#[derive(Debug, Clone)]
pub struct Input {
    /// `[2·B, C, h, w]`, all fronts, then all backs: colours in [−1, 1] times the mask, then the config's further
    /// channels. With `network.both_ways`, the fronts and the backs are each followed by their mirror images.
    pub images: Tensor<4>,
    /// Rows and columns of the transformer's tokens of an image.
    pub grid: [usize; 2],
}

impl Input {
    /// The input for the `window` of photographs `[2·B, 3, S, S]` on their canvases, all fronts, then all backs, and
    /// of their masks `[2·B, 1, S, S]`.
    pub fn new(config: &Config, photographs: Tensor<4>, masks: Tensor<4>, window: &Window) -> Self {
        let n = &config.network;
        let small = |x: Tensor<4>| {
            let small = shrink(window.cut(x), config.upsample_factor(), config.downsample());
            if n.both_ways { both_ways(small) } else { small }
        };
        let mut parts = vec![small(photographs)];
        if n.mask_channel {
            parts.push(small(masks));
        }
        let [count, _, height, width] = parts[0].dims();
        if n.ray_channels {
            // x/z and y/z in the nominal camera's frame, with the sign of x/z changed for the back.
            let (factor, device) = (config.upsample_factor(), parts[0].device());
            let (side, window) = (n.resolution / factor, window.shrunk(factor));
            let rays = Rays::new(View::Front, OPPOSITE, side, &window, &device).directions;
            let rays = rays.narrow(3, 0, 2).permute([0, 3, 1, 2]).expand([count / 2, 2, height, width]);
            let back = Tensor::cat(vec![-rays.clone().narrow(1, 0, 1), rays.clone().narrow(1, 1, 1)], 1);
            parts.push(Tensor::cat(vec![rays, back], 0));
        }
        let images = if parts.len() > 1 { Tensor::cat(parts, 1) } else { parts.remove(0) };
        let seen = |x: Tensor<4>| if n.mirror { mirrored_backs(x) } else { x };
        Self { images: seen(images), grid: [height / n.patch, width / n.patch] }
    }
}

/// Appends the mirror images of each half of a batch to the half.
fn both_ways(x: Tensor<4>) -> Tensor<4> {
    let half = x.dims()[0] / 2;
    let halves = [0, half].map(|from| x.clone().narrow(0, from, half));
    Tensor::cat(halves.into_iter().flat_map(|x| [x.clone(), x.flip([3])]).collect(), 0)
}

/// Flips the second half of a batch.
fn mirrored_backs(x: Tensor<4>) -> Tensor<4> {
    let half = x.dims()[0] / 2;
    Tensor::cat(vec![x.clone().narrow(0, 0, half), x.narrow(0, half, half).flip([3])], 0)
}
