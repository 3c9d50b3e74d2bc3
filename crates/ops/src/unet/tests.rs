//! Passes that leave something out, and passes on other numbers of threads, give the same bits. The values themselves are
//! compared where the layers are defined, in the crate of the networks.

use std::collections::HashMap;

use super::{FEATURES, INPUT_CHANNELS, Network, Saved};
use crate::conv::{CHANNELS, Wanted};
use crate::tests::uniform as random;

const BOTH: Wanted = Wanted { input: true, parameters: true };

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

#[test]
fn untracked_sides_cost_nothing_and_change_nothing() {
    let (network, size) = (network(16), [2, 12, 20]);
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let upstream = random(2 * 12 * 20 * FEATURES, 3);
    let forward = network.forward(&parameters, &input, size, None, true);
    let run = |wanted| network.backward(&parameters, &input, kept(forward.saved.clone()), &upstream, wanted);
    let both = run(BOTH);
    let only_input = run(Wanted { input: true, parameters: false });
    let only_parameters = run(Wanted { input: false, parameters: true });
    assert_eq!(only_input.input, both.input);
    assert_eq!(only_parameters.parameters, both.parameters);
    assert!(only_input.parameters.is_empty() && only_parameters.input.is_empty());
}

#[test]
fn a_pass_that_keeps_nothing_computes_the_same() {
    let (network, size) = (network(8), [2, 12, 20]);
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let run = |keep| network.forward(&parameters, &input, size, None, keep);
    let (kept, released) = (run(true), run(false));
    assert!(released.saved.is_none());
    assert_eq!((kept.features, kept.statistics), (released.features, released.statistics));
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let (network, size) = (network(8), [2, 36, 68]);
    let (parameters, input) = (parameters(&network, 1), images(size, 2));
    let upstream = random(2 * 36 * 68 * FEATURES, 3);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| {
            let forward = network.forward(&parameters, &input, size, None, true);
            let gradients = network.backward(&parameters, &input, kept(forward.saved), &upstream, BOTH);
            [forward.features, gradients.input, gradients.parameters]
        })
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}
