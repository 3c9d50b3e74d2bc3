//! A second look at the photographs (docs/method.md, "Details"): a U-shaped network, which sees them larger than the
//! predictor does, moves their points along their rays. It has no attention, so that a pixel's result depends on its
//! surroundings alone.

use std::ops::Range;

use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Device, Tensor};

use snapsnap_ops::bilinear;

use super::View;
use super::predictor::{PointMap, PointPredictor, enlarged};
use super::rays::Rays;
use super::unet::{UNet, UNetSizes};
use crate::config::{DetailsConfig, Downsample, OPPOSITE, PATCH};
use crate::resample::shrink;
use crate::window::Window;

/// Channels of the input: colours and masks of a patch, distance of the points from the plane through the body's axis, its difference
/// from the mean nearby, the other photograph's distance and mask at the same place of the body, front or back, and the
/// place on the plane.
const INPUTS: usize = (3 + 1) * PATCH * PATCH + 2 + 2 + 1 + 2;
/// Network units per unit of the differences from the mean nearby and of the network's output: with a δ of 0.2, 1 cm.
const UNIT: f64 = 0.05;
/// Number and side of the means that make the mean nearby. At 128 pixels its standard deviation is 7 cm.
const MEANS: (usize, usize) = (4, 7);
/// Least share of the person in a pixel whose mean is taken.
const MIN_SHARE: f64 = 1e-3;
/// Channels of the features before the last layer.
const LAST_DIM: usize = 16;

/// The network of details.
pub(super) fn network(config: &DetailsConfig, device: &Device) -> UNet {
    let sizes = UNetSizes {
        inputs: INPUTS,
        outputs: PATCH * PATCH,
        widths: config.dims,
        blocks: [config.dims[3], 0, 1],
        stride: 1,
        last_dim: LAST_DIM,
    };
    UNet::new(&sizes, device)
}

/// The pixels of each patch as channels: `[B, C, h, w]` → `[B, C·PATCH², h/PATCH, w/PATCH]`.
fn patches(x: Tensor<4>) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let (h, w) = (h / PATCH, w / PATCH);
    let split = x.reshape([b, c, h, PATCH, w, PATCH]).permute([0, 1, 3, 5, 2, 4]);
    split.reshape([b, c * PATCH * PATCH, h, w])
}

/// Channels as the pixels of each patch: `[B, PATCH², h, w]` → `[B, 1, PATCH·h, PATCH·w]`.
fn joined(x: Tensor<4>) -> Tensor<4> {
    let [b, _, h, w] = x.dims();
    let rows = x.reshape([b, PATCH, PATCH, h, w]).permute([0, 3, 1, 4, 2]);
    rows.reshape([b, 1, PATCH * h, PATCH * w])
}

/// What the network of details sees of both photographs.
pub struct SecondLook {
    /// `[2·B, INPUTS, h/PATCH, w/PATCH]`, all fronts, then all backs.
    pub images: Tensor<4>,
    /// Maps of front and back, enlarged to h × w, in network units and without anchors.
    maps: [PointMap; 2],
    /// Each photograph's share of the person `[B, 1, h, w]`.
    masks: [Tensor<4>; 2],
    rays: [Rays; 2],
}

impl PointPredictor {
    /// Refines the maps of front and back, in network units and without anchors (docs/method.md, "Details"). Returns
    /// maps of `network.details.resolution`, and moves the given maps by the mean movement of the person in each pixel.
    /// `images` `[B, 2, 3, S, S]` and `masks` `[B, 2, S, S]` are the photographs. Only the `columns` of the window's image
    /// show the person; they are symmetric and whole patches.
    ///
    /// # Panics
    /// Without a network of details.
    pub fn detailed(
        &self,
        maps: &mut [(View, PointMap)],
        images: &Tensor<5>,
        masks: &Tensor<4>,
        window: &Window,
        columns: Range<usize>,
    ) -> Vec<(View, PointMap)> {
        let [canvas, coarse] = [self.config.resolution, self.config.net_resolution];
        let fine = self.config.details.as_ref().expect("a network of details").resolution;
        let look = self.second_look(maps, images, masks, window);
        let [h, w] = look.size();
        let shown = look.images.narrow(3, columns.start / PATCH, columns.len() / PATCH);
        let n = shown.dims()[0];
        let relief = Tensor::zeros([n, 1, h, w], &shown.device())
            .slice_assign([0..n, 0..1, 0..h, columns], self.relief(shown));
        let b = n / 2;
        let reliefs = [0, b].map(|from| relief.clone().narrow(0, from, b));
        let moved = |map: PointMap, relief: Tensor<4>, rays: &Rays| PointMap {
            points: map.points + rays.directions.clone() * relief.permute([0, 2, 3, 1]),
            ..map
        };
        for (i, (view, map)) in maps.iter_mut().take(2).enumerate() {
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
        let fine = self.config.details.as_ref().expect("a network of details").resolution;
        let [canvas, coarse] = [self.config.resolution, self.config.net_resolution];
        let device = masks.device();
        let small = |x: Tensor<4>, size: usize| shrink(window.cut(x), canvas / size, Downsample::Area);
        let mask = |view: usize, size: usize| small(masks.clone().narrow(1, view, 1), size);
        let larger =
            |map: PointMap, view: usize, size: usize| enlarged(map, size / coarse, Some(mask(view, coarse)));
        let rays = |size: usize| {
            let window = window.shrunk(canvas / size);
            [View::Front, View::Back].map(|view| Rays::new(view, OPPOSITE, size, &window, &device))
        };
        let fine_masks = [0, 1].map(|view| mask(view, fine));
        let shares = fine_masks.clone().map(|mask| shrink(mask, PATCH, Downsample::Area));
        let [b, _, h, w] = shares[0].dims();
        let patch_rays = rays(fine / PATCH);
        // Of each photograph's points, and of the means nearby.
        let distances = [0, 1].map(|view| {
            let map = &maps[view].1;
            let nearby = means(map.points.clone().permute([0, 3, 1, 2]), &mask(view, coarse));
            let nearby = PointMap { points: nearby.permute([0, 2, 3, 1]), conf: map.conf.clone() };
            let outside = shares[view].clone().lower_equal_elem(0.0);
            [map.clone(), nearby].map(|map| {
                let points = larger(map, view, fine / PATCH).points;
                let distance = (points * patch_rays[view].forward.clone()).sum_dim(3);
                (distance.permute([0, 3, 1, 2]) * shares[view].clone()).mask_fill(outside.clone(), 0.0)
            })
        });
        let seen = [0, 1].map(|view| {
            let colors = small(images.clone().narrow(1, view, 1).squeeze_dim(1), fine);
            let [colors, mask] = [colors, fine_masks[view].clone()].map(patches);
            let place = patch_rays[view].anchors().narrow(3, 0, 2).permute([0, 3, 1, 2]).expand([b, 2, h, w]);
            let is_back = Tensor::full([b, 1, h, w], view as f32, &device);
            // The plane through the axis shows the same place of the body to mirrored pixels of the other photograph.
            let [other, other_mask] =
                [&distances[1 - view][0], &shares[1 - view]].map(|x| x.clone().flip([3]));
            let [distance, nearby] = distances[view].clone();
            let relief = (distance.clone() - nearby) / UNIT;
            Tensor::cat(vec![colors, mask, distance, relief, other, other_mask, is_back, place], 1)
        });
        SecondLook {
            images: Tensor::cat(seen.to_vec(), 0),
            maps: [0, 1].map(|view| larger(maps[view].1.clone(), view, fine)),
            masks: fine_masks,
            rays: rays(fine),
        }
    }

    /// Movements along the rays `[N, 1, PATCH·h, PATCH·w]`, in network units, for images `[N, INPUTS, h, w]` of a [`SecondLook`] or for parts of them.
    /// A movement of 1 changes the depth by one unit.
    ///
    /// # Panics
    /// Without a network of details.
    pub fn relief(&self, images: Tensor<4>) -> Tensor<4> {
        let body = self.details.as_ref().expect("a network of details");
        joined(body.decoder.out(body.features(&body.encode(images, None)))) * UNIT
    }
}

/// Means of the person's values nearby `[B, C, h, w]`, by its share of each pixel `[B, 1, h, w]`.
fn means(x: Tensor<4>, mask: &Tensor<4>) -> Tensor<4> {
    let mean = |x: Tensor<4>| {
        let options = || AvgPoolOptions::new([MEANS.1; 2]).with_stride([1, 1]).with_padding([MEANS.1 / 2; 2]);
        (0..MEANS.0).fold(x, |x, _| avg_pool2d(x, options()))
    };
    // Values of the background may be anything.
    let outside = mask.clone().lower_equal_elem(0.0).expand(x.dims());
    mean((x * mask.clone()).mask_fill(outside, 0.0)) / mean(mask.clone()).clamp_min(MIN_SHARE)
}

/// Values `[B, 1, h, w]` minus the mean of the person's values nearby; 0 outside of the person. `inside` is 1 or 0, and
/// `factor` is the number of its pixels per pixel of the predictor, along an axis.
pub fn without_mean(x: Tensor<4>, inside: &Tensor<4>, factor: usize) -> Tensor<4> {
    let [_, _, h, w] = x.dims();
    let x = x.mask_fill(inside.clone().lower_equal_elem(0.5), 0.0);
    let small = |x: Tensor<4>| shrink(x, factor, Downsample::Area);
    let share = small(inside.clone());
    let mean = means(small(x.clone()) / share.clone().clamp_min(MIN_SHARE), &share);
    (x - bilinear(mean, [h, w], false)) * inside.clone()
}

impl SecondLook {
    /// h and w.
    pub fn size(&self) -> [usize; 2] {
        let [_, _, h, w] = self.masks[0].dims();
        [h, w]
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
    use burn::tensor::TensorData;
    use snapsnap_ops::host;

    use super::*;
    use crate::Prediction;
    use crate::config::{Config, NetworkConfig};
    use crate::network::completion::tests::{SIDE, config as small, with_output};
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
        let predictor = random_predictor(config, 3, &Device::flex());
        with_output(predictor, "details.decoder.conv_out", f64::from(relief) / UNIT)
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
        let (plain, same_size) = (config(None), config(Some(SIDE)));
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

    /// A person with a bump of one coarse pixel, half a metre from the plane. The background may be anything.
    #[test]
    fn what_is_common_to_the_points_nearby_is_no_detail() {
        const FACTOR: usize = 4;
        let (device, side) = (Device::flex(), 40 * FACTOR);
        let is_inside = |i: usize| (16..144).contains(&(i % side)) && (16..144).contains(&(i / side));
        let is_bump = |i: usize| (80..84).contains(&(i % side)) && (80..84).contains(&(i / side));
        let of = |value: &dyn Fn(usize) -> f32| {
            let values: Vec<f32> = (0..side * side).map(value).collect();
            Tensor::<4>::from_data(TensorData::new(values, [1, 1, side, side]), &device)
        };
        let depths = of(&|i| match (is_inside(i), is_bump(i)) {
            (false, _) => f32::NAN,
            (true, is_bump) => 0.5 + if is_bump { 0.01 } else { 0.0 },
        });
        let found = host(without_mean(depths, &of(&|i| f32::from(u8::from(is_inside(i)))), FACTOR));
        // Four means of 7×7 have a standard deviation of 4 coarse pixels: the bump's mean is 1/(2π·16) of its height.
        let top = found[82 * side + 82];
        assert!((top - 0.01 * (1.0 - 1.0 / (32.0 * std::f32::consts::PI))).abs() < 1e-4, "{top}");
        assert!(found[40 * side + 20].abs() < 1e-6 && found[0] == 0.0);
        assert!(found.iter().all(|value| value.is_finite()));
    }

    #[test]
    fn channels_are_the_pixels_of_patches() {
        let device = Device::flex();
        let values: Vec<f32> = (0..2 * 4 * 6).map(|i| i as f32).collect();
        let image = Tensor::<4>::from_data(TensorData::new(values, [1, 2, 4, 6]), &device);
        let split = patches(image.clone());
        assert_eq!(split.dims(), [1, 8, 2, 3]);
        for (i, value) in host(split.clone()).into_iter().enumerate() {
            let (channel, [row, column]) = (i / 6, [i % 6 / 3, i % 3]);
            let (of, [y, x]) = (channel / 4, [channel % 4 / 2, channel % 2]);
            assert_eq!(value, (24 * of + 6 * (2 * row + y) + 2 * column + x) as f32);
        }
        assert_eq!(host(joined(split.narrow(1, 0, 4))), host(image.narrow(1, 0, 1)));
    }

    #[test]
    fn depths_behind_are_measured_in_each_photographs_camera() {
        let device = Device::flex();
        let window = Window::whole(SIDE);
        // A pixel of the predictor is two pixels wide.
        let side = SIDE / 2;
        let noise = |seed: usize| -> Vec<f32> {
            (0..3 * side * side).map(|i| 0.3 * ((i * 7 + seed) as f32).sin()).collect()
        };
        let map = |seed: usize| PointMap {
            points: Tensor::from_data(TensorData::new(noise(seed), [1, side, side, 3]), &device),
            conf: Tensor::ones([1, side, side], &device),
        };
        let config = config(Some(SIDE));
        let predictor = random_predictor(&config, 3, &device);
        let (images, masks) =
            (Tensor::zeros([1, 2, 3, SIDE, SIDE], &device), Tensor::ones([1, 2, SIDE, SIDE], &device));
        let maps = [(View::Front, map(1)), (View::Back, map(2))];
        let look = predictor.second_look(&maps, &images, &masks, &window);
        assert_eq!(look.images.dims(), [2, INPUTS, SIDE / PATCH, SIDE / PATCH]);
        let points = [(View::Front, 0.03), (View::Back, -0.05)].map(|(view, depth)| {
            let rays = Rays::new(view, OPPOSITE, SIDE, &window, &device);
            rays.anchors() + look.maps[view as usize].points.clone() * 0.2 + rays.directions * depth
        });
        let behind = host(look.depths_behind(points, 0.2));
        for (i, depth) in behind.iter().enumerate() {
            let expected = if i < SIDE * SIDE { 0.03 } else { -0.05 };
            assert!((depth - expected).abs() < 1e-5, "{i}: {depth}");
        }
    }
}
