//! A second look at the photographs (docs/method.md, "Details"): a U-shaped network, which sees them larger than the
//! predictor does, moves their points along their rays. It has no attention, so that a pixel's result depends on its
//! surroundings alone.

use burn::module::Module;
use burn::tensor::{Device, Tensor};

use super::View;
use super::predictor::PointMap;
use super::rays::Rays;
use super::unet::{UNet, UNetSizes};
use crate::config::{DetailsConfig, OPPOSITE};
use crate::window::Window;

/// Channels of the input: colours, mask, distance of the points from the plane through the body's axis, the other
/// photograph's distance and mask at the same place of the body, front or back, and the place on the plane.
const INPUTS: usize = 3 + 1 + 1 + 2 + 1 + 2;
/// Channels of the features before the last layer.
const LAST_DIM: usize = 16;

/// The network of details.
#[derive(Module, Debug)]
pub(super) struct Details {
    body: UNet,
    #[module(skip)]
    pub(super) resolution: usize,
}

impl Details {
    pub(super) fn new(config: &DetailsConfig, device: &Device) -> Self {
        let sizes = UNetSizes {
            inputs: INPUTS,
            outputs: 1,
            widths: config.dims,
            blocks: [config.dims[3], 0, 1],
            stride: 1,
            last_dim: LAST_DIM,
        };
        Self { body: UNet::new(&sizes, device), resolution: config.resolution }
    }

    /// Movements along the rays `[N, 1, h, w]`, in network units.
    pub(super) fn relief(&self, images: Tensor<4>) -> Tensor<4> {
        let levels = self.body.encode(images, None);
        self.body.decoder.out(self.body.features(&levels))
    }
}

/// What the network of details sees of both photographs.
pub struct SecondLook {
    /// `[2·B, INPUTS, h, w]`, all fronts, then all backs.
    pub images: Tensor<4>,
    /// Enlarged maps of front and back, in network units and without anchors.
    pub maps: [PointMap; 2],
    /// Each photograph's share of the person `[B, 1, h, w]`.
    pub masks: [Tensor<4>; 2],
    rays: [Rays; 2],
}

impl SecondLook {
    /// `colors` are `[B, 3, h, w]` in [−1, 1]. The `window` of a canvas of `side`² pixels is symmetric.
    pub(super) fn new(
        maps: [PointMap; 2],
        colors: [Tensor<4>; 2],
        masks: [Tensor<4>; 2],
        window: &Window,
        side: usize,
    ) -> Self {
        let ([b, _, h, w], device) = (masks[0].dims(), masks[0].device());
        let rays = [View::Front, View::Back].map(|view| Rays::new(view, OPPOSITE, side, window, &device));
        let distances = [0, 1].map(|i| {
            let distance = (maps[i].points.clone() * rays[i].forward.clone()).sum_dim(3);
            distance.permute([0, 3, 1, 2]) * masks[i].clone()
        });
        let images = [0, 1].map(|i| {
            let place = rays[i].anchors().narrow(3, 0, 2).permute([0, 3, 1, 2]).expand([b, 2, h, w]);
            let is_back = Tensor::full([b, 1, h, w], i as f32, &device);
            // The plane through the axis shows the same place of the body to mirrored pixels of the other photograph.
            let [other, other_mask] = [&distances[1 - i], &masks[1 - i]].map(|x| x.clone().flip([3]));
            let own = [colors[i].clone(), masks[i].clone(), distances[i].clone()];
            Tensor::cat(own.into_iter().chain([other, other_mask, is_back, place]).collect(), 1)
        });
        Self { images: Tensor::cat(images.to_vec(), 0), maps, masks, rays }
    }

    /// Depths `[2·B, 1, h, w]` in metres by which `points` of front and back `[B, h, w, 3]`, metres in the front
    /// camera's frame, lie behind the points of the maps. `delta` is the number of metres per network unit.
    pub fn depths_behind(&self, points: [Tensor<4>; 2], delta: f32) -> Tensor<4> {
        let views = points.into_iter().zip(&self.maps).zip(&self.rays);
        let behind = views.map(|((points, map), rays)| {
            let off = points - (rays.anchors() + map.points.clone() * delta);
            (off * rays.forward.clone()).sum_dim(3).permute([0, 3, 1, 2])
        });
        Tensor::cat(behind.collect(), 0)
    }
}
