//! Properties of the networks that hold for any weights.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_base::config::Schema;
use snapsnap_net::config::{Config, Downsample, NetworkConfig};
use snapsnap_net::network::{Decoded, Input, PointMap, View, activate};
use snapsnap_net::resample::shrink;
use snapsnap_net::steps::Step;
use snapsnap_net::weights::{WeightFile, init};
use snapsnap_net::{Photograph, Reconstruction, Reconstructor, Window};
use snapsnap_ops::{Rope, bilinear};
use snapsnap_tests::{device, relative_error, root, set_tensor, values};

pub(crate) fn config(overrides: &[&str]) -> Config {
    let path = root().join("configs/tiny.toml");
    let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
    Config::from_file(&path, &overrides).expect("tiny.toml")
}

pub(crate) fn weights(config: &Config, seed: u64) -> (tempfile::NamedTempFile, WeightFile) {
    let file = tempfile::NamedTempFile::new().expect("temporary file");
    init(config, seed, file.path(), &|_, _| ()).expect("written");
    let weights = WeightFile::open(file.path(), None).expect("our file");
    (file, weights)
}

/// Numbers in ±1 that depend on the index only.
pub(crate) fn noise(n: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

/// A photograph of noise with an upright ellipse as the person.
pub(crate) fn photograph(side: usize, seed: u32) -> Photograph {
    let inside = |i: usize| {
        let (x, y) = ((i % side) as f32 / side as f32 - 0.5, (i / side) as f32 / side as f32 - 0.5);
        (x / 0.2).powi(2) + (y / 0.4).powi(2) < 1.0
    };
    let valid: Vec<bool> = (0..side * side).map(inside).collect();
    let mask: Vec<f32> = valid.iter().map(|v| if *v { 1.0 } else { 0.0 }).collect();
    let rgb = noise(3 * side * side, seed).iter().zip(mask.iter().cycle()).map(|(c, m)| c * m).collect();
    Photograph::new(rgb, mask)
}

/// Equal but for f32 rounding: on GPUs, kernels are chosen by trial during the first runs.
pub(crate) fn assert_same(what: &str, a: &[f32], b: &[f32]) {
    let error = relative_error(a, b);
    assert!(error < 1e-5, "{what}: relative error {error:e}");
}

pub(crate) fn assert_different(what: &str, a: &[f32], b: &[f32]) {
    let error = relative_error(a, b);
    assert!(error > 1e-3, "{what}: relative error {error:e}");
}

fn reconstruct(config: &Config, device: &Device) -> Reconstruction {
    let (_file, weights) = weights(config, 4);
    let model = Reconstructor::load(&weights, device).expect("weights");
    let side = config.network.resolution;
    model.reconstruct([&photograph(side, 1), &photograph(side, 2)], &|_| ())
}

/// At row 1, column 0 the first pair turns by 1 rad, the second by 0.749894 rad
/// (docs/method.md, "Check values").
#[test]
fn rope_has_its_published_check_values() {
    let Some(device) = device() else { return };
    let rope = Rope::new(2, 1, 64, 100.0, &device);
    let mut token = vec![0.0; 128];
    token[64] = 1.0;
    token[64 + 1] = 1.0;
    token[64 + 32] = 1.0;
    let x = Tensor::<4>::from_data(TensorData::new(token, [1, 1, 2, 64]), &device);
    let turned = values(rope.apply(x));
    let expected =
        [(0, 1.0_f32.cos()), (16, 1.0_f32.sin()), (1, 0.749_894_f32.cos()), (17, 0.749_894_f32.sin())];
    for (i, value) in expected {
        assert!((turned[64 + i] - value).abs() < 1e-6, "{i}: {}", turned[64 + i]);
    }
    assert!((turned[64 + 32] - 1.0).abs() < 1e-6, "column 0 does not turn");
}

/// r = (0.3, 0, 0.4) gives p = (0.389233, 0, 0.518977) (docs/method.md, "Check values").
#[test]
fn points_have_their_published_check_value() {
    let Some(device) = device() else { return };
    let raw = |r: [f32; 3]| {
        let data = TensorData::new(vec![r[0], r[1], r[2], 0.0], [1, 4, 1, 1]);
        values(activate(Tensor::from_data(data, &device), &config(&[]).network).points)
    };
    let p = raw([0.3, 0.0, 0.4]);
    assert!((p[0] - 0.389_233).abs() < 1e-6 && p[1] == 0.0 && (p[2] - 0.518_977).abs() < 1e-6, "{p:?}");
    assert_eq!(raw([0.0; 3]), [0.0; 3]);
}

/// [0, 1] → [0, ⅓, ⅔, 1] with aligned corners, [0, ¼, ¾, 1] without
/// (docs/method.md, "Check values").
#[test]
fn bilinear_has_its_published_check_values() {
    let Some(device) = device() else { return };
    let x = Tensor::<4>::from_data(TensorData::new(vec![0.0_f32, 1.0], [1, 1, 1, 2]), &device);
    for (align, expected) in [(true, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]), (false, [0.0, 0.25, 0.75, 1.0])] {
        let got = values(bilinear(x.clone(), [1, 4], align));
        assert!(got.iter().zip(expected).all(|(g, e): (&f32, f32)| (g - e).abs() < 1e-6), "{got:?}");
    }
}

#[test]
fn shrinking_takes_means_or_first_pixels() {
    let Some(device) = device() else { return };
    let values_of = |factor: usize, method: Downsample| {
        let image: Vec<f32> = (0..72).map(|v| v as f32).collect();
        values(shrink(Tensor::from_data(TensorData::new(image, [1, 2, 6, 6]), &device), factor, method))
    };
    let first = [0.0, 3.0, 18.0, 21.0, 36.0, 39.0, 54.0, 57.0];
    assert_eq!(values_of(3, Downsample::Nearest), first);
    // The mean of a 3×3 cell of this ramp is its middle: one right and one down of its first pixel.
    assert_eq!(values_of(3, Downsample::Area), first.map(|v| v + 7.0));
    assert_eq!(values_of(1, Downsample::Area).len(), 72);
}

/// A point map of a single row: two body points at 1 and 2, then a background point at 1000 or beyond f32.
#[test]
fn mask_aware_enlargement_never_blends_in_the_background() {
    let Some(device) = device() else { return };
    let net = weights(&config(&[]), 1).1.point_predictor(&device).expect("weights");
    let delta = values(net.delta())[0];
    let row = |is_aware: bool, background: f32| -> Vec<f32> {
        let points: Vec<f32> = [1.0, 2.0, background].iter().flat_map(|v| [*v; 3]).collect();
        let map = PointMap {
            points: Tensor::from_data(TensorData::new(points, [1, 1, 3, 3]), &device),
            conf: Tensor::zeros([1, 1, 3], &device),
        };
        let body = Tensor::from_data(TensorData::new(vec![1.0_f32, 1.0, 0.0], [1, 1, 1, 3]), &device);
        let points = values(net.enlarged(map, 2, is_aware.then_some(body)).points);
        points.chunks_exact(3).take(6).map(|p| p[0] / delta).collect()
    };
    let close = |got: &[f32], expected: &[f32]| got.iter().zip(expected).all(|(g, e)| (g - e).abs() < 1e-3);
    let plain = row(false, 1000.0);
    assert!(close(&plain, &[1.0, 1.25, 1.75, 251.5, 750.5, 1000.0]), "{plain:?}");
    // The fourth pixel is three quarters body, the fifth one quarter: both are the second body point.
    let aware = row(true, 1000.0);
    assert!(close(&aware, &[1.0, 1.25, 1.75, 2.0, 2.0, 1000.0]), "{aware:?}");
    let overflowed = row(true, f32::INFINITY);
    assert!(close(&overflowed[..5], &aware[..5]), "{overflowed:?}");
}

#[test]
fn concatenation_puts_the_front_first() {
    let Some(device) = device() else { return };
    let config = config(&["network.fusion=concat", "network.head=linear"]);
    let net = weights(&config, 2).1.point_predictor(&device).expect("weights");
    let NetworkConfig { dec_dim: width, dec_depth, .. } = config.network;
    let tokens =
        |seed| Tensor::<3>::from_data(TensorData::new(noise(4 * width, seed), [1, 4, width]), &device);
    let maps = |x: Tensor<3>| vec![x; dec_depth + 1];
    let zero = || Tensor::<3>::zeros([1, 4, width], &device);
    let right = |front: Tensor<3>, back: Tensor<3>| {
        net.raw(&Decoded::Tokens([maps(front), maps(back)], [2, 2])).swap_remove(View::Right as usize)
    };
    // A linear head is affine: the contributions of both halves add up. Their matrices differ.
    let both = values(right(tokens(1), tokens(2)) + right(zero(), zero()));
    let halves = values(right(tokens(1), zero()) + right(zero(), tokens(2)));
    assert!(relative_error(&both, &halves) < 1e-5);
    assert!(relative_error(&values(right(tokens(1), zero())), &values(right(zero(), tokens(1)))) > 0.1);
}

/// Points of up to e⁶⁰ units (‖(35, 35, 35)‖ ≈ 60). Their squares overflow, the Gaussians must not.
#[test]
fn points_of_extreme_size_give_finite_gaussians() {
    let Some(device) = device() else { return };
    let config = config(&["network.conf_threshold=0.4"]);
    for bias in [-30.0_f32, 1e-38, 20.0, 35.0] {
        let (file, _) = weights(&config, 4);
        for head in 1..=4 {
            set_tensor(file.path(), &format!("dust3r.downstream_head{head}.dpt.head.4.bias"), &[bias; 3]);
        }
        let weights = WeightFile::open(file.path(), None).expect("our file");
        let model = Reconstructor::load(&weights, &device).expect("weights");
        let side = config.network.resolution;
        let result = model.reconstruct([&photograph(side, 1), &photograph(side, 2)], &|_| ());
        let pixels = result.valid.iter().flatten().filter(|v| **v).count();
        assert!(pixels > 1000, "bias {bias}: {pixels}");
        assert_eq!(result.gaussians.len(), pixels, "bias {bias}: {:?}", result.steps);
        let world = result.in_world(&config);
        for values in
            [values(world.means), values(world.rotations), values(world.scales), values(world.colors)]
        {
            assert!(values.iter().all(|v| v.is_finite()), "bias {bias}");
        }
    }
}

/// Two photographs of three channels, for patches of 16 pixels.
fn pair(front: Tensor<4>, back: Tensor<4>) -> Input {
    let [_, _, h, w] = front.dims();
    Input { images: Tensor::cat(vec![front, back], 0), grid: [h / 16, w / 16] }
}

#[test]
fn every_fusion_and_head_gives_points_of_its_own_on_oblong_pictures() {
    let Some(device) = device() else { return };
    let image =
        |seed| Tensor::<4>::from_data(TensorData::new(noise(3 * 48 * 80, seed), [1, 3, 48, 80]), &device);
    let mut seen: Vec<Vec<f32>> = Vec::new();
    for head in ["dpt", "linear"] {
        for fusion in ["mean", "concat"] {
            let config = config(&[&format!("network.head={head}"), &format!("network.fusion={fusion}")]);
            let (_file, weights) = weights(&config, 2);
            let net = weights.point_predictor(&device).expect("weights");
            let maps = net.forward(pair(image(1), image(2)), &Window::whole(64));
            assert_eq!(maps.len(), 4);
            let right = values(maps[2].1.points.clone());
            assert_eq!(maps[2].1.points.dims(), [1, 48, 80, 3]);
            assert!(right.iter().all(|v| v.is_finite()));
            assert!(!seen.contains(&right), "{head} {fusion} computes what another variant computes");
            seen.push(right);
        }
        let config = config(&[&format!("network.head={head}"), "network.side_heads=false"]);
        let (_file, weights) = weights(&config, 2);
        let net = weights.point_predictor(&device).expect("weights");
        assert_eq!(net.forward(pair(image(1), image(2)), &Window::whole(64)).len(), 2);
    }
}

#[test]
fn the_worlds_frames_are_upright_or_the_demos_mirror_image() {
    let Some(device) = device() else { return };
    let point = |overrides: &[&str]| {
        let config = config(overrides);
        let result = reconstruct(&config, &device);
        (values(result.gaussians.means.clone()), values(result.in_world(&config).means))
    };
    let (camera, world) = point(&["mode.compat=true"]);
    assert!(!camera.is_empty() && camera.len() == world.len());
    for (c, w) in camera.chunks_exact(3).zip(world.chunks_exact(3)) {
        let expected = [-c[0], -c[1], 2.0 - c[2]];
        assert!(w.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{c:?} {w:?}");
    }
    let (camera, world) = point(&[]);
    assert!(!camera.is_empty() && camera.len() == world.len());
    let rig = snapsnap_splat::Camera::orbit_at_yaw_degrees(0.0, 128).world_to_camera.inverse();
    for (c, w) in camera.chunks_exact(3).zip(world.chunks_exact(3)) {
        let expected = rig.apply(glam::DVec3::new(c[0].into(), c[1].into(), c[2].into()));
        assert!((0..3).all(|k| (f64::from(w[k]) - expected[k]).abs() < 1e-5), "{c:?} {w:?}");
    }
}

#[test]
fn two_runs_give_the_same_bits() {
    let Some(device) = device() else { return };
    let config = config(&["network.conf_threshold=0.4"]);
    // On GPUs the first run chooses the kernels by trial.
    reconstruct(&config, &device);
    let runs = [(); 2].map(|()| reconstruct(&config, &device));
    let [a, b] = runs.each_ref().map(|r| values(r.in_world(&config).means));
    assert!(!a.is_empty());
    assert!(a == b, "means differ");
    let [a, b] = runs.map(|r| values(r.gaussians.rotations));
    assert!(a == b, "rotations differ");
}

#[test]
fn a_scene_without_side_heads_runs_neither_sides_nor_neighbour_search() {
    let Some(device) = device() else { return };
    let result = reconstruct(&config(&["network.side_heads=false"]), &device);
    assert_eq!(result.views, [View::Front, View::Back]);
    assert!(result.side_images.is_empty());
    let ran: Vec<&str> = result.times.iter().map(|(name, _)| *name).collect();
    assert!(!ran.contains(&"side colours") && !ran.contains(&"regressor (sides)"), "{ran:?}");
    assert!(result.steps.contains(&Step::NoSideColors { as_asked: false }), "{:?}", result.steps);
}

#[test]
fn a_second_regressor_sees_the_sides_only() {
    let Some(device) = device() else { return };
    let one = config(&["network.conf_threshold=0.0"]);
    let two = config(&["network.conf_threshold=0.0", "regressor.networks=2"]);
    let [one, two] = [one, two].map(|config| reconstruct(&config, &device));
    let fronts = 4 * one.valid[..2].iter().flatten().filter(|v| **v).count();
    let [one, two] = [one, two].map(|r| values(r.gaussians.rotations));
    assert_same("front and back", &one[..fronts], &two[..fronts]);
    assert_different("sides", &one[fronts..], &two[fronts..]);
}
