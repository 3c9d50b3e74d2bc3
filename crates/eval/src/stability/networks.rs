//! Networks at the limits of number formats.

use std::sync::Arc;

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_net::config::{Anchor, ConfMode, NetworkConfig, RegressorConfig};
use snapsnap_net::network::activate;
use snapsnap_net::precision::Precision;
use snapsnap_net::regressor::{Attributes, Regressor, Statistics};
use snapsnap_net::weights::WeightFile;
use snapsnap_net::{Photograph, Reconstructor};
use snapsnap_ops::{Rope, host, rotary_attention};

use super::{Case, Found, nan_is_worst};

const AREA: &str = "Networks";

/// All cases of networks but those in 16 bits, which need trained weights.
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
    let input = "the regressor's 14 channels at ±1e4";
    cases.push(Case::new(
        AREA,
        input,
        "attributes finite and in range, gradient finite",
        [0.0; 2],
        attributes,
    ));
    for (size, name) in
        [(1.0_f32, "identical tokens"), (1e4, "identical tokens of 1e4"), (1e18, "tokens of 1e18")]
    {
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

/// Points of a trained predictor in 16 bits against those in 32, with `photographs` on its canvas. The limit of nine
/// tenths of the points is a tenth of the error of such networks (docs/notes/training.md: 30 mm).
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

fn in_precision(
    (weights, [front, back]): &(WeightFile, [Photograph; 2]),
    precision: Precision,
    device: &Device,
) -> Found {
    if !device.supports_dtype(precision.dtype()) {
        return Found::skipped(format!("the device does not compute in {}", precision.name()));
    }
    let maps = |precision: Precision| -> Result<(Vec<f32>, Vec<Vec<bool>>), Found> {
        let model = Reconstructor::load(weights, device).map_err(Found::broken)?;
        let made = model.in_precision(precision).reconstruct(front, back, &|_| ());
        Ok((host(made.maps.points), made.valid))
    };
    let (whole, half) = match (maps(Precision::F32), maps(precision)) {
        (Ok(whole), Ok(half)) => (whole, half.0),
        (Err(found), _) | (_, Err(found)) => return found,
    };
    let (whole, valid) = whole;
    let mut apart: Vec<f64> = (0..2)
        .flat_map(|view| {
            let area = valid[view].len();
            let there = (0..area).filter(|i| valid[view][*i]).map(move |i| 3 * (view * area + i));
            there.collect::<Vec<_>>()
        })
        .map(|at| {
            let squares = (at..at + 3).map(|i| (f64::from(whole[i]) - f64::from(half[i])).powi(2));
            squares.sum::<f64>().sqrt()
        })
        .collect();
    apart.sort_by(f64::total_cmp);
    let Some(last) = apart.last().copied() else {
        return Found::broken("no pixel is valid");
    };
    let median = crate::statistics::quantile(&apart, 0.5);
    let note = format!("median {:.2} mm, at most {:.2} mm", 1e3 * median, 1e3 * last);
    Found { value: Some(crate::statistics::quantile(&apart, 0.9)), note, ..Found::default() }
        .must(apart.iter().all(|v| v.is_finite()), "a point is not finite")
}

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), &device.clone().autodiff()).require_grad()
}

fn all_finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// Raw points of one norm in several directions, against values and derivatives in f64.
fn exponential_depth(norm: f32, device: &Device) -> Found {
    let directions: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [-0.48, 0.6, 0.64]];
    let raw: Vec<f32> = (0..4)
        .flat_map(|c| directions.map(|d| if c < 3 { (d[c] * f64::from(norm)) as f32 } else { 0.0 }))
        .collect();
    let config = NetworkConfig { anchor: Anchor::None, ..NetworkConfig::default() };
    let x = tensor(raw.clone(), [1, 4, 1, 3], device);
    let points = activate(x.clone(), &config).points;
    let gradients = points.clone().sum().backward();
    let gradient = host(x.grad(&gradients).expect("tracked"));
    let got = host(points);
    // Numbers beyond f32 are not compared.
    let (mut value, mut slope) = (None, None);
    let worst = |most: &mut Option<f64>, off: f64| *most = Some(nan_is_worst(off).max(most.unwrap_or(0.0)));
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
                // At norm 0 the point is 0 itself.
                let size = if size > 0.0 { size } else { 1.0 };
                worst(&mut value, (f64::from(got[3 * i + c]) - expected).abs() / size);
            }
            // d(Σ p)/d r_c = f + f'·(r_c/n)·Σ r
            let expected = f + if length > 0.0 { df * r[c] / length * sum } else { 0.0 };
            let scale = f + df.abs() * length;
            if scale < f64::from(f32::MAX) {
                worst(&mut slope, (f64::from(gradient[3 * c + i]) - expected).abs() / scale);
            }
        }
    }
    Found { value, gradient: slope, ..Found::default() }
        .must(all_finite(&got), "a point is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn confidences(mode: ConfMode, device: &Device) -> Found {
    let logits = [-1e4_f32, -88.0, 0.0, 88.0, 1e4];
    let config = NetworkConfig { conf_mode: mode, ..NetworkConfig::default() };
    let raw: Vec<f32> = (0..4).flat_map(|c| logits.map(|v| if c == 3 { v } else { 0.1 })).collect();
    let x = tensor(raw, [1, 4, 1, 5], device);
    let conf = activate(x.clone(), &config).conf;
    let gradient = host(x.grad(&conf.clone().sum().backward()).expect("tracked"));
    let got = host(conf);
    let expected = |x: f64| match mode {
        ConfMode::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        ConfMode::Exp => 1.0 + x.exp(),
    };
    let mut worst = 0.0_f64;
    for (x, got) in logits.iter().zip(&got) {
        let expected = expected(f64::from(*x));
        if expected < f64::from(f32::MAX) {
            worst = worst.max(nan_is_worst((f64::from(*got) - expected).abs() / expected.max(1.0)));
        }
    }
    let inside = got.iter().all(|c| match mode {
        ConfMode::Sigmoid => (0.0..=1.0).contains(c),
        ConfMode::Exp => *c >= 1.0,
    });
    Found { value: Some(worst), ..Found::default() }
        .must(all_finite(&got), "a confidence is not finite")
        .must(inside, "a confidence is out of range")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn attributes(device: &Device) -> Found {
    let rows: Vec<f32> = [1e4_f32, -1e4]
        .iter()
        .flat_map(|v| (0..14).map(move |i| if i % 2 == 0 { *v } else { -*v }))
        .collect();
    let x = tensor(rows, [2, 14], device);
    let made = Attributes::new(&RegressorConfig::default(), x.clone(), None);
    let parts = [made.opacity, made.scale, made.rotation, made.color, made.offset];
    let sum = parts.iter().map(|part| part.clone().sum()).reduce(|a, b| a + b).expect("five parts");
    let gradient = host(x.grad(&sum.backward()).expect("tracked"));
    let [opacity, scale, rotation, color, offset] = parts.map(host);
    let unit = rotation.chunks_exact(4).all(|q| (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
    Found::default()
        .must(
            [&opacity, &scale, &rotation, &color, &offset].into_iter().all(|v| all_finite(v)),
            "an attribute is not finite",
        )
        .must(opacity.iter().all(|o| (0.0..=1.0).contains(o)), "an opacity is out of range")
        .must(scale.iter().all(|s| *s >= 0.0), "a scale is negative")
        .must(unit, "a quaternion is not of length 1")
        .must(color.iter().all(|c| c.abs() <= 1.0), "a colour is out of range")
        .must(all_finite(&gradient), "a gradient is not finite")
}

/// Twelve equal tokens. The output is their value for any weights.
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
    let [q, k, v] = [tokens, tokens, values].map(|rows| tensor(rows.to_vec(), shape, device));
    let rope = Rope::new(3, 4, CHANNELS / HEADS, 100.0, &device.clone().autodiff());
    let out = rotary_attention(q.clone(), k.clone(), v.clone(), &rope, HEADS);
    let gradients = out.clone().sum().backward();
    let gradient: Vec<f32> =
        [&q, &k, &v].iter().flat_map(|t| host(t.grad(&gradients).expect("tracked"))).collect();
    let got = host(out);
    let mut worst = 0.0_f64;
    for (got, expected) in got.iter().zip(values).map(|(g, e)| (f64::from(*g), f64::from(*e))) {
        worst = worst.max(nan_is_worst(((got - expected) / expected).abs()));
    }
    Found { value: Some(worst), ..Found::default() }
        .must(all_finite(&got), "an output is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}

fn constant_channels(device: &Device) -> Found {
    let side = 32;
    let config = snapsnap_net::config::Config::default();
    let network: Regressor = snapsnap_net::weights::random_regressors(&config, 1, device).remove(0);
    let values: Vec<f32> =
        (0..6).flat_map(|c| vec![[0.5, -1.0, 0.25, 0.0, 2.0, 1e3][c]; side * side]).collect();
    let x = tensor(values, [1, 6, side, side], device);
    let network = burn::module::Module::fork(network, &device.clone().autodiff());
    let features = network.forward(x.clone(), &mut Statistics::measured());
    let gradient = host(x.grad(&features.clone().sum().backward()).expect("tracked"));
    let got = host(features.cast(DType::F32));
    let width = got.len() / (side * side);
    let at = |row: usize, column: usize| &got[(row * side + column) * width..][..width];
    // Both pixels in the middle have equal surroundings except for the padding, which the normalisation hides.
    let (a, b) = (at(side / 2, side / 2), at(side / 2 + 4, side / 2 + 4));
    let most = got.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    let apart = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs() / most.max(1e-20))).fold(0.0, f64::max);
    Found { value: Some(apart), note: format!("features up to {most:.1e}"), ..Found::default() }
        .must(all_finite(&got), "a feature is not finite")
        .must(all_finite(&gradient), "a gradient is not finite")
}
