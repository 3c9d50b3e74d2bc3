//! A second look at the photographs (docs/method.md, "Details"): a U-shaped network, which sees them larger than the
//! predictor does, moves their points along their rays. It has no attention, so that a pixel's result depends on its
//! surroundings alone.

use burn::module::Module;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Device, Tensor};

use super::View;
use super::predictor::{PointMap, PointPredictor, enlarged};
use super::rays::Rays;
use super::unet::{UNet, UNetSizes};
use crate::config::{DetailsConfig, Downsample, OPPOSITE};
use crate::resample::shrink;
use crate::window::Window;

/// Channels of the input: colours, mask, distance of the points from the plane through the body's axis, its difference
/// from the mean nearby, the other photograph's distance and mask at the same place of the body, front or back, and the
/// place on the plane.
const INPUTS: usize = 3 + 1 + 2 + 2 + 1 + 2;
/// Network units per unit of the differences from the mean nearby and of the network's output: with a δ of 0.2, 1 cm.
const UNIT: f64 = 0.05;
/// Number and side of the means that make the mean nearby. At 128 pixels its standard deviation is 7 cm.
const MEANS: (usize, usize) = (4, 7);
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
        self.body.decoder.out(self.body.features(&levels)) * UNIT
    }
}

/// What the network of details sees of both photographs.
pub struct SecondLook {
    /// `[2·B, INPUTS, h, w]`, all fronts, then all backs.
    pub images: Tensor<4>,
    /// Enlarged maps of front and back, in network units and without anchors.
    maps: [PointMap; 2],
    /// Each photograph's share of the person `[B, 1, h, w]`.
    masks: [Tensor<4>; 2],
    rays: [Rays; 2],
}

impl PointPredictor {
    /// Refines the maps of front and back, in network units and without anchors (docs/method.md, "Details"). Returns
    /// maps of `network.details.resolution`, and moves the given maps by the mean movement of the person in each pixel.
    /// `images` `[B, 2, 3, S, S]` and `masks` `[B, 2, S, S]` are the photographs.
    ///
    /// # Panics
    /// Without a network of details.
    pub fn detailed(
        &self,
        maps: &mut [(View, PointMap)],
        images: &Tensor<5>,
        masks: &Tensor<4>,
        window: &Window,
    ) -> Vec<(View, PointMap)> {
        let [canvas, coarse] = [self.config.resolution, self.config.net_resolution];
        let fine = self.details.as_ref().expect("a network of details").resolution;
        let look = self.second_look(maps, images, masks, window);
        let relief = self.relief(look.images);
        let b = relief.dims()[0] / 2;
        let reliefs = [0, b].map(|from| relief.clone().narrow(0, from, b));
        let moved = |map: PointMap, relief: Tensor<4>, rays: &Rays| PointMap {
            points: map.points + rays.directions.clone() * relief.permute([0, 2, 3, 1]),
            ..map
        };
        for (i, (view, map)) in maps.iter_mut().take(2).enumerate() {
            /// Least share of the person in a pixel that is moved.
            const MIN_SHARE: f64 = 1e-3;
            let small = |x: Tensor<4>| shrink(x, fine / coarse, Downsample::Area);
            let mask = look.masks[i].clone();
            let mean = small(reliefs[i].clone() * mask.clone()) / small(mask).clamp_min(MIN_SHARE);
            let rays = Rays::new(*view, OPPOSITE, coarse, &window.shrunk(canvas / coarse), &mean.device());
            *map = moved(map.clone(), mean, &rays);
        }
        let fine = look.maps.into_iter().zip(reliefs).zip(&look.rays);
        let fine = fine.map(|((map, relief), rays)| moved(map, relief, rays));
        [View::Front, View::Back].into_iter().zip(fine).collect()
    }

    /// Input of the network of details for maps of front and back, as in [`Self::detailed`].
    ///
    /// # Panics
    /// Without such a network.
    pub fn second_look(
        &self,
        maps: &[(View, PointMap)],
        images: &Tensor<5>,
        masks: &Tensor<4>,
        window: &Window,
    ) -> SecondLook {
        let fine = self.details.as_ref().expect("a network of details").resolution;
        let [canvas, coarse] = [self.config.resolution, self.config.net_resolution];
        let small = |x: Tensor<4>, size: usize| shrink(window.cut(x), canvas / size, Downsample::Area);
        let mask = |view: usize, size: usize| small(masks.clone().narrow(1, view, 1), size);
        let colors = [0, 1].map(|view| small(images.clone().narrow(1, view, 1).squeeze_dim(1), fine));
        let larger = |map: PointMap, view: usize| enlarged(map, fine / coarse, Some(mask(view, coarse)));
        let large = [0, 1].map(|view| larger(maps[view].1.clone(), view));
        let smooth = [0, 1].map(|view| larger(smoothed(&maps[view].1, &mask(view, coarse)), view));
        let masks = [mask(0, fine), mask(1, fine)];
        SecondLook::new(large, smooth, colors, masks, &window.shrunk(canvas / fine), fine)
    }

    /// Movements along the rays `[N, 1, h, w]`, in network units, for images of a [`SecondLook`] or for parts of them.
    /// A movement of 1 changes the depth by one unit.
    ///
    /// # Panics
    /// Without a network of details.
    pub fn relief(&self, images: Tensor<4>) -> Tensor<4> {
        self.details.as_ref().expect("a network of details").relief(images)
    }
}

/// Points with the mean of the person's points nearby, by its share of each pixel `[B, 1, h, w]`.
fn smoothed(map: &PointMap, mask: &Tensor<4>) -> PointMap {
    let mean = |x: Tensor<4>| {
        let options = || AvgPoolOptions::new([MEANS.1; 2]).with_stride([1, 1]).with_padding([MEANS.1 / 2; 2]);
        (0..MEANS.0).fold(x, |x, _| avg_pool2d(x, options()))
    };
    /// Least share of the person nearby.
    const MIN_SHARE: f64 = 1e-3;
    let outside = mask.clone().lower_equal_elem(0.0);
    let points = map.points.clone().permute([0, 3, 1, 2]);
    // Points of the background may be anything.
    let points = (points * mask.clone())
        .mask_fill(outside.expand(map.points.clone().permute([0, 3, 1, 2]).dims()), 0.0);
    let mean = mean(points) / mean(mask.clone()).clamp_min(MIN_SHARE);
    PointMap { points: mean.permute([0, 2, 3, 1]), conf: map.conf.clone() }
}

impl SecondLook {
    /// `colors` are `[B, 3, h, w]` in [−1, 1]. The `window` of a canvas of `side`² pixels is symmetric. `smooth` are the
    /// maps with the means nearby.
    pub(super) fn new(
        maps: [PointMap; 2],
        smooth: [PointMap; 2],
        colors: [Tensor<4>; 2],
        masks: [Tensor<4>; 2],
        window: &Window,
        side: usize,
    ) -> Self {
        let ([b, _, h, w], device) = (masks[0].dims(), masks[0].device());
        let rays = [View::Front, View::Back].map(|view| Rays::new(view, OPPOSITE, side, window, &device));
        let distances = [&maps, &smooth].map(|maps| {
            [0, 1].map(|i| {
                let distance = (maps[i].points.clone() * rays[i].forward.clone()).sum_dim(3);
                let outside = masks[i].clone().lower_equal_elem(0.0);
                (distance.permute([0, 3, 1, 2]) * masks[i].clone()).mask_fill(outside, 0.0)
            })
        });
        let [distances, smooth] = distances;
        let images = [0, 1].map(|i| {
            let place = rays[i].anchors().narrow(3, 0, 2).permute([0, 3, 1, 2]).expand([b, 2, h, w]);
            let is_back = Tensor::full([b, 1, h, w], i as f32, &device);
            // The plane through the axis shows the same place of the body to mirrored pixels of the other photograph.
            let [other, other_mask] = [&distances[1 - i], &masks[1 - i]].map(|x| x.clone().flip([3]));
            let relief = (distances[i].clone() - smooth[i].clone()) / UNIT;
            let own = [colors[i].clone(), masks[i].clone(), distances[i].clone(), relief];
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

#[cfg(test)]
mod tests {
    use burn::module::Param;
    use burn::tensor::TensorData;
    use snapsnap_ops::host;

    use super::*;
    use crate::Prediction;
    use crate::config::{Config, NetworkConfig};
    use crate::network::completion::tests::{SIDE, config as small};
    use crate::parameters::{NamedMapper, ParameterPath, map_named};
    use crate::steps::Record;
    use crate::weights::random_predictor;

    fn config(details: Option<usize>) -> Config {
        let network = NetworkConfig {
            net_resolution: SIDE / 2,
            delta: 0.2,
            both_ways: true,
            second_layer: false,
            details: details.map(|resolution| DetailsConfig { resolution, dims: [4, 4, 8, 8] }),
            ..small()
        };
        Config { network, ..Config::default() }
    }

    /// The predictor, whose network of details moves every point by `relief` network units.
    fn moving(config: &Config, relief: f32) -> PointPredictor {
        struct Constant(f32);
        impl NamedMapper for Constant {
            fn map<const D: usize>(
                &mut self,
                path: &ParameterPath,
                param: Param<Tensor<D>>,
            ) -> Param<Tensor<D>> {
                match path.name().as_str() {
                    "details.decoder.conv_out.weight" => param.map(|values| values.zeros_like()),
                    "details.decoder.conv_out.bias" => {
                        param.map(|values| values.zeros_like() + f64::from(self.0) / UNIT)
                    }
                    _ => param,
                }
            }
        }
        map_named(random_predictor(config, 3, &Device::flex()), "", &mut Constant(relief))
    }

    /// Points of all views of a person in the middle of both photographs.
    fn predicted(config: &Config, predictor: &PointPredictor) -> Vec<Vec<f32>> {
        let inside = |i: usize| (16..56).contains(&(i / SIDE)) && (24..40).contains(&(i % SIDE));
        let mask: Vec<f32> = (0..SIDE * SIDE).map(|i| f32::from(u8::from(inside(i)))).collect();
        let rgb: Vec<f32> =
            (0..3 * SIDE * SIDE).map(|i| mask[i % mask.len()] * (i as f32 * 0.37).sin()).collect();
        let photograph = crate::Photograph::new(rgb, mask);
        let (device, mut record) = (Device::flex(), Record::default());
        let made = Prediction::of_pair(predictor, config, [&photograph, &photograph], &device, &mut record);
        made.maps.into_iter().map(|(_, map)| host(map.points)).collect()
    }

    #[test]
    fn details_that_move_nothing_leave_all_points_in_place() {
        let (plain, same_size) = (config(None), config(Some(SIDE / 2)));
        let expected = predicted(&plain, &random_predictor(&plain, 3, &Device::flex()));
        assert_eq!(predicted(&same_size, &moving(&same_size, 0.0)), expected);
    }

    /// Points of photographs move along their rays. The sides are completed from the moved points.
    #[test]
    fn details_move_points_along_their_rays() {
        let config = config(Some(SIDE));
        let (still, moved) = (moving(&config, 0.0), moving(&config, 0.5));
        let (before, after) = (predicted(&config, &still), predicted(&config, &moved));
        let window = Window::whole(SIDE);
        for (view, (before, after)) in [View::Front, View::Back].into_iter().zip(before.iter().zip(&after)) {
            let rays = host(Rays::new(view, OPPOSITE, SIDE, &window, &Device::flex()).directions);
            for (i, ((a, b), ray)) in before.iter().zip(after).zip(&rays).enumerate() {
                assert!((b - a - 0.5 * 0.2 * ray).abs() < 1e-5, "{view:?} {i}: {a} {b}");
            }
        }
        let apart = |view: usize| {
            before[view].iter().zip(&after[view]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(apart(2) > 0.01 && apart(3) > 0.01, "{} {}", apart(2), apart(3));
    }

    #[test]
    fn depths_behind_are_measured_in_each_photographs_camera() {
        let device = Device::flex();
        let window = Window::whole(SIDE);
        let noise = |seed: usize| -> Vec<f32> {
            (0..3 * SIDE * SIDE).map(|i| 0.3 * ((i * 7 + seed) as f32).sin()).collect()
        };
        let map = |seed: usize| PointMap {
            points: Tensor::from_data(TensorData::new(noise(seed), [1, SIDE, SIDE, 3]), &device),
            conf: Tensor::ones([1, SIDE, SIDE], &device),
        };
        let maps = [map(1), map(2)];
        let mask = || Tensor::ones([1, 1, SIDE, SIDE], &device);
        let colors = || Tensor::zeros([1, 3, SIDE, SIDE], &device);
        let look = SecondLook::new(
            maps.clone(),
            maps.clone(),
            [colors(), colors()],
            [mask(), mask()],
            &window,
            SIDE,
        );
        assert_eq!(look.images.dims(), [2, INPUTS, SIDE, SIDE]);
        let points = [(View::Front, 0.03), (View::Back, -0.05)].map(|(view, depth)| {
            let rays = Rays::new(view, OPPOSITE, SIDE, &window, &device);
            rays.anchors() + maps[view as usize].points.clone() * 0.2 + rays.directions * depth
        });
        let behind = host(look.depths_behind(points, 0.2));
        for (i, depth) in behind.iter().enumerate() {
            let expected = if i < SIDE * SIDE { 0.03 } else { -0.05 };
            assert!((depth - expected).abs() < 1e-5, "{i}: {depth}");
        }
    }
}
