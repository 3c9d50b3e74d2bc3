//! Cases of the stability table (EVALUATION.md) that need losses, an optimiser or a training.

use std::slice::from_ref;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use burn::tensor::{Device, Tensor, TensorData};
use glam::Vec3;
use image::RgbImage;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::prepare::{DataConfig, Subject};
use snapsnap_data::sample::{Joined, Stage1Item};
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::Region;
use snapsnap_eval::similarity::{psnr, ssim};
use snapsnap_eval::stability::{Case, Found};
use snapsnap_net::Window;
use snapsnap_net::network::{PointMap, View};
use snapsnap_net::weights::{random_predictor, random_regressors};
use snapsnap_ops::host;
use snapsnap_people::synth;

use crate::TrainError;
use crate::config::TrainConfig;
use crate::log::Line;
use crate::networks::{Networks, Rows};
use crate::optimizer::{MuonSettings, OptimizerConfig};
use crate::photometric::Photometric;
use crate::points::{Prediction, losses};
use crate::run::{Options, Outcome, Watch, train};
use crate::schedule::Schedule;
use crate::stage1::PointTask;
use crate::stage2::GaussianTask;
use crate::task::{Moment, Part, Task, Validation};

/// Networks of thousands of parameters on pictures of 64²: attention, all kinds of convolutions, resizing, windows and
/// anchors are in them.
const SMALL: &str = r#"
[network]
enc_dim = 16
enc_depth = 1
enc_heads = 2
dec_dim = 16
dec_depth = 2
dec_heads = 2
layer_dims = [4, 4, 8, 8]
feature_dim = 8
last_dim = 4
hooks = [0, 1, 1, 2]
resolution = 64
net_resolution = 32
conf_threshold = 0.4
delta = 0.2
anchor = "ray"
window = true
[regressor]
start = "geometric"
[mode]
compat = false
[samples]
supervision = 1
[training]
steps = 24
batch = 2
average = 0.9
log_every = 1
validation_samples = 0
[optimizer]
rate = 1e-3
[optimizer.muon]
rate = 1e-3
[stage2]
alpha = 0.5
needle = 0.1
anisotropy = 1.5
points = 1.0
"#;

/// All cases of EVALUATION.md, those of a million steps with so many.
pub fn cases(many_steps: u64) -> Vec<Case> {
    let mut cases = Vec::new();
    for (name, count) in [("empty", 0), ("of one pixel", 1)] {
        cases.push(Case {
            area: "Losses and optimiser",
            input: format!("stage 1 with a mask {name}, points elsewhere NaN and 1e30"),
            holds: "loss as in f64 and finite; no gradient outside the mask".into(),
            value_limit: 1e-6,
            gradient_limit: 0.0,
            once: false,
            run: Box::new(move |device| point_loss(count, device)),
        });
    }
    for (name, a, b) in [
        ("equal", 0.3_f32, 0.3_f32),
        ("0 and 1", 0.0, 1.0),
        ("black", 0.0, 0.0),
        ("1 and 1", 1.0, 1.0),
        ("0.9 and 0.9", 0.9, 0.9),
    ] {
        cases.push(Case {
            area: "Losses and optimiser",
            input: format!("SSIM and L1 of constant pictures, {name}"),
            // f32 keeps 6e-8 of E[x²] − E[x]², which is 1.3e-4 of C₂ for values near 1.
            holds: "(2ab + C₁)/(a² + b² + C₁) away from the border but for f32's rounding of variances, 1.3e-4; never above 1; \
                    gradient finite"
                .into(),
            value_limit: 1.3e-4,
            gradient_limit: 0.0,
            once: false,
            run: Box::new(move |device| constant_pictures(a, b, device)),
        });
    }
    cases.push(Case {
        area: "Losses and optimiser",
        input: "PSNR and SSIM of identical pictures".into(),
        holds: "∞, printed as inf; exactly 1".into(),
        value_limit: 0.0,
        gradient_limit: 0.0,
        once: true,
        run: Box::new(|_| identical_pictures()),
    });
    cases.push(Case {
        area: "Losses and optimiser",
        input: "zero gradients, 1000 steps of AdamW and of Muon".into(),
        // A rounding of the product in each of the steps.
        holds: "weights finite, changed by their decay alone, but for 1000 roundings of f32".into(),
        value_limit: 6e-5,
        gradient_limit: 0.0,
        once: false,
        run: Box::new(zero_gradients),
    });
    cases.push(Case {
        area: "Losses and optimiser",
        input: format!("{many_steps} AdamW steps with gradients of 1e-12, 1e-20, 1e-30 and 1e3"),
        // Adding a 10⁶th of a weight to it is rounded to 24 bits each time; the steps themselves are right.
        holds: "weights as f64's, relative, but for the rounding of a million sums in f32: 1 %".into(),
        value_limit: 1e-2,
        gradient_limit: 0.0,
        once: true,
        run: Box::new(move |_| many_adamw_steps(many_steps)),
    });
    cases.push(Case {
        area: "Losses and optimiser",
        input: "the ends of the learning rate, runs of 1 to 10⁶ steps".into(),
        holds: "between 0 and the highest, finite, first and last as the schedule says".into(),
        value_limit: 1e-9,
        gradient_limit: 0.0,
        once: true,
        run: Box::new(|_| ends_of_the_rate()),
    });
    cases.push(Case {
        area: "Stiff training",
        input: "one sample whose loss is NaN".into(),
        holds: "its step is skipped and counted, training goes on, weights finite".into(),
        value_limit: 0.0,
        gradient_limit: 0.0,
        once: true,
        run: Box::new(|_| told(poisoned())),
    });
    for (name, factor) in [("×10", 10.0), ("÷10", 0.1)] {
        cases.push(Case {
            area: "Stiff training",
            input: format!(
                "rate {name}, people nearly black, over-exposed, filling 1 % and 99 % of the frame; 24 steps of either stage"
            ),
            holds: "no step skipped, every logged number finite".into(),
            value_limit: 0.0,
            gradient_limit: 0.0,
            once: true,
            run: Box::new(move |_| told(stiff(factor))),
        });
    }
    cases
}

fn told(found: Result<Found, TrainError>) -> Found {
    found.unwrap_or_else(|e| Found { broken: Some(e.to_string()), ..Found::default() })
}

fn finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// A front view of 4 × 4 pixels, `count` of which have a true point; predictions and truth elsewhere are what networks and files can
/// at worst hold.
fn point_loss(count: usize, device: &Device) -> Found {
    const SIDE: usize = 4;
    const AREA: usize = SIDE * SIDE;
    let device = device.clone().autodiff();
    let valid: Vec<f32> = (0..AREA).map(|i| f32::from(u8::from(i < count))).collect();
    let points: Vec<f32> =
        (0..AREA).flat_map(|i| if i < count { [0.5, -0.25, 2.0] } else { [f32::NAN, 1e30, 1e30] }).collect();
    let truth: Vec<f32> =
        (0..AREA).flat_map(|i| if i < count { [0.1, 0.05, 2.5] } else { [f32::NAN; 3] }).collect();
    let predicted =
        Tensor::<4>::from_data(TensorData::new(points, [1, SIDE, SIDE, 3]), &device).require_grad();
    let conf = Tensor::<3>::full([1, SIDE, SIDE], 0.5, &device);
    let map = PointMap { points: predicted.clone(), conf };
    let prediction = Prediction { window: Window::whole(SIDE), maps: vec![(View::Front, map)] };
    let truth = Tensor::<5>::from_data(TensorData::new(truth, [1, 1, SIDE, SIDE, 3]), &device);
    let valid = Tensor::<4>::from_data(TensorData::new(valid, [1, 1, SIDE, SIDE]), &device);
    let loss = losses(&prediction, &truth, &valid);
    let gradient = host(predicted.grad(&loss.regression.clone().backward()).expect("tracked"));
    let got = host(loss.regression)[0];
    let expected = if count > 0 { (0.4_f64 * 0.4 + 0.3 * 0.3 + 0.5 * 0.5).sqrt() } else { 0.0 };
    Found { value: Some((f64::from(got) - expected).abs()), ..Found::default() }
        .must(finite(&gradient), "a gradient is not finite")
        .must(gradient[3 * count..].iter().all(|g| *g == 0.0), "there is a gradient outside the mask")
        .must(count == 0 || gradient[..3].iter().any(|g| *g != 0.0), "there is no gradient inside the mask")
}

fn constant_pictures(a: f32, b: f32, device: &Device) -> Found {
    let device = device.clone().autodiff();
    let (height, width) = (24, 24);
    let flat = |v: f32| Tensor::<4>::full([1, 3, height, width], v, &device);
    let image = flat(a).require_grad();
    let gradient = {
        let loss = Photometric::new(image.clone(), flat(b)).loss(0.8);
        host(image.grad(&loss.backward()).expect("tracked"))
    };
    let map = host(snapsnap_eval::similarity::ssim_gaussian(flat(a), flat(b)));
    let (a, b) = (f64::from(a), f64::from(b));
    let expected = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
    let middle = f64::from(map[width * height / 2 + width / 2]);
    let most = map.iter().fold(f32::MIN, |most, v| most.max(*v));
    Found { value: Some((middle - expected).abs()), note: format!("largest {most}"), ..Found::default() }
        .must(finite(&gradient), "a gradient is not finite")
        .must(most <= 1.0, "a similarity is above 1")
}

fn identical_pictures() -> Found {
    let values: Vec<f32> = (0..3 * 20 * 30).map(|i| (i * 37 % 101) as f32 / 100.0).collect();
    let picture = Picture::new(values, [20, 30], "picture").expect("values in [0, 1]");
    let region = Region::all(&picture);
    let ratio = psnr(&picture, &picture, &region).expect("one size");
    let similarity = ssim(&picture, &picture, &region).expect("one size");
    Found { note: format!("{ratio} dB, {similarity:?}"), ..Found::default() }
        .must(ratio == f64::INFINITY && format!("{ratio}") == "inf", "PSNR is not infinite")
        .must(similarity == Some(1.0), "SSIM is not 1")
}

/// Two rows of weights, one of a matrix that Muon takes.
fn zero_gradients(device: &Device) -> Found {
    const STEPS: usize = 1000;
    let config = TrainConfig::from_toml(SMALL, "the small networks", &[]).expect("a config");
    let networks = config.networks();
    let predictor = random_predictor(&networks, 1, &device.clone().autodiff());
    let mut trained = Networks { predictor: Some(predictor), regressors: Vec::new() };
    // One hidden matrix, one bias: all parameters would say no more.
    let names: Vec<String> = trained
        .rows()
        .into_keys()
        .filter(|name| name.contains("enc_blocks.0.attn.qkv.") || name.contains("enc_norm.bias"))
        .collect();
    let before = trained.rows();
    let mut optimizer = config.optimizer.init();
    for _ in 0..STEPS {
        let rows = trained.rows();
        let zeros: Rows = names.iter().map(|name| (name.clone(), rows[name].zeros_like())).collect();
        trained = optimizer.step(1.0, trained, zeros, 1.0);
    }
    let (after, mut worst, mut all) = (trained.rows(), 0.0_f64, true);
    for name in &names {
        let is_matrix = name.ends_with("weight");
        let (rate, decay) = match (&config.optimizer.muon, is_matrix) {
            (Some(MuonSettings { rate, weight_decay, .. }), true) => (*rate, *weight_decay),
            _ => (config.optimizer.rate, config.optimizer.weight_decay),
        };
        let decays = is_matrix || config.optimizer.decay_all;
        let kept = if decays { (1.0 - rate * decay).powi(STEPS as i32) } else { 1.0 };
        let (before, after) = (host(before[name].clone()), host(after[name].clone()));
        all &= finite(&after);
        for (b, a) in before.iter().zip(&after) {
            worst = worst.max((f64::from(*a) - f64::from(*b) * kept).abs() / f64::from(b.abs()).max(1e-3));
        }
    }
    Found { value: Some(worst), note: format!("{} parameters", names.len()), ..Found::default() }
        .must(all, "a weight is not finite")
        .must(names.len() >= 2, "the parameters are not there")
}

/// The update itself, on four weights, beside f64's.
fn many_adamw_steps(steps: u64) -> Found {
    const GRADIENTS: [f32; 4] = [1e-12, 1e-20, 1e-30, 1e3];
    let config = OptimizerConfig { rate: 1e-5, weight_decay: 0.0, ..OptimizerConfig::default() };
    let optimizer = config.init();
    let device = Device::flex();
    let gradient = Tensor::<1>::from_floats(GRADIENTS, &device);
    let (mut values, mut state) = (Tensor::<1>::zeros([4], &device), None);
    let (mut expected, mut mean, mut squares) = ([0.0_f64; 4], [0.0_f64; 4], [0.0_f64; 4]);
    for step in 1..=steps {
        let (next, kept) = optimizer.adamw(1.0, false, values, gradient.clone(), 1.0, state);
        (values, state) = (next, Some(kept));
        let corrections = [config.beta1, config.beta2].map(|beta| 1.0 - beta.powf(step as f64));
        for (i, g) in GRADIENTS.into_iter().map(f64::from).enumerate() {
            mean[i] = mean[i] * config.beta1 + g * (1.0 - config.beta1);
            squares[i] = squares[i] * config.beta2 + g * g * (1.0 - config.beta2);
            let length = (squares[i] / corrections[1]).sqrt() + config.epsilon;
            expected[i] -= config.rate * mean[i] / corrections[0] / length;
        }
    }
    let got = host(values);
    let off = |(got, expected): (&f32, &f64)| (f64::from(*got) - expected).abs() / expected.abs().max(1e-6);
    let worst = got.iter().zip(&expected).map(off).fold(0.0, f64::max);
    Found { value: Some(worst), note: format!("weights {got:?}"), ..Found::default() }
        .must(finite(&got), "a weight is not finite")
}

fn ends_of_the_rate() -> Found {
    let (mut worst, mut sound) = (0.0_f64, true);
    for steps in [1_usize, 2, 10, 1000, 1_000_000] {
        for warm_up in [0, 1, 50] {
            let schedule = Schedule::Cosine { warm_up, end: 0.01 };
            let at = |step: usize| schedule.share(step, steps);
            let first = if warm_up == 0 { 1.0 } else { 1.0 / (warm_up as f64 + 1.0) };
            worst = worst.max((at(0) - first).abs());
            if steps > warm_up + 1 {
                worst = worst.max((at(steps - 1) - 0.01).abs()).max((at(10 * steps) - 0.01).abs());
            }
            sound &=
                [0, steps / 2, steps - 1, steps, 10 * steps].iter().all(|s| (0.0..=1.0).contains(&at(*s)));
        }
        let published = Schedule::published();
        let at = |step: usize| published.share(step, steps);
        sound &=
            [0, steps / 2, steps - 1, steps + 99, 10 * steps].iter().all(|s| (0.0..=1.0).contains(&at(*s)));
        worst = worst.max((at(steps + 99) - 1.0 / 25.0 / 1e4).abs());
    }
    Found { value: Some(worst), ..Found::default() }.must(sound, "a rate is negative, too high or not finite")
}

struct Silent {
    finite: bool,
}

impl Watch for Silent {
    fn step(&mut self, line: &Line, _: u64, _: u64) {
        self.finite &= line.values.values().all(|value| value.is_finite());
    }

    fn validated(&mut self, _: u64, _: &Validation) {}

    fn note(&mut self, _: &str) {}
}

/// A short training in a folder that goes with it.
fn trained<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    devices: &[Device],
) -> Result<(Outcome, bool), TrainError> {
    let folder = temporary("run")?;
    let stop = AtomicBool::new(false);
    let options = Options { folder: &folder.0, devices, limit: None, stop: &stop };
    let mut watch = Silent { finite: true };
    let outcome =
        crate::run::on_best_thread(devices, || train(task, config, networks, &options, &mut watch))?;
    Ok((outcome, watch.finite))
}

/// A folder that is removed with its value.
struct Temporary(std::path::PathBuf);

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn temporary(name: &str) -> Result<Temporary, TrainError> {
    use std::sync::atomic::{AtomicU64, Ordering};
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    let path =
        std::env::temp_dir().join(format!("snapsnap-stability-{}-{number}-{name}", std::process::id()));
    std::fs::create_dir_all(&path)
        .map_err(|e| TrainError::Unsuitable(format!("{}: cannot make this folder: {e}", path.display())))?;
    Ok(Temporary(path))
}

/// A data set of people as they should not be photographed: nearly black, over-exposed, 1 % and nearly all of the frame.
fn extreme_people(root: &std::path::Path) -> Result<Arc<Folder>, TrainError> {
    let mut data = DataConfig::default();
    (data.views.count, data.views.resolution) = (4, 64);
    let folder = Folder::create(&root.join("people"), data.description("stability"))?;
    let person = synth::person("stability");
    let lit = |factor: f32| {
        let mut mesh = person.clone();
        mesh.materials.iter_mut().for_each(|material| material.color *= factor);
        mesh
    };
    let middle = Vec3::new(0.0, 0.85, 0.0);
    let mut small = person.clone();
    small.positions.iter_mut().for_each(|p| *p = middle + (*p - middle) * 0.33);
    // A ball that the cameras, two metres away, see nothing beside.
    let mut ball = person.clone();
    ball.positions.iter_mut().for_each(|p| *p = middle + (*p - middle).normalize_or(Vec3::Y) * 1.45);
    for (name, mesh) in [("0000", lit(0.01)), ("0001", lit(40.0)), ("0002", small), ("0003", ball)] {
        data.add(&folder, &Subject::plain(Split::Train, name), &mesh)?;
    }
    Ok(Arc::new(folder))
}

fn config(overrides: &[String]) -> TrainConfig {
    TrainConfig::from_toml(SMALL, "the small networks", overrides).expect("a config")
}

fn stiff(factor: f64) -> Result<Found, TrainError> {
    let temporary = temporary("people")?;
    let folder = extreme_people(&temporary.0)?;
    let share = |subject: &str| -> Result<f64, TrainError> {
        let (_, mask) = folder.picture(Some(Split::Train), subject, 0, false)?;
        Ok(mask.as_raw().iter().filter(|m| **m > 127).count() as f64 / 4096.0)
    };
    let (small, large) = (share("0002")?, share("0003")?);
    let rate = 1e-3 * factor;
    let config = config(&[format!("optimizer.rate={rate}"), format!("optimizer.muon.rate={rate}")]);
    let (networks, device) = (config.networks(), [Device::flex().autodiff()]);
    let predictor = |device: &Device| random_predictor(&networks, 3, device);
    let stage1 = PointTask::new(from_ref(&folder), &config, &device)?;
    let fresh = Networks { predictor: Some(predictor(&device[0])), regressors: Vec::new() };
    let (one, one_finite) = trained(&stage1, &config, fresh, &device)?;
    let stage2 = GaussianTask::new(from_ref(&folder), &config, None, &device)?;
    let regressors = random_regressors(&networks, 4, &device[0]);
    let fresh = Networks { predictor: Some(predictor(&device[0])), regressors };
    let (two, two_finite) = trained(&stage2, &config, fresh, &device)?;
    let note = format!(
        "{:.1} % and {:.1} % of the frame; {} and {} skipped",
        100.0 * small,
        100.0 * large,
        one.skipped,
        two.skipped
    );
    Ok(Found { note, ..Found::default() }
        .must(small < 0.02 && large > 0.95, "the people do not fill the frame as they should")
        .must(one.step == 24 && two.step == 24, "the training ended early")
        .must(one.skipped == 0 && two.skipped == 0, "steps were skipped")
        .must(one_finite && two_finite, "a logged number is not finite"))
}

/// Stage 1, in whose fourth step the loss is NaN.
struct Poisoned(PointTask);

impl Task for Poisoned {
    type Item = Stage1Item;
    const STAGE: u32 = 1;

    fn samples(&self, pass: u64) -> Joined<Stage1Item> {
        self.0.samples(pass)
    }

    fn name(item: &Stage1Item) -> &str {
        PointTask::name(item)
    }

    fn losses(
        &self,
        networks: &Networks,
        items: Vec<Stage1Item>,
        at: Moment,
    ) -> Result<Vec<Part>, TrainError> {
        let mut parts = self.0.losses(networks, items, at)?;
        if at.step == 3 {
            parts.iter_mut().for_each(|part| part.value = part.value.clone() * f64::NAN);
        }
        Ok(parts)
    }

    fn validate(&self, networks: &Networks) -> Result<Option<Validation>, TrainError> {
        self.0.validate(networks)
    }

    fn preview(&self, networks: &Networks) -> Result<Option<RgbImage>, TrainError> {
        self.0.preview(networks)
    }
}

fn poisoned() -> Result<Found, TrainError> {
    let temporary = temporary("people")?;
    let folder = extreme_people(&temporary.0)?;
    let config = config(&["training.steps=8".into()]);
    let (networks, device) = (config.networks(), [Device::flex().autodiff()]);
    let task = Poisoned(PointTask::new(from_ref(&folder), &config, &device)?);
    let fresh =
        Networks { predictor: Some(random_predictor(&networks, 3, &device[0])), regressors: Vec::new() };
    let (outcome, all_finite) = trained(&task, &config, fresh, &device)?;
    Ok(Found { note: format!("{} of {} steps skipped", outcome.skipped, outcome.step), ..Found::default() }
        .must(outcome.skipped == 1, "not one step was skipped")
        .must(outcome.finished && outcome.step == 8, "the training ended early")
        .must(all_finite, "a logged number is not finite"))
}
