//! The fused passes against the authors' network, against a plain f64 network, and that one against differences.

use std::collections::HashMap;

use rand::{RngCore, SeedableRng};

use super::reference::Reference;
use super::{FEATURES, INPUT_CHANNELS, Network, Saved};
use crate::buffers::Buffers;
use crate::conv::{CHANNELS, Layer, Wanted};

const BOTH: Wanted = Wanted { input: true, parameters: true };
/// Expected of every tensor's relative L2 error at the fixture's size. The worst are normalisations at a quarter of the
/// size, 9.1e-6; PyTorch in f32 reaches 6.8e-6 there.
const GRADIENT: f64 = 1e-5;
/// The same for images of a few hundred pixels, whose quarter holds fifteen: 1.1e-5 with another image's statistics.
const TINY: f64 = 2e-5;

/// Uniform in ±1; the same numbers on every run.
fn random(n: usize, seed: u64) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0).collect()
}

/// The published network with normalisations of so many groups.
fn network(groups: usize) -> Network {
    let mut shapes = HashMap::new();
    let mut layer = |name: String, weight: &[usize]| {
        shapes.insert(format!("{name}.weight"), weight.to_vec());
        shapes.insert(format!("{name}.bias"), vec![weight[0]]);
    };
    layer("conv_in".into(), &[CHANNELS, INPUT_CHANNELS, 3, 3]);
    layer("norm_out".into(), &[CHANNELS]);
    layer("conv_out".into(), &[FEATURES, CHANNELS, 3, 3]);
    layer("gs_conv".into(), &[FEATURES, FEATURES, 1, 1]);
    for i in 0..2 {
        layer(format!("down_blocks.{i}.downsample"), &[CHANNELS, CHANNELS, 3, 3]);
        layer(format!("up_blocks.{i}.upsample"), &[CHANNELS, CHANNELS, 3, 3]);
    }
    let of = |part: &str, nets: usize| (0..nets).map(|i| format!("{part}.nets.{i}")).collect::<Vec<_>>();
    let plain = (0..3).flat_map(|level| of(&format!("down_blocks.{level}"), 2)).chain(of("mid_block", 2));
    let skipping = (0..3).flat_map(|level| of(&format!("up_blocks.{level}"), 3));
    let plain = plain.map(|name| (name, CHANNELS));
    for (name, from) in plain.chain(skipping.map(|name| (name, 2 * CHANNELS))) {
        layer(format!("{name}.norm1"), &[from]);
        layer(format!("{name}.conv1"), &[CHANNELS, from, 3, 3]);
        layer(format!("{name}.norm2"), &[CHANNELS]);
        layer(format!("{name}.conv2"), &[CHANNELS, CHANNELS, 3, 3]);
        if from > CHANNELS {
            layer(format!("{name}.shortcut"), &[CHANNELS, from, 1, 1]);
        }
    }
    Network::new(groups, &shapes)
}

fn kept(saved: Option<Saved>) -> Saved {
    saved.expect("kept for the backward pass")
}

/// Weights of a size that keeps signals alive, normalisations near 1.
fn parameters(network: &Network, seed: u64) -> Vec<f32> {
    let mut values = random(network.parameters(), seed);
    for tensor in network.tensors() {
        let inputs: usize = tensor.shape[1..].iter().product();
        for value in &mut values[tensor.range.clone()] {
            *value = match tensor.shape.len() {
                4 => *value * (3.0 / inputs as f32).sqrt(),
                _ if tensor.name.contains("norm") && tensor.name.ends_with("weight") => 1.0 + 0.5 * *value,
                _ => 0.3 * *value,
            };
        }
    }
    values
}

/// Inputs `[B, h, w, 6]` whose means are away from 0, as z ≈ 2 m is.
fn images([b, h, w]: [usize; 3], seed: u64) -> Vec<f32> {
    random(b * h * w * INPUT_CHANNELS, seed).iter().map(|x| x + 1.0).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Relative L2 error.
fn error(got: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let difference: Vec<f64> = got.iter().zip(expected).map(|(a, b)| f64::from(*a) - b).collect();
    norm(&difference) / norm(expected)
}

/// Every tensor's gradient against its expected value. Biases in front of a normalisation of single channels have none:
/// what rounding leaves is compared with the other biases' gradients instead.
fn compare(what: &str, network: &Network, got: &[f32], expected: &[f64], bound: f64) {
    let biases = network.tensors().iter().filter(|t| t.shape.len() == 1);
    let norms: Vec<f64> = biases.map(|t| norm(&expected[t.range.clone()])).collect();
    let typical = norms.iter().sum::<f64>() / norms.len() as f64;
    let mut worst = (0.0, "");
    for tensor in network.tensors() {
        let (got, expected) = (&got[tensor.range.clone()], &expected[tensor.range.clone()]);
        let vanishes = norm(expected) < 1e-6 * typical;
        let error = if vanishes { norm(&wide(got)) / typical } else { error(got, expected) };
        if error > worst.0 {
            worst = (error, &tensor.name);
        }
    }
    println!("{what}: worst parameter {} {:e}", worst.1, worst.0);
    assert!(worst.0 < bound, "{what}: {} {:e}", worst.1, worst.0);
}

/// Statistics of image `i`, as the plain network reads them.
fn of_sample(layers: &[Layer], groups: usize, i: usize) -> Vec<[Vec<f64>; 2]> {
    let part = |values: &Vec<f32>| wide(&values[i * groups..(i + 1) * groups]);
    layers.iter().map(|layer| layer.each_ref().map(part)).collect()
}

/// Features, input gradient and parameter gradient of the plain network.
fn plain(
    network: &Network,
    parameters: &[f32],
    input: &[f32],
    [b, h, w]: [usize; 3],
    frozen: Option<&[Layer]>,
    upstream: &[f32],
) -> [Vec<f64>; 3] {
    let (parameters, input, upstream) = (wide(parameters), wide(input), wide(upstream));
    let [mut features, mut inputs, mut sum] = [Vec::new(), Vec::new(), vec![0.0; parameters.len()]];
    for i in 0..b {
        let frozen = frozen.map(|layers| of_sample(layers, network.groups, i));
        let mut reference = Reference::new(network, &parameters, frozen);
        let n = h * w * INPUT_CHANNELS;
        features.extend(reference.forward(&input[i * n..(i + 1) * n], [h, w]));
        let n = h * w * FEATURES;
        inputs.extend(reference.backward(&upstream[i * n..(i + 1) * n]));
        sum.iter_mut().zip(&reference.gradient).for_each(|(a, b)| *a += b);
    }
    [features, inputs, sum]
}

#[test]
fn gradients_equal_those_of_the_plain_network() {
    for (groups, [b, h, w], freeze) in [
        (16, [1, 12, 20], false),
        (8, [2, 20, 12], false),
        (4, [3, 4, 8], false),
        (1, [1, 36, 68], false),
        (16, [2, 12, 20], true),
        (4, [1, 8, 140], true),
    ] {
        let (network, buffers) = (network(groups), Buffers::default());
        let size = [b, h, w];
        let parameters = parameters(&network, 1);
        let input = images(size, 2);
        let upstream = random(b * h * w * FEATURES, 3);
        let other = freeze
            .then(|| network.forward(&parameters, &images(size, 4), size, None, true, &buffers).statistics);
        let frozen = other.as_deref();
        let forward = network.forward(&parameters, &input, size, frozen, true, &buffers);
        let got = network.backward(&parameters, &input, kept(forward.saved), &upstream, BOTH, &buffers);
        let [features, inputs, sum] = plain(&network, &parameters, &input, size, frozen, &upstream);
        let what = format!("{groups} groups, {size:?}, frozen {freeze}");
        let errors = [error(&forward.features, &features), error(&got.input, &inputs)];
        println!("{what}: features {:e}, input {:e}", errors[0], errors[1]);
        assert!(errors[0] < 3e-6, "{what}: features {:e}", errors[0]);
        assert!(errors[1] < GRADIENT, "{what}: input {:e}", errors[1]);
        compare(&what, &network, &got.parameters, &sum, TINY);
    }
}

#[test]
fn the_plain_network_has_the_slopes_of_its_differences() {
    for (groups, freeze) in [(16, false), (4, false), (1, true)] {
        let network = network(groups);
        let [h, w] = [12, 20];
        let values = wide(&parameters(&network, 5));
        let input = wide(&images([1, h, w], 6));
        let upstream = wide(&random(h * w * FEATURES, 7));
        let frozen = freeze.then(|| {
            let mut reference = Reference::new(&network, &values, None);
            reference.forward(&wide(&images([1, h, w], 8)), [h, w]);
            reference.statistics()
        });
        let loss = |values: &[f64], input: &[f64]| {
            let out = Reference::new(&network, values, frozen.clone()).forward(input, [h, w]);
            out.iter().zip(&upstream).map(|(a, b)| a * b).sum::<f64>()
        };
        let mut reference = Reference::new(&network, &values, frozen.clone());
        reference.forward(&input, [h, w]);
        let of_input = reference.backward(&upstream);
        for seed in 0..4 {
            let direction = wide(&random(values.len(), 10 + seed));
            let aside = wide(&random(input.len(), 20 + seed));
            let moved = |step: f64| {
                let shift = |x: &[f64], d: &[f64]| -> Vec<f64> {
                    x.iter().zip(d).map(|(x, d)| x + step * d).collect()
                };
                loss(&shift(&values, &direction), &shift(&input, &aside))
            };
            let step = 1e-6;
            let difference = (moved(step) - moved(-step)) / (2.0 * step);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let slope = dot(&reference.gradient, &direction) + dot(&of_input, &aside);
            // Central differences: step² times a third derivative, and rounding of 1e-16 over the step.
            let error = (difference - slope).abs() / slope.abs().max(1.0);
            assert!(error < 1e-6, "{groups} groups, frozen {freeze}: {difference} against {slope}");
        }
    }
}

#[test]
fn untracked_sides_cost_nothing_and_change_nothing() {
    let (network, size, buffers) = (network(16), [2, 12, 20], Buffers::default());
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let upstream = random(2 * 12 * 20 * FEATURES, 3);
    let forward = network.forward(&parameters, &input, size, None, true, &buffers);
    let run = |wanted| {
        network.backward(&parameters, &input, kept(forward.saved.clone()), &upstream, wanted, &buffers)
    };
    let both = run(BOTH);
    let only_input = run(Wanted { input: true, parameters: false });
    let only_parameters = run(Wanted { input: false, parameters: true });
    assert_eq!(only_input.input, both.input);
    assert_eq!(only_parameters.parameters, both.parameters);
    assert!(only_input.parameters.is_empty() && only_parameters.input.is_empty());
}

#[test]
fn a_pass_that_keeps_nothing_computes_the_same() {
    let (network, size, buffers) = (network(8), [2, 12, 20], Buffers::default());
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let run = |keep| network.forward(&parameters, &input, size, None, keep, &buffers);
    let (kept, released) = (run(true), run(false));
    assert!(released.saved.is_none());
    assert_eq!((kept.features, kept.statistics), (released.features, released.statistics));
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let (network, size, buffers) = (network(8), [2, 36, 68], Buffers::default());
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let upstream = random(2 * 36 * 68 * FEATURES, 3);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| {
            let forward = network.forward(&parameters, &input, size, None, true, &buffers);
            let gradients =
                network.backward(&parameters, &input, kept(forward.saved), &upstream, BOTH, &buffers);
            [forward.features, gradients.input, gradients.parameters]
        })
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}
