//! The regressor's kernels against the plain tensor code in f64, with sizes that reach edge cases: bands that do not
//! divide, widths below a register block, strides.

use std::collections::BTreeMap;

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Device, FloatDType, Gradients, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

use super::unet::{normalise_with, statistics};
use super::{FEATURES, INPUT_CHANNELS, Regressor};
use crate::config::{Config, RECEPTIVE_RADIUS};
use crate::weights::{NamedVisitor, ParameterPath, random_regressors, visit_named};
use crate::window::Window;

/// Relative L2 error of features. Kernels sum some hundred terms; rounding in f32 stays below a few 1e-6.
const FEATURE: f64 = 5e-6;
/// Relative L2 error of gradients. Normalisations at a quarter of the size, with some fifteen pixels, are the worst.
/// PyTorch in f32 reaches 6.8e-6 on larger images.
const GRADIENT: f64 = 2e-5;

/// Uniform in ±1; the same numbers on every run.
fn random<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let values = (0..shape.iter().product()).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0);
    Tensor::from_data(TensorData::new(values.collect::<Vec<f32>>(), shape), device)
}

/// Changes the float type of all parameters, and adds noise, since initial values are special (0 and 1 in norms).
struct Changed {
    float: FloatDType,
    seed: u64,
}

impl ModuleMapper for Changed {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, values, mapper) = param.consume();
        self.seed += 1;
        let values = values.inner();
        let values = values.clone() + random(values.dims(), self.seed, &values.device()) * 0.2;
        Param::from_mapped_value(id, Tensor::from_inner(values.cast(self.float)).require_grad(), mapper)
    }
}

/// The same regressor in f32 and in f64.
fn regressors(device: &Device) -> [Regressor; 2] {
    let regressor = random_regressors(&Config::default(), 5, device).remove(0);
    [FloatDType::F32, FloatDType::F64].map(|float| regressor.clone().map(&mut Changed { float, seed: 100 }))
}

fn values<const D: usize>(x: Tensor<D>) -> Vec<f64> {
    x.into_data().convert::<f64>().try_into_vec().expect("f64")
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Relative L2 error.
fn error(got: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    norm(&got.iter().zip(expected).map(|(a, b)| a - b).collect::<Vec<_>>()) / norm(expected)
}

/// Gradients of all parameters, by their names.
fn gradients(regressor: &Regressor, gradients: &Gradients) -> BTreeMap<String, Vec<f64>> {
    struct Collect<'a>(&'a Gradients, BTreeMap<String, Vec<f64>>);
    impl NamedVisitor for Collect<'_> {
        fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
            let gradient = parameter.val().grad(self.0).expect("every parameter counts");
            self.1.insert(path.name(), values(gradient));
        }
    }
    let mut collect = Collect(gradients, BTreeMap::new());
    visit_named(regressor, "", &mut collect);
    collect.1
}

#[test]
fn kernels_equal_the_plain_network_forward_and_backward() {
    let device = Device::flex().autodiff();
    for [b, height, width] in [[1, 32, 44], [2, 20, 12], [3, 32, 8], [1, 36, 68], [1, 8, 140], [1, 96, 160]] {
        let what = format!("{b}×{height}×{width}");
        let upstream = random([b, height, width, FEATURES], 3, &device);
        // Means away from 0, as z ≈ 2 m is.
        let image = random([b, 6, height, width], 2, &device) + 1.0;
        let [fast, plain] = regressors(&device);
        let run = |regressor: &Regressor, float: FloatDType| {
            let input = image.clone().cast(float).require_grad();
            let features = regressor.forward(input.clone());
            let all = (features.clone() * upstream.clone().cast(float)).sum().backward();
            let of_input = values(input.grad(&all).expect("tracked"));
            (values(features), of_input, gradients(regressor, &all))
        };
        let (features, of_input, got) = run(&fast, FloatDType::F32);
        let (expected_features, expected_of_input, expected) = run(&plain, FloatDType::F64);
        let errors = [error(&features, &expected_features), error(&of_input, &expected_of_input)];
        println!("{what}: features {:e}, input {:e}", errors[0], errors[1]);
        assert!(errors[0] < FEATURE && errors[1] < GRADIENT, "{what}: {errors:?}");
        // Biases in front of a normalisation of single channels have no gradient; rounding leaves some.
        let typical = expected.values().map(|g| norm(g)).sum::<f64>() / expected.len() as f64;
        for (name, expected) in &expected {
            let vanishes = norm(expected) < 1e-6 * typical;
            let error = if vanishes { norm(&got[name]) / typical } else { error(&got[name], expected) };
            assert!(error < GRADIENT, "{what}: {name} {error:e}");
        }
    }
}

/// With the group norms' statistics of the whole image, so that only the pixels of the window count.
#[test]
fn cropping_changes_nothing_inside_the_mask_with_the_same_statistics() {
    let device = Device::flex().autodiff();
    let [_, regressor] = regressors(&device);
    let (regressor, side) = (regressor.no_grad(), 288);
    let mut mask = vec![false; side * side];
    for y in 126..162 {
        mask[y * side + 130..y * side + 158].fill(true);
    }
    let person = Window::around([mask.as_slice()].into_iter(), side).expect("pixels");
    let image = random([1, INPUT_CHANNELS, side, side], 5, &device).cast(FloatDType::F64);
    let inside = |features: Tensor<4>, window: &Window| -> Vec<f64> {
        let features = values(features);
        let rows = window.indices(&mask, side);
        rows.iter().flat_map(|&i| features[i as usize * FEATURES..][..FEATURES].to_vec()).collect()
    };
    let mut layers = Vec::new();
    let whole = regressor.composed(image.clone(), &mut |norm, x| {
        layers.push(statistics(norm, &x));
        normalise_with(norm, x, layers[layers.len() - 1].clone())
    });
    let expected = inside(whole, &Window::whole(side));
    let cropped = |window: &Window| {
        let mut layers = layers.iter().cloned();
        let features = regressor.composed(window.cut(image.clone()), &mut |norm, x| {
            normalise_with(norm, x, layers.next().expect("as many norms"))
        });
        error(&inside(features, window), &expected)
    };
    let padded = person.padded(RECEPTIVE_RADIUS, side);
    assert!(padded.rows.len() < side && padded.columns.len() < side, "the window is a real crop");
    let apart = cropped(&padded);
    println!("cropped with a margin of {RECEPTIVE_RADIUS} pixels: relative error {apart:.2e}");
    assert!(apart < 1e-6, "{apart:e}");
    // Without the margin there is a difference, so the test can fail.
    let apart = cropped(&Window { rows: 124..164, columns: 128..160 });
    println!("cropped without a margin: relative error {apart:.2e}");
    assert!(apart > 1e-4, "{apart:e}");
}

/// Features, and gradients by the input and by the parameters, where tracked.
type Pass = (Vec<f64>, Option<Vec<f64>>, Option<BTreeMap<String, Vec<f64>>>);

/// A pass of the kernels with some of its inputs tracked.
fn pass(track_input: bool, track_parameters: bool) -> Pass {
    let (device, size) = (Device::flex().autodiff(), [2, 36, 68]);
    let [b, height, width] = size;
    let [mut regressor, _] = regressors(&device);
    if !track_parameters {
        regressor = regressor.no_grad();
    }
    let input = (random([b, 6, height, width], 2, &device) + 1.0).set_require_grad(track_input);
    let features = regressor.forward(input.clone());
    let got = values(features.clone());
    if !track_input && !track_parameters {
        return (got, None, None);
    }
    let all = (features * random([b, height, width, FEATURES], 3, &device)).sum().backward();
    let by_input = track_input.then(|| values(input.grad(&all).expect("tracked")));
    (got, by_input, track_parameters.then(|| gradients(&regressor, &all)))
}

#[test]
fn what_is_not_tracked_changes_no_bit_of_the_rest() {
    let (features, by_input, by_parameters) = pass(true, true);
    assert_eq!(pass(true, false), (features.clone(), by_input, None));
    assert_eq!(pass(false, true), (features.clone(), None, by_parameters));
    assert_eq!(pass(false, false), (features, None, None));
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| pass(true, true))
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}
