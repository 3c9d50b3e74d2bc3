//! Photographs on their canvas → the input of the point predictor.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_splat::Camera;

use super::View;
use crate::config::Config;
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
            let device = parts[0].device();
            let of = |view| rays(config, view, window, &device).expand([count / 2, 2, height, width]);
            parts.push(Tensor::cat(vec![of(View::Front), of(View::Back)], 0));
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

/// Ray directions of a photograph's network pixels `[1, 2, h, w]`: x/z and y/z in the nominal camera's frame, with
/// the sign of x/z changed for the back.
fn rays(config: &Config, view: View, window: &Window, device: &Device) -> Tensor<4> {
    let camera = Camera::orbit_at_yaw_degrees(0.0, config.network.resolution as u32);
    let factor = config.upsample_factor();
    let (height, width) = (window.rows.len() / factor, window.columns.len() / factor);
    let middle = |start: usize, i: usize| start as f64 + (i as f64 + 0.5) * factor as f64;
    let sign = if view == View::Back { -1.0 } else { 1.0 };
    let x =
        |column| sign * (middle(window.columns.start, column) - camera.principal_point.x) / camera.focal.x;
    let y = |row| (middle(window.rows.start, row) - camera.principal_point.y) / camera.focal.y;
    let across = (0..height).flat_map(|_| (0..width).map(x));
    let down = (0..height).flat_map(|row| (0..width).map(move |_| y(row)));
    let values: Vec<f32> = across.chain(down).map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, [1, 2, height, width]), device)
}
