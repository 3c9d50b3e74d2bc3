//! Training steps: equal on every device, with gradients that finite differences confirm.

use std::collections::BTreeMap;
use std::slice::from_ref;
use std::sync::Arc;

use burn::data::dataset::Dataset;
use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::prepare::DataConfig;
use snapsnap_net::config::{Anchor, Body, Precision, Sides};
use snapsnap_net::network::{PointMap, View, activate};
use snapsnap_net::weights::{random_predictor, random_regressors};
use snapsnap_net::{Prediction, Window};
use snapsnap_people::{Detail, synth};
use snapsnap_tests::{TRAINING, device, device_name, is_software, real_device, relative_error, values};
use snapsnap_train::config::TrainConfig;
use snapsnap_train::gradients;
use snapsnap_train::networks::{Networks, Rows};
use snapsnap_train::points::losses;
use snapsnap_train::stage1::PointTask;
use snapsnap_train::stage2::{self, GaussianTask};
use snapsnap_train::task::{Moment, Task};

fn config() -> TrainConfig {
    // The smaller network size includes interpolation. Confidences of random weights are near ½.
    const OTHER: [&str; 4] = [
        "network.net_resolution=32",
        "network.conf_threshold=0.4",
        "training.validation_samples=0",
        "training.seed=3",
    ];
    TrainConfig::from_toml(TRAINING, "the tests' config", &OTHER.map(String::from)).expect("a config")
}

/// A data set of two people.
fn people(root: &std::path::Path) -> Arc<Folder> {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution) = (4, 64);
    config.views.second_depth = true;
    // With most other people, rounding alone turns AdamW's first step around for elements of almost no gradient.
    let person = |index: usize| {
        (Split::Train, format!("{index:04}"), synth::person(&format!("stride/{index}"), None, Detail::Fine))
    };
    config.make(&root.join("people"), "test", (0..2).map(person)).expect("makes")
}

/// The device that is compared with flex.
fn other_device() -> Option<Device> {
    if device_name() == "flex" {
        println!("SKIPPED: flex is the reference of this comparison");
        return None;
    }
    device()
}

/// The loss of a batch of two.
fn loss<T: Task>(task: &T, networks: &Networks) -> Tensor<1> {
    let samples = task.data().pass(0);
    let items = vec![samples.get(0).expect("reads"), samples.get(1).expect("reads")];
    let at = Moment { extent: task.extent(&items), ..Moment::default() };
    let parts = task.losses(networks, items, at).expect("a loss");
    let weighted: Vec<Tensor<1>> = parts.into_iter().map(|part| part.value * part.weight).collect();
    Tensor::cat(weighted, 0).sum()
}

/// Loss, gradients and weights after a step.
fn step<T: Task>(task: &T, networks: Networks) -> (f64, Rows, Networks) {
    let loss = loss(task, &networks);
    let value = f64::from(loss.clone().into_scalar::<f32>());
    let rows = gradients::collect(&networks, &mut loss.backward());
    let factor = gradients::clip_factor(gradients::norm(&rows), 1.0).expect("finite");
    let after = config().optimizer.init(false).step(1.0, &networks, rows.clone(), factor);
    (value, rows, networks.with_rows(&after))
}

fn compare(stage: &str, on: impl Fn(&Device) -> (f64, Rows, Networks), device: &Device) {
    let (rows, after, expected_after) = compare_gradients(stage, on, device);
    compare_weights(stage, &rows, &after, &expected_after);
}

/// Compares losses and gradients. Returns `flex`'s gradients, and the networks after a step on both devices.
fn compare_gradients(
    stage: &str,
    on: impl Fn(&Device) -> (f64, Rows, Networks),
    device: &Device,
) -> (Rows, Networks, Networks) {
    let ((loss, rows, after), (expected, expected_rows, expected_after)) =
        (on(&device.clone().autodiff()), on(&Device::flex().autodiff()));
    assert!((loss - expected).abs() <= 1e-5 * expected, "{stage}: loss {loss} instead of {expected}");
    assert_eq!(rows.len(), expected_rows.len());
    let total: f64 = gradients::norm(&expected_rows);
    let mut worst = (0.0, String::new());
    for (name, expected) in &expected_rows {
        let (got, expected) = (values(rows[name].clone()), values(expected.clone()));
        let norm = expected.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        // Biases in front of a normalisation have no gradient; rounding leaves some.
        if norm > 1e-5 * total {
            let error = relative_error(&got, &expected);
            assert!(error <= 1e-4, "{stage}: {name}: {error:e}");
            worst = if error > worst.0 { (error, name.clone()) } else { worst };
        }
    }
    println!("{stage}: {} gradients, relative error up to {:.1e} ({})", rows.len(), worst.0, worst.1);
    (expected_rows, after, expected_after)
}

fn compare_weights(stage: &str, expected_rows: &Rows, after: &Networks, expected_after: &Networks) {
    let total: f64 = gradients::norm(expected_rows);
    let (got, expected) = (after.checkpoint(), expected_after.checkpoint());
    for (name, expected) in expected {
        // AdamW's first step has the same length for a rounding error as for any other gradient.
        let Some(row) = expected_rows.get(&name) else {
            // The first unit of the coarsest fusion never runs.
            assert_eq!(got[&name], expected, "{stage}: {name} has no gradient");
            continue;
        };
        let norm = values(row.clone()).iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
        let size = expected.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        if norm.sqrt() > 1e-3 * total && size > 1e-3 {
            // So has a single weight whose gradient is rounding alone, such as a bias of the keys.
            let gradient = values(row.clone());
            let least = 1e-4 * gradient.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
            let moved = |of: &[f32]| -> Vec<f32> {
                of.iter().zip(&gradient).filter(|(_, g)| g.abs() > least).map(|(v, _)| *v).collect()
            };
            let error = relative_error(&moved(&got[&name]), &moved(&expected));
            assert!(error <= 1e-4, "{stage}: {name} after a step: {error:e}");
        }
    }
}

/// The config as it is: a transformer with colours as its only channels.
const TRANSFORMER: fn(&mut TrainConfig) = |_| {};
const CONVOLUTION: fn(&mut TrainConfig) = |config| {
    let network = &mut config.network;
    network.body = Body::Convolution;
    (network.mask_channel, network.ray_channels, network.mirror) = (true, true, true);
};
const COMPLETED: fn(&mut TrainConfig) = |config| {
    CONVOLUTION(config);
    let network = &mut config.network;
    (network.anchor, network.patch, network.sides) = (Anchor::Ray, 8, Sides::Completed);
    (network.second_layer, network.side_dims) = (true, [4, 4, 8, 8]);
};

#[test]
fn a_step_of_stage_1_is_the_same_on_every_device() {
    let Some(device) = other_device() else { return };
    if is_software(&device) {
        println!(
            "SKIPPED: takes minutes on a software adapter; the test of stage 2 includes this loss there"
        );
        return;
    }
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = people(temporary.path());
    for (body, change) in
        [("transformer", TRANSFORMER), ("convolution", CONVOLUTION), ("completed sides", COMPLETED)]
    {
        let mut config = config();
        change(&mut config);
        let on = |device: &Device| {
            let task = PointTask::new(from_ref(&folder), &config, device).expect("a task");
            let predictor = Some(random_predictor(&config.networks(), 3, device));
            step(&task, Networks { predictor, regressors: Vec::new() })
        };
        compare(&format!("stage 1, {body}"), on, &device);
    }
}

#[test]
fn a_step_of_stage_2_is_the_same_on_every_device() {
    let Some(device) = other_device() else { return };
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = people(temporary.path());
    for (what, joint, sides) in [
        ("stage 2", false, true),
        ("stage 2, joint", true, true),
        ("stage 2, joint, without sides", true, false),
    ] {
        if !(joint && sides) && is_software(&device) {
            println!("SKIPPED: a software adapter trains both networks together only, with sides");
            continue;
        }
        let mut config = config();
        config.stage2.points_weight = if joint { 1.0 } else { 0.0 };
        config.network.side_heads = sides;
        config.regressor.networks = if sides { config.regressor.networks } else { 1 };
        let networks = config.networks();
        // The geometric start has a last layer of zeros, which leaves the other layers without gradients.
        let mut published = networks.clone();
        published.regressor.start = None;
        let on = |device: &Device| {
            let predictor = |device: &Device| random_predictor(&networks, 3, device);
            let frozen = predictor(&device.clone().inner());
            let task = GaussianTask::new(from_ref(&folder), &config, Some(frozen), device);
            let regressors = random_regressors(&published, 4, device);
            let predictor = joint.then(|| predictor(device));
            step(&task.expect("a task"), Networks { predictor, regressors })
        };
        if sides {
            compare(what, on, &device);
        } else {
            // No comparison of weights: AdamW's first step is as long for rounding errors.
            compare_gradients(what, on, &device);
        }
    }
}

/// Losses and gradients of a predictor in 16 bits are those in 32 bits, but for rounding.
#[test]
fn sixteen_bits_have_the_same_gradients_but_for_rounding() {
    let Some(device) = real_device() else { return };
    let temporary = tempfile::tempdir().expect("temporary folder");
    let (folder, config, device) = (people(temporary.path()), config(), device.autodiff());
    let predictor = Some(random_predictor(&config.networks(), 3, &device));
    let networks = Networks { predictor, regressors: Vec::new() };
    let task = PointTask::new(from_ref(&folder), &config, &device).expect("a task");
    let made = |precision: Precision| {
        let loss = loss(&task, &networks.in_precision(precision));
        let value = f64::from(loss.clone().into_scalar::<f32>());
        let rows = gradients::collect(&networks, &mut loss.backward());
        (value, rows.into_iter().map(|(name, row)| (name, values(row))).collect::<BTreeMap<_, _>>())
    };
    let (loss, gradients) = made(Precision::F32);
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let total = gradients.values().map(|row| dot(row, row)).sum::<f64>();
    if !device.supports_dtype(Precision::Bf16.dtype()) {
        println!("SKIPPED: the device does not compute in bf16");
        return;
    }
    let (low, rough) = made(Precision::Bf16);
    assert_ne!(low, loss, "it was computed in f32");
    let off = (low - loss).abs() / loss;
    let (mut apart, mut count) = (0.0_f64, 0);
    for (name, row) in &gradients {
        // Contributions of pixels that cancel out leave nothing but rounding.
        if dot(row, row) > 1e-4 * total {
            let rough = &rough[name];
            let sine = 1.0 - dot(row, rough) / (dot(row, row) * dot(rough, rough)).sqrt();
            // Rounding also carries values over the kinks of ReLU and of distances, with any number of bits.
            assert!(sine <= 2e-3, "{name}: 1 − cosine {sine:.1e}");
            (apart, count) = (apart.max(sine), count + 1);
        }
    }
    println!("loss {off:.1e} off, {count} gradients, 1 − cosine ≤ {apart:.1e}");
    assert!(off <= 5e-5, "loss {off:e} off");
}

/// Random values in `range`, as many as a tensor of `shape` has.
fn random(shape: &[usize], range: std::ops::Range<f64>, seed: u64) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..shape.iter().product()).map(|_| random.random_range(range.clone())).collect()
}

fn tensor<const D: usize>(values: &[f64], shape: [usize; D]) -> Tensor<D> {
    let device = Device::flex().autodiff();
    Tensor::from_data(TensorData::new(values.to_vec(), shape), (&device, DType::F64))
}

/// Compares the gradient of `loss` with central differences, all in f64.
fn check<const D: usize>(
    what: &str,
    point: &[f64],
    shape: [usize; D],
    loss: impl Fn(Tensor<D>) -> Tensor<1>,
) {
    const STEP: f64 = 1e-6;
    let x = tensor(point, shape).require_grad();
    let gradient: Vec<f64> =
        x.grad(&loss(x.clone()).backward()).expect("tracked").into_data().try_into_vec().expect("f64");
    let at = |i: usize, step: f64| -> f64 {
        let mut moved = point.to_vec();
        moved[i] += step;
        loss(tensor(&moved, shape)).into_data().try_into_vec::<f64>().expect("f64")[0]
    };
    let largest = gradient.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
    assert!(largest > 0.0, "{what}: no gradient");
    for (i, gradient) in gradient.iter().enumerate() {
        let expected = (at(i, STEP) - at(i, -STEP)) / (2.0 * STEP);
        let off = (gradient - expected).abs();
        assert!(off <= 1e-6 * largest.max(1.0), "{what}, value {i}: {gradient} instead of {expected}");
    }
}

#[test]
fn gradients_of_the_losses_are_finite_differences() {
    let (h, w) = (4, 5);
    let config = config().networks();
    let mut published = config.clone();
    published.network.anchor = Anchor::None;
    let truth = tensor(&random(&[2, 1, h, w, 3], -1.0..1.0, 1), [2, 1, h, w, 3]);
    let valid: Vec<f64> = random(&[2, 1, h, w], 0.0..1.0, 2).iter().map(|v| f64::from(*v > 0.4)).collect();
    let valid = tensor(&valid, [2, 1, h, w]);
    for (name, config) in [("ray", &config), ("published", &published)] {
        let stage1 = |raw: Tensor<4>| {
            let PointMap { points, conf } = activate(raw, &config.network);
            let window = Window { rows: 0..h, columns: 0..w };
            let maps = vec![(View::Front, PointMap { points, conf })];
            let prediction = Prediction { window, maps };
            let parts = losses(&prediction, &truth, &valid, 1.0);
            assert_eq!(parts.len(), 3);
            parts.into_iter().map(|part| part.value * part.weight).reduce(|a, b| a + b).expect("three parts")
        };
        check(&format!("stage 1, {name}"), &random(&[2, 4, h, w], -1.5..1.5, 3), [2, 4, h, w], stage1);
    }

    let target = tensor(&random(&[1, 2, 13, 12], 0.0..1.0, 4), [1, 2, 13, 12]);
    let photometric = |image: Tensor<4>| {
        let [l1, ssim] = stage2::photometric(image, target.clone());
        l1 * 0.8 + (1.0 - ssim) * 0.2
    };
    check("photometric", &random(&[1, 2, 13, 12], 0.0..1.0, 5), [1, 2, 13, 12], photometric);
}
