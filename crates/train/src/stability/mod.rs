//! Cases of the stability table that need losses, an optimiser or a training
//! (docs/method.md, "Stability cases").

mod trainings;

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_base::config::Schema;
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::Region;
use snapsnap_eval::similarity::{psnr, ssim};
use snapsnap_eval::stability::{Case, Found, all_finite, apart, tracked, worst};
use snapsnap_net::Window;
use snapsnap_net::network::{PointMap, View};
use snapsnap_net::weights::random_predictor;
use snapsnap_ops::host;

use crate::config::TrainConfig;
use crate::networks::{Networks, Rows};
use crate::optimizer::{BETA1, EPSILON, MUON_WEIGHT_DECAY, MuonSettings, OptimizerConfig, WEIGHT_DECAY};
use crate::points::losses;
use crate::schedule::Schedule;
use crate::stage2::photometric;
use crate::task::Part;
use snapsnap_net::Prediction;

/// A short training of small networks.
const SMALL: &str = concat!(
    include_str!("small.toml"),
    r#"
[training]
steps = 24
batch = 2
ema_decay = 0.9
log_every = 1
validation_samples = 0
[optimizer]
rate = 1e-3
[optimizer.muon]
rate = 1e-3
[stage2]
alpha_weight = 0.5
points_weight = 1.0
"#
);
/// Interpolated maps, and sides in spite of the confidences of random weights, which are near ½.
const SETTINGS: [&str; 2] = ["network.net_resolution=32", "network.conf_threshold=0.4"];

/// All cases of losses, optimiser and training. `many_steps` is the number of steps of the longest case.
pub fn cases(many_steps: u64) -> Vec<Case> {
    let mut cases = Vec::new();
    let once = |case: Case| Case { once: true, ..case };
    for (name, count) in [("empty", 0), ("of one pixel", 1)] {
        let input = format!("stage 1 with a mask {name}, points elsewhere NaN and 1e30");
        let holds = "loss as in f64 and finite; no gradient outside the mask";
        cases.push(case(&input, holds, 1e-6, move |device| point_loss(count, device)));
    }
    for (name, a, b) in [
        ("equal", 0.3_f32, 0.3_f32),
        ("0 and 1", 0.0, 1.0),
        ("black", 0.0, 0.0),
        ("1 and 1", 1.0, 1.0),
        ("0.9 and 0.9", 0.9, 0.9),
    ] {
        let input = format!("SSIM and L1 of constant pictures, {name}");
        // f32 has an error of 6e-8 in E[x²] − E[x]², which is 1.3e-4 of C₂ for values near 1.
        let holds = "(2ab + C₁)/(a² + b² + C₁) away from the border but for f32's rounding of variances, 1.3e-4; never above 1; \
                     gradient finite";
        cases.push(case(&input, holds, 1.3e-4, move |device| constant_pictures(a, b, device)));
    }
    let holds = "∞, printed as inf; exactly 1";
    cases.push(once(case("PSNR and SSIM of identical pictures", holds, 0.0, |_| identical_pictures())));
    // Each step rounds a product.
    let holds = "weights finite, changed by their decay alone, but for 1000 roundings of f32";
    cases.push(case("zero gradients, 1000 steps of AdamW and of Muon", holds, 6e-5, zero_gradients));
    // Each step adds a millionth of a weight to it and rounds the sum to 24 bits.
    let input = format!("{many_steps} AdamW steps with gradients of 1e-12, 1e-20, 1e-30 and 1e3");
    let holds = "weights as f64's, relative, but for the rounding of a million sums in f32: 1 %";
    cases.push(once(case(&input, holds, 1e-2, move |_| many_adamw_steps(many_steps))));
    let holds = "between 0 and the highest, finite, first and last as the schedule says";
    let input = "the ends of the learning rate, runs of 1 to 10⁶ steps";
    cases.push(once(case(input, holds, 1e-9, |_| ends_of_the_rate())));
    cases.extend(trainings::cases());
    cases
}

/// A case on every device, without an error of gradients.
fn case(input: &str, holds: &str, value_limit: f64, run: impl Fn(&Device) -> Found + 'static) -> Case {
    Case::new("Losses and optimiser", input, holds, [value_limit, 0.0], run)
}

/// A front view of 4 × 4 pixels, `count` of which have a true point. Predictions and ground truth of the others have
/// the worst possible values.
fn point_loss(count: usize, device: &Device) -> Found {
    const SIDE: usize = 4;
    const AREA: usize = SIDE * SIDE;
    let valid: Vec<f32> = (0..AREA).map(|i| f32::from(u8::from(i < count))).collect();
    let points: Vec<f32> =
        (0..AREA).flat_map(|i| if i < count { [0.5, -0.25, 2.0] } else { [f32::NAN, 1e30, 1e30] }).collect();
    let truth: Vec<f32> =
        (0..AREA).flat_map(|i| if i < count { [0.1, 0.05, 2.5] } else { [f32::NAN; 3] }).collect();
    let predicted = tracked(points, [1, SIDE, SIDE, 3], device);
    let device = predicted.device();
    let conf = Tensor::<3>::full([1, SIDE, SIDE], 0.5, &device);
    let map = PointMap { points: predicted.clone(), conf };
    let prediction = Prediction { window: Window::whole(SIDE), maps: vec![(View::Front, map)] };
    let truth = Tensor::<5>::from_data(TensorData::new(truth, [1, 1, SIDE, SIDE, 3]), &device);
    let valid = Tensor::<4>::from_data(TensorData::new(valid, [1, 1, SIDE, SIDE]), &device);
    let parts: Result<[Part; 3], _> = losses(&prediction, &truth, &valid, 1.0).try_into();
    let [distance, _, relief] = parts.expect("three parts").map(|part| part.value);
    let all = distance.clone() + relief;
    let gradient = host(predicted.grad(&all.backward()).expect("tracked"));
    let got = host(distance)[0];
    let expected = if count > 0 { (0.4_f64 * 0.4 + 0.3 * 0.3 + 0.5 * 0.5).sqrt() } else { 0.0 };
    Found { value: Some(apart(got, expected)), ..Found::default() }
        .must(all_finite(&gradient), "a gradient is not finite")
        .must(gradient[3 * count..].iter().all(|g| *g == 0.0), "there is a gradient outside the mask")
        .must(count == 0 || gradient[..3].iter().any(|g| *g != 0.0), "there is no gradient inside the mask")
}

fn constant_pictures(a: f32, b: f32, device: &Device) -> Found {
    let device = device.clone().autodiff();
    let (height, width) = (24, 24);
    let flat = |v: f32| Tensor::<4>::full([1, 3, height, width], v, &device);
    let image = flat(a).require_grad();
    let [l1, ssim] = photometric(image.clone(), flat(b));
    let loss = l1 * 0.8 + (-ssim + 1.0) * 0.2;
    let gradient = host(image.grad(&loss.backward()).expect("tracked"));
    let map = host(snapsnap_eval::similarity::ssim_gaussian(flat(a), flat(b)));
    let (a, b) = (f64::from(a), f64::from(b));
    let expected = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
    let middle = map[width * height / 2 + width / 2];
    let most = map.iter().fold(f32::MIN, |most, v| most.max(*v));
    Found { value: Some(apart(middle, expected)), note: format!("largest {most}"), ..Found::default() }
        .must(all_finite(&gradient), "a gradient is not finite")
        .must(most <= 1.0, "a similarity is above 1")
}

fn identical_pictures() -> Found {
    let values: Vec<f32> = (0..3 * 20 * 30).map(|i| (i * 37 % 101) as f32 / 100.0).collect();
    let picture = Picture::new(values, [20, 30], "picture").expect("values in [0, 1]");
    let region = Region::all(&picture);
    let ratio = psnr(&picture, &picture, &region).expect("one size");
    let similarity = ssim(&picture, &picture, &region).expect("one size");
    Found { note: format!("{ratio} dB, SSIM {}", similarity.unwrap_or(f64::NAN)), ..Found::default() }
        .must(ratio == f64::INFINITY && format!("{ratio}") == "inf", "PSNR is not infinite")
        .must(similarity == Some(1.0), "SSIM is not 1")
}

/// 1000 steps without gradients, of a matrix, which Muon trains, and of biases.
fn zero_gradients(device: &Device) -> Found {
    const STEPS: usize = 1000;
    let config = config(&[]);
    let networks = config.networks();
    let predictor = random_predictor(&networks, 1, &device.clone().autodiff());
    let mut trained = Networks { predictor: Some(predictor), regressors: Vec::new() };
    // One hidden matrix and one bias stand for all parameters.
    let names: Vec<String> = trained
        .rows()
        .into_keys()
        .filter(|name| name.contains("enc_blocks.0.attn.qkv.") || name.contains("enc_norm.bias"))
        .collect();
    let before = trained.rows();
    let mut optimizer = config.optimizer.init(false);
    for _ in 0..STEPS {
        let rows = trained.rows();
        let zeros: Rows = names.iter().map(|name| (name.clone(), rows[name].zeros_like())).collect();
        let rows = optimizer.step(1.0, &trained, zeros, 1.0);
        trained = trained.with_rows(&rows);
    }
    let (after, mut worst, mut all) = (trained.rows(), 0.0_f64, true);
    for name in &names {
        let is_matrix = name.ends_with("weight");
        let (rate, decay) = match (&config.optimizer.muon, is_matrix) {
            (Some(MuonSettings { rate }), true) => (*rate, MUON_WEIGHT_DECAY),
            _ => (config.optimizer.rate, WEIGHT_DECAY),
        };
        let kept = if is_matrix { (1.0 - rate * decay).powi(STEPS as i32) } else { 1.0 };
        let (before, after) = (host(before[name].clone()), host(after[name].clone()));
        all &= all_finite(&after);
        for (b, a) in before.iter().zip(&after) {
            worst = worst.max((f64::from(*a) - f64::from(*b) * kept).abs() / f64::from(b.abs()).max(1e-3));
        }
    }
    Found { value: Some(worst), note: format!("{} parameters", names.len()), ..Found::default() }
        .must(all, "a weight is not finite")
        .must(names.len() >= 2, "the parameters are not there")
}

/// Updates of four weights, compared with updates in f64.
fn many_adamw_steps(steps: u64) -> Found {
    const GRADIENTS: [f32; 4] = [1e-12, 1e-20, 1e-30, 1e3];
    let config = OptimizerConfig { rate: 1e-5, ..OptimizerConfig::default() };
    let optimizer = config.init(false);
    let device = Device::flex();
    let gradient = Tensor::<1>::from_floats(GRADIENTS, &device);
    let (mut values, mut state) = (Tensor::<1>::zeros([4], &device), None);
    let (mut expected, mut mean, mut squares) = ([0.0_f64; 4], [0.0_f64; 4], [0.0_f64; 4]);
    for step in 1..=steps {
        let (next, kept) = optimizer.adamw(1.0, false, values, gradient.clone(), 1.0, state);
        (values, state) = (next, Some(kept));
        let corrections = [BETA1, config.beta2].map(|beta| 1.0 - beta.powf(step as f64));
        for (i, g) in GRADIENTS.into_iter().map(f64::from).enumerate() {
            mean[i] = mean[i] * BETA1 + g * (1.0 - BETA1);
            squares[i] = squares[i] * config.beta2 + g * g * (1.0 - config.beta2);
            let length = (squares[i] / corrections[1]).sqrt() + EPSILON;
            expected[i] -= config.rate * mean[i] / corrections[0] / length;
        }
    }
    let got = host(values);
    let off = |(got, expected): (&f32, &f64)| apart(*got, *expected) / expected.abs();
    let value = Some(worst(got.iter().zip(&expected).map(off)));
    Found { value, note: format!("weights {got:?}"), ..Found::default() }
        .must(all_finite(&got), "a weight is not finite")
}

fn ends_of_the_rate() -> Found {
    let (mut worst, mut sound) = (0.0_f64, true);
    for steps in [1_usize, 2, 10, 1000, 1_000_000] {
        for warm_up in [0, 1, 50] {
            let schedule = Schedule::Cosine { warm_up };
            let at = |step: usize| schedule.share(step, steps);
            let first = if warm_up == 0 { 1.0 } else { 1.0 / (warm_up as f64 + 1.0) };
            worst = worst.max((at(0) - first).abs());
            if steps > warm_up + 1 {
                let ends = [(warm_up, 1.0_f64), (steps - 1, 0.01), (10 * steps, 0.01)];
                worst = ends.into_iter().map(|(step, rate)| (at(step) - rate).abs()).fold(worst, f64::max);
            }
            sound &=
                [0, steps / 2, steps - 1, steps, 10 * steps].iter().all(|s| (0.0..=1.0).contains(&at(*s)));
        }
        let published = Schedule::default();
        let at = |step: usize| published.share(step, steps);
        sound &=
            [0, steps / 2, steps - 1, steps + 99, 10 * steps].iter().all(|s| (0.0..=1.0).contains(&at(*s)));
        worst = worst.max((at(steps + 99) - 1.0 / 25.0 / 1e4).abs());
    }
    Found { value: Some(worst), ..Found::default() }.must(sound, "a rate is negative, too high or not finite")
}

pub(crate) fn config(overrides: &[String]) -> TrainConfig {
    let overrides = [&SETTINGS.map(String::from)[..], overrides].concat();
    TrainConfig::from_toml(SMALL, "the small networks", &overrides).expect("a config")
}
