//! Inputs of the point predictor, its convolutional body, and the keys of the network.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_net::config::Config;
use snapsnap_net::network::{Input, PointMap, PointPredictor, View};
use snapsnap_net::steps::Step;
use snapsnap_net::weights::random_predictor;
use snapsnap_net::{Reconstruction, Reconstructor, Window};
use snapsnap_tests::{device, real_device, relative_error, values};

use crate::properties::{assert_different, assert_same, config, noise, photograph, weights};

const CONVOLUTION: [&str; 4] = [
    "network.body=convolution",
    "network.dec_depth=1",
    "network.mask_channel=true",
    "network.ray_channels=true",
];

fn images([h, w]: [usize; 2], channels: usize, seed: u32, device: &Device) -> Tensor<4> {
    Tensor::from_data(TensorData::new(noise(2 * channels * h * w, seed), [2, channels, h, w]), device)
}

/// Points and confidences of all views.
fn maps(net: &PointPredictor, input: Input) -> Vec<(View, Vec<f32>)> {
    let window = Window::whole(input.images.dims()[2]);
    let maps = net.forward(input, &window).into_iter();
    maps.map(|(view, map)| (view, [values(map.points), values(map.conf)].concat())).collect()
}

fn whole(config: &Config, images: Tensor<4>) -> Input {
    let [_, _, h, w] = images.dims();
    Input { images, grid: [h / config.network.patch, w / config.network.patch] }
}

#[test]
fn a_convolution_is_the_same_on_every_device_and_for_every_patch() {
    let Some(device) = device() else { return };
    for patch in [8, 16] {
        let config = config(&[&CONVOLUTION[..], &[&format!("network.patch={patch}")]].concat());
        let on = |device: &Device| {
            let net = random_predictor(&config, 5, device);
            assert_eq!(net.views().len(), 4);
            maps(&net, whole(&config, images([48, 32], 6, 1, device)))
        };
        let (got, expected) = (on(&device), on(&Device::flex()));
        for ((view, got), (_, expected)) in got.iter().zip(&expected) {
            assert_eq!(got.len(), 48 * 32 * 4);
            let error = relative_error(got, expected);
            assert!(error < 1e-4, "patch {patch}, {view:?}: {error:e}");
        }
        // Every view has layers of its own.
        (0..4).for_each(|i| assert_different("views", &expected[i].1, &expected[(i + 1) % 4].1));
    }
    let config = config(&[&CONVOLUTION[..], &["network.side_heads=false"]].concat());
    let two = maps(&random_predictor(&config, 5, &device), whole(&config, images([48, 32], 6, 1, &device)));
    assert_eq!(two.iter().map(|(view, _)| *view).collect::<Vec<_>>(), [View::Front, View::Back]);
}

#[test]
fn every_view_depends_on_both_photographs() {
    let Some(device) = real_device() else { return };
    let config = config(&CONVOLUTION);
    let net = random_predictor(&config, 5, &device);
    let plain = images([32, 32], 6, 1, &device);
    let before = maps(&net, whole(&config, plain.clone()));
    for photograph in 0..2 {
        let other = plain.clone().slice_assign(
            [photograph..photograph + 1, 0..6, 0..32, 0..32],
            images([32, 32], 6, 9, &device).narrow(0, photograph, 1),
        );
        let after = maps(&net, whole(&config, other));
        for ((view, a), (_, b)) in before.iter().zip(&after) {
            assert_different(&format!("{view:?} of photograph {photograph}"), a, b);
        }
    }
}

/// `network.mirror` gives the same as a mirrored photograph of the back without this key.
#[test]
fn a_mirrored_back_is_the_back_of_a_mirrored_photograph() {
    let Some(device) = real_device() else { return };
    for body in [&CONVOLUTION[..], &["network.mask_channel=true", "network.ray_channels=true"]] {
        let plain = config(body);
        let mirrored = config(&[body, &["network.mirror=true"]].concat());
        let side = plain.network.resolution;
        let window = Window { rows: 0..side, columns: side / 4..3 * side / 4 };
        let colors = images([side; 2], 3, 1, &device);
        let masks = (images([side; 2], 1, 2, &device) + 1.0) * 0.5;
        let half = |x: &Tensor<4>, i: usize| x.clone().narrow(0, i, 1);
        let flipped = |x: &Tensor<4>| Tensor::cat(vec![half(x, 0), half(x, 1).flip([3])], 0);
        let seen = Input::new(&mirrored, colors.clone(), masks.clone(), &window);
        let mut other = Input::new(&plain, flipped(&colors), flipped(&masks), &window);
        // Rays belong to the back's own camera, so the mirrored photograph needs the opposite x.
        let rays = other.images.clone().narrow(1, 4, 1);
        let rays = Tensor::cat(vec![half(&rays, 0), -half(&rays, 1)], 0);
        let [_, _, h, w] = other.images.dims();
        other.images = other.images.slice_assign([0..2, 4..5, 0..h, 0..w], rays);
        assert_same("input", &values(seen.images.clone()), &values(other.images.clone()));
        let net = |config: &Config| random_predictor(config, 5, &device);
        let (a, b) = (net(&mirrored).forward(seen, &window), net(&plain).forward(other, &window));
        for ((view, a), (_, b)) in a.into_iter().zip(b) {
            let b = if view == View::Back { b.points.flip([2]) } else { b.points };
            assert_same(view.name(), &values(a.points), &values(b));
        }
    }
}

/// With `network.both_ways`, mirrored photographs give the mirrored prediction, but for rounding.
#[test]
fn predictions_of_both_ways_are_symmetric() {
    let Some(device) = real_device() else { return };
    for body in [&CONVOLUTION[..], &["network.mask_channel=true", "network.ray_channels=true"]] {
        let one = config(&[body, &["network.mirror=true"]].concat());
        let both = config(&[body, &["network.mirror=true", "network.both_ways=true"]].concat());
        let side = both.network.resolution;
        let window = Window { rows: 0..side, columns: side / 4..3 * side / 4 };
        let colors = images([side; 2], 3, 1, &device);
        let masks = (images([side; 2], 1, 2, &device) + 1.0) * 0.5;
        let of = |config: &Config, flip: bool| {
            let seen = |x: &Tensor<4>| if flip { x.clone().flip([3]) } else { x.clone() };
            let input = Input::new(config, seen(&colors), seen(&masks), &window);
            random_predictor(config, 5, &device).forward(input, &window)
        };
        let mirrored = |map: &PointMap| {
            let [b, h, w, _] = map.points.dims();
            let points = map.points.clone().flip([2]);
            let x = -points.clone().narrow(3, 0, 1);
            [values(points.slice_assign([0..b, 0..h, 0..w, 0..1], x)), values(map.conf.clone().flip([2]))]
                .concat()
        };
        let (plain, flipped) = (of(&both, false), of(&both, true));
        let [once, again] = [false, true].map(|flip| of(&one, flip));
        for ((view, map), other) in plain.iter().zip([0, 1, 3, 2]) {
            assert_eq!(map.points.dims()[0], 1);
            let got = [values(map.points.clone()), values(map.conf.clone())].concat();
            let error = relative_error(&got, &mirrored(&flipped[other].1));
            assert!(error < 1e-6, "{view:?}: {error:e}");
            // The prediction is the mean of the two single predictions.
            let alone = &once[*view as usize].1;
            let alone = [values(alone.points.clone()), values(alone.conf.clone())].concat();
            let mean: Vec<f32> =
                alone.iter().zip(mirrored(&again[other].1)).map(|(a, b)| (a + b) * 0.5).collect();
            let error = relative_error(&got, &mean);
            assert!(error < 1e-6, "{view:?}: {error:e}");
            assert_different("both ways", &got, &alone);
        }
    }
}

/// The nominal cameras' focal length is 0.8 of the canvas, their axis 25 of 1024 pixels below its middle
/// (docs/method.md, "Cameras").
#[test]
fn channels_hold_the_share_of_the_person_and_the_ray() {
    let device = Device::flex();
    let config = config(&["network.mask_channel=true", "network.ray_channels=true"]);
    let side = config.network.resolution;
    let window = Window { rows: 32..96, columns: 64..128 };
    let mask = Tensor::<4>::ones([2, 1, side, side], &device);
    let mask = mask.slice_assign([0..2, 0..1, 0..side, 0..65], Tensor::zeros([2, 1, side, 65], &device));
    let input = Input::new(&config, Tensor::zeros([2, 3, side, side], &device), mask, &window);
    assert_eq!(input.images.dims(), [2, 6, 32, 32]);
    let at = |photograph: usize, channel: usize, row: usize, column: usize| {
        values(input.images.clone())[((photograph * 6 + channel) * 32 + row) * 32 + column]
    };
    // A network pixel covers 2×2 canvas pixels; one of their two columns belongs to the person.
    assert_eq!((at(0, 3, 0, 0), at(0, 3, 31, 1)), (0.5, 1.0));
    let near = |a: f32, b: f32| assert!((a - b).abs() < 1e-6, "{a} {b}");
    near(at(0, 4, 5, 31), (127.0 / 128.0 - 0.5) / 0.8);
    near(at(1, 4, 5, 31), -(127.0 / 128.0 - 0.5) / 0.8);
    let down = (33.0 / 128.0 - 537.0 / 1024.0) / 0.8;
    near(at(0, 5, 0, 7), down);
    near(at(1, 5, 0, 7), down);
}

/// The maps, the Gaussians and the steps of a reconstruction agree on the points that moved.
#[test]
fn points_that_moved_into_the_silhouettes_are_those_of_maps_and_gaussians() {
    let Some(device) = device() else { return };
    // A strip of a person, 0.3 to 0.5 m from the axis. The points of random weights are nearer to it.
    let side = config(&[]).network.resolution;
    let strip = |seed: u32, columns: std::ops::Range<usize>| {
        let mut photograph = photograph(side, seed);
        for (i, valid) in photograph.valid.iter_mut().enumerate() {
            *valid &= columns.contains(&(i % side));
        }
        photograph
    };
    let runs = ["network.hull_reach=0", "network.hull_reach=1"].map(|reach| {
        let keys = [
            "network.anchor=ray",
            "network.delta=1",
            "network.conf_threshold=0.0",
            "network.hull_margin=1024",
            reach,
        ];
        let config = config(&keys);
        let (_file, weights) = weights(&config, 4);
        let model = Reconstructor::load(&weights, &device).expect("weights");
        model.reconstruct([&strip(1, 0..side / 2 - 16), &strip(2, side / 2 + 16..side)], &|_| ())
    });
    let [before, after] = runs.each_ref().map(|run| run.points.host.clone());
    // At least half a pixel's width. Two runs on a GPU may differ in the last bits.
    let differs = |(a, b): (&[f32], &[f32])| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-3);
    let moved: Vec<bool> = before.chunks_exact(3).zip(after.chunks_exact(3)).map(differs).collect();
    let photographed = moved.len() / 2;
    let count = moved.iter().filter(|moved| **moved).count();
    assert!(count > 0 && !moved[..photographed].contains(&true), "{count}");
    let moved = |run: &Reconstruction| {
        let pixels =
            |step: &Step| if let Step::MovedIntoSilhouettes { pixels } = step { Some(*pixels) } else { None };
        run.steps.iter().find_map(pixels)
    };
    assert_eq!([moved(&runs[0]), moved(&runs[1])], [None, Some(count)]);
    // A centre is its pixel's point and the regressor's offset, 1.25 mm at most. Points move by centimetres.
    for (run, points) in runs.iter().zip([before, after]) {
        let chosen = points.chunks_exact(3).zip(run.valid.iter().flatten());
        let points: Vec<f32> =
            chosen.filter(|(_, valid)| **valid).flat_map(|(point, _)| point).copied().collect();
        let centres = values(run.gaussians.means.clone());
        assert_eq!(centres.len(), points.len());
        let farthest = centres.iter().zip(&points).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(farthest < 0.002, "{farthest} m");
    }
}

/// The steps contain the channels and the window. Every valid pixel of a photograph becomes a Gaussian.
#[test]
fn the_steps_of_a_reconstruction_name_channels_and_window() {
    let Some(device) = device() else { return };
    for body in [
        &["network.head=linear", "network.patch=8"][..],
        &["network.body=convolution", "network.dec_depth=1"],
    ] {
        let keys = [
            "network.window=true",
            "network.mask_channel=true",
            "network.ray_channels=true",
            "network.mirror=true",
            "network.anchor=ray",
            "network.conf_threshold=0.4",
        ];
        let config = config(&[&keys[..], body].concat());
        let (_file, weights) = weights(&config, 4);
        let model = Reconstructor::load(&weights, &device).expect("weights");
        let side = config.network.resolution;
        let photographs = [photograph(side, 1), photograph(side, 2)];
        let made = model.reconstruct(photographs.each_ref(), &|_| ());
        // Three colours, the mask, and two of the ray. The person's window is smaller than the canvas.
        let is_told = |step: &Step| matches!(step, Step::PointPredictor { window, channels: 6, .. } if *window != Window::whole(side));
        assert!(made.steps.iter().any(is_told), "{:?}", made.steps);
        for (photograph, valid) in photographs.iter().zip(&made.valid) {
            assert_eq!(&photograph.valid, valid, "{:?}", made.steps);
        }
    }
}
