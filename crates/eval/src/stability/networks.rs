//! Networks at the limits of number formats.

use std::sync::Arc;

use burn::tensor::{DType, Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_net::config::{Anchor, ConfMode, NetworkConfig};
use snapsnap_net::network::activate;
use snapsnap_net::precision::Precision;
use snapsnap_net::regressor::{Attributes, Regressor};
use snapsnap_net::weights::{WeightFile, WeightsError};
use snapsnap_net::{Photograph, Reconstructor};
use snapsnap_ops::{Rope, host, rotary_attention};

use super::{Case, Found, all_finite, apart, tracked, worst};
use crate::geometry::distance;
use crate::statistics::quantile;

const AREA: &str = "Networks";

/// All cases of networks except the cases in 16 bits, which need trained weights.
pub fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for norm in [0.0_f32, 1e-12, 0.29, 0.31, 20.0, 88.0, 1e4] {
        let input = format!("exponential depth at raw norm {norm:?}");
        let holds = "p = r/‖r‖·(e^‖r‖ − 1) relative to f64 as far as f32 reaches (e^88), finite beyond; gradient finite";
        // Measured: 2.0e-6 (lavapipe, at 88) and 7e-7.
        cases.push(Case::new(AREA, input, holds, [5e-6; 2], move |device| exponential_depth(norm, device)));
    }
    for (mode, name) in [(ConfMode::Sigmoid, "sigmoid"), (ConfMode::Exp, "exp")] {
        let input = format!("confidences ({name}) at ±1e4 and ±88");
        let holds = "as f64 (relative above 1), in range; finite beyond f32's reach, gradient finite";
        cases.push(Case::new(AREA, input, holds, [5e-6, 0.0], move |device| confidences(mode, device)));
    }
    let holds = "attributes finite and in range, gradient finite";
    cases.push(Case::new(AREA, "the regressor's 14 channels at ±1e4", holds, [0.0; 2], attributes));
    let tokens = [(1.0_f32, "identical tokens"), (1e4, "identical tokens of 1e4"), (1e18, "tokens of 1e18")];
    for (size, name) in tokens {
        let input = format!("attention with {name}");
        let holds = "the mean of equal values, relative; finite, gradient finite";
        cases.push(Case::new(AREA, input, holds, [1e-5, 0.0], move |device| attention(size, device)));
    }
    let input = "attention with different tokens of 1e4";
    let holds = "each token attends to itself alone, relative; finite, gradient finite";
    cases.push(Case::new(AREA, input, holds, [1e-5, 0.0], attention_to_oneself));
    let input = "the regressor on constant channels (no variance to divide by)";
    let holds = "features finite and equal wherever padding does not reach, gradient finite";
    // Relative to the largest feature; measured: 8.1e-7.
    cases.push(Case::new(AREA, input, holds, [1e-5, 0.0], constant_channels));
    cases
}

/// Cases that compare a trained predictor's points in 16 bits with its points in 32 bits, with `photographs` on its
/// canvas. The limit for nine tenths of the points is a tenth of such networks' error (docs/notes/training.md: 30 mm).
pub fn sixteen_bits(weights: WeightFile, photographs: [Photograph; 2]) -> Vec<Case> {
    let shared = Arc::new((weights, photographs));
    let case = |precision: Precision| {
        let shared = shared.clone();
        let input = format!("the given weights in {} beside f32", precision.name());
        let holds = "nine tenths of the front's and the back's points within 3 mm (values: metres); finite";
        Case::new(AREA, input, holds, [3e-3, 0.0], move |device| in_precision(&shared, precision, device))
    };
    [Precision::F16, Precision::Bf16].map(case).into()
}

fn in_precision(given: &(WeightFile, [Photograph; 2]), precision: Precision, device: &Device) -> Found {
    let (weights, [front, back]) = given;
    if !device.supports_dtype(precision.dtype()) {
        return Found::skipped(format!("the device does not compute in {}", precision.name()));
    }
    let maps = |precision: Precision| -> Result<_, WeightsError> {
        let model = Reconstructor::load(weights, device)?;
        let made = model.in_precision(precision).reconstruct([front, back], &|_| ());
        Ok((made.points.host, made.valid))
    };
    let ((whole, valid), (half, _)) =
        match maps(Precision::F32).and_then(|whole| Ok((whole, maps(precision)?))) {
            Ok(both) => both,
            Err(e) => return Found::broken(e),
        };
    let points = whole.as_chunks().0.iter().zip(half.as_chunks().0);
    let valid = points.zip(valid[..2].iter().flatten()).filter(|(_, valid)| **valid);
    let mut apart: Vec<f64> = valid.map(|((a, b), _)| distance(*a, *b)).collect();
    apart.sort_by(f64::total_cmp);
    let Some(last) = apart.last() else {
        return Found::broken("no pixel is valid");
    };
    let note = format!("median {:.2} mm, at most {:.2} mm", 1e3 * quantile(&apart, 0.5), 1e3 * last);
    Found { value: Some(quantile(&apart, 0.9)), note, ..Found::default() }
        .must(apart.iter().all(|v| v.is_finite()), "a point is not finite")
}

/// The gradient of the sum of the tensor `of` with respect to `x`.
fn gradient_of_sum<const D: usize, const E: usize>(of: &Tensor<D>, x: &Tensor<E>) -> Vec<f32> {
    host(x.grad(&of.clone().sum().backward()).expect("tracked"))
}

/// Raw points of one norm in several directions, against values and derivatives in f64.
fn exponential_depth(norm: f32, device: &Device) -> Found {
    let directions: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [-0.48, 0.6, 0.64]];
    let channel = |c: usize| directions.map(|d| if c < 3 { (d[c] * f64::from(norm)) as f32 } else { 0.0 });
    let raw: Vec<f32> = (0..4).flat_map(channel).collect();
    let config = NetworkConfig { anchor: Anchor::None, ..NetworkConfig::default() };
    let x = tracked(raw.clone(), [1, 4, 1, 3], device);
    let points = activate(x.clone(), &config).points;
    let gradient = gradient_of_sum(&points, &x);
    let got = host(points);
    // Numbers beyond f32 are not compared.
    let (mut values, mut slopes) = (Vec::new(), Vec::new());
    for i in 0..3 {
        let r = [0, 1, 2].map(|c| f64::from(raw[3 * c + i]));
        let length = r.iter().map(|v| v * v).sum::<f64>().sqrt();
        // p = r·f(n) with f = (eⁿ − 1)/n, whose derivative is f' = (eⁿ − f)/n.
        let f = if length > 0.0 { length.exp_m1() / length } else { 1.0 };
        let df = if length > 1e-4 { (length.exp() - f) / length } else { 0.5 };
        let size = length * f;
        let sum: f64 = r.iter().sum();
        for c in 0..3 {
            let expected = r[c] * f;
            if size < f64::from(f32::MAX) {
                // At norm 0 the point is 0, and the error is absolute.
                let size = if size > 0.0 { size } else { 1.0 };
                values.push(apart(got[3 * i + c], expected) / size);
            }
            // d(Σ p)/d r_c = f + f'·(r_c/n)·Σ r
            let expected = f + if length > 0.0 { df * r[c] / length * sum } else { 0.0 };
            let scale = f + df.abs() * length;
            if scale < f64::from(f32::MAX) {
                slopes.push(apart(gradient[3 * c + i], expected) / scale);
            }
        }
    }
    let most = |errors: Vec<f64>| (!errors.is_empty()).then(|| worst(errors));
    Found { value: most(values), gradient: most(slopes), ..Found::default() }
        .must(all_finite(&got), "a point is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn confidences(mode: ConfMode, device: &Device) -> Found {
    let logits = [-1e4_f32, -88.0, 0.0, 88.0, 1e4];
    let config = NetworkConfig { conf_mode: mode, ..NetworkConfig::default() };
    let raw: Vec<f32> = (0..4).flat_map(|c| logits.map(|v| if c == 3 { v } else { 0.1 })).collect();
    let x = tracked(raw, [1, 4, 1, 5], device);
    let conf = activate(x.clone(), &config).conf;
    let gradient = gradient_of_sum(&conf, &x);
    let got = host(conf);
    let expected = |x: f64| match mode {
        ConfMode::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        ConfMode::Exp => 1.0 + x.exp(),
    };
    let pairs = got.iter().zip(logits.map(|x| expected(f64::from(x))));
    let compared = pairs.filter(|(_, expected)| *expected < f64::from(f32::MAX));
    let off = worst(compared.map(|(got, expected)| apart(*got, expected) / expected.max(1.0)));
    let inside = got.iter().all(|c| match mode {
        ConfMode::Sigmoid => (0.0..=1.0).contains(c),
        ConfMode::Exp => *c >= 1.0,
    });
    Found { value: Some(off), ..Found::default() }
        .must(all_finite(&got), "a confidence is not finite")
        .must(inside, "a confidence is out of range")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn attributes(device: &Device) -> Found {
    let row = |v: f32| [v, -v].repeat(7);
    let x = tracked([row(1e4), row(-1e4)].concat(), [2, 14], device);
    let made = Attributes::new(x.clone(), None);
    let made = Tensor::cat(vec![made.opacity, made.scale, made.rotation, made.color, made.offset], 1);
    let gradient = gradient_of_sum(&made, &x);
    let made = host(made);
    let all = |hold: fn(&[f32; 14]) -> bool| made.as_chunks().0.iter().all(hold);
    let unit = |row: &[f32; 14]| (row[4..8].iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5;
    Found::default()
        .must(all_finite(&made), "an attribute is not finite")
        .must(all(|row| (0.0..=1.0).contains(&row[0])), "an opacity is out of range")
        .must(all(|row| row[1..4].iter().all(|scale| *scale >= 0.0)), "a scale is negative")
        .must(all(unit), "a quaternion is not of length 1")
        .must(all(|row| row[8..11].iter().all(|color| color.abs() <= 1.0)), "a colour is out of range")
        .must(all_finite(&gradient), "a gradient is not finite")
}

/// Twelve equal tokens. For any attention weights, the output is the tokens' value.
fn attention(size: f32, device: &Device) -> Found {
    let row: Vec<f32> = (0..CHANNELS).map(|c| size * (0.2 + 0.03 * c as f32)).collect();
    let all: Vec<f32> = (0..TOKENS).flat_map(|_| row.clone()).collect();
    attended(&all, &all, device)
}

/// Twelve tokens of one length in different directions. The product of a token with itself is the largest.
fn attention_to_oneself(device: &Device) -> Found {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut tokens: Vec<f32> = (0..TOKENS * CHANNELS).map(|_| random.random_range(-1.0_f32..1.0)).collect();
    for head in tokens.chunks_exact_mut(CHANNELS / HEADS) {
        let length = head.iter().map(|v| v * v).sum::<f32>().sqrt();
        head.iter_mut().for_each(|v| *v *= 1e4 / length);
    }
    let values: Vec<f32> = (0..TOKENS * CHANNELS).map(|_| random.random_range(0.5_f32..1.0)).collect();
    attended(&tokens, &values, device)
}

const TOKENS: usize = 12;
const CHANNELS: usize = 32;
const HEADS: usize = 2;

/// Attention of tokens with themselves, whose output must be the values.
fn attended(tokens: &[f32], values: &[f32], device: &Device) -> Found {
    let shape = [1, TOKENS, CHANNELS];
    let [q, k, v] = [tokens, tokens, values].map(|rows| tracked(rows.to_vec(), shape, device));
    let rope = Rope::new(3, 4, CHANNELS / HEADS, 100.0, &device.clone().autodiff());
    let out = rotary_attention([&q, &k, &v].map(Tensor::clone), &rope, HEADS, false);
    let gradients = out.clone().sum().backward();
    let gradient: Vec<f32> =
        [&q, &k, &v].iter().flat_map(|t| host(t.grad(&gradients).expect("tracked"))).collect();
    let got = host(out);
    let pairs = got.iter().zip(values);
    let off = pairs.map(|(got, value)| apart(*got, f64::from(*value)) / f64::from(value.abs()));
    Found { value: Some(worst(off)), ..Found::default() }
        .must(all_finite(&got), "an output is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn constant_channels(device: &Device) -> Found {
    let side = 32;
    let config = snapsnap_net::config::Config::default();
    let network: Regressor = snapsnap_net::weights::random_regressors(&config, 1, device).remove(0);
    let values: Vec<f32> =
        (0..6).flat_map(|c| vec![[0.5, -1.0, 0.25, 0.0, 2.0, 1e3][c]; side * side]).collect();
    let x = tracked(values, [1, 6, side, side], device);
    let network = burn::module::Module::fork(network, &device.clone().autodiff());
    let features = network.forward(x.clone());
    let gradient = gradient_of_sum(&features, &x);
    let got = host(features.cast(DType::F32));
    let width = got.len() / (side * side);
    let at = |row: usize, column: usize| &got[(row * side + column) * width..][..width];
    // Both pixels in the middle have equal surroundings except for the padding, which the normalisation hides.
    let (a, b) = (at(side / 2, side / 2), at(side / 2 + 4, side / 2 + 4));
    let most = got.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    let off = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs() / most.max(1e-20)));
    Found { value: Some(worst(off)), note: format!("features up to {most:.1e}"), ..Found::default() }
        .must(all_finite(&got), "a feature is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}
