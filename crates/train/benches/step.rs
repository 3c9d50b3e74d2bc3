//! A training step, forward and backward, of the small predictor (`configs/small`, 256², batch 2) and of the regressor
//! (two views of 256²): `cargo bench --workspace --bench step`. `docs/step_pytorch.py` measures PyTorch.
//!
//! Arguments: seconds per measurement (20), side (256), batch (2); `tiny`, `default` or `full` for that folder of
//! `configs`; `wide` for twice the default's widths; `bf16`; `predictor` or `regressor` for one network alone, so that the
//! printed memory is its own.

use std::hint::black_box;
use std::time::{Duration, Instant};

use burn::optim::GradientsParams;
use burn::tensor::{Device, Distribution, Tensor};
use snapsnap_base::config::Schema;
use snapsnap_net::network::Input;
use snapsnap_net::precision::Precision;
use snapsnap_net::weights::{random_predictor, random_regressors};
use snapsnap_train::config::TrainConfig;
use snapsnap_train::networks::Networks;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Forward and backward, the fastest of all repetitions.
fn measure(seconds: f64, mut step: impl FnMut() -> (Duration, Duration)) -> String {
    step();
    let (end, mut times) = (Instant::now() + Duration::from_secs_f64(seconds), Vec::new());
    while Instant::now() < end || times.len() < 3 {
        let (forward, backward) = step();
        times.push([forward + backward, forward, backward]);
    }
    let fastest = times.iter().min().expect("at least three runs");
    let [both, forward, backward] = fastest.map(|time| time.as_secs_f64() * 1e3);
    format!("forward {forward:.0} + backward {backward:.0} = {both:.0} ms, {} runs", times.len())
}

fn main() {
    // mimalloc keeps free pages, as in the program.
    #[allow(unsafe_code, reason = "a function of C")]
    unsafe {
        libmimalloc_sys::mi_option_set(15, 10_000);
    }
    let arguments: Vec<f64> = std::env::args().filter_map(|argument| argument.parse().ok()).collect();
    let argument = |i: usize, default: f64| arguments.get(i).copied().unwrap_or(default);
    let (seconds, side, batch) = (argument(0, 20.0), argument(1, 256.0) as usize, argument(2, 2.0) as usize);
    // A thread outside of rayon's pool would pass every operator to the pool and wait.
    rayon::scope(|_| run(seconds, side, batch));
}

fn asked_for(word: &str) -> bool {
    std::env::args().any(|argument| argument == word)
}

/// Peak memory of the process, on Linux.
fn peak() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok());
    kilobytes.map_or_else(String::new, |kilobytes| format!(", {} MB at most", kilobytes / 1024))
}

fn run(seconds: f64, side: usize, batch: usize) {
    let device = Device::flex().autodiff();
    let network = ["tiny", "full", "default"].into_iter().find(|word| asked_for(word)).unwrap_or("small");
    let path = format!("{}/../../configs/{network}/stage1.toml", env!("CARGO_MANIFEST_DIR"));
    let mut config = TrainConfig::from_file(path.as_ref(), &[]).expect("a config").networks();
    if asked_for("wide") {
        let n = &mut config.network;
        n.layer_dims = n.layer_dims.map(|width| 2 * width);
        [n.enc_dim, n.dec_dim, n.last_dim] = [n.enc_dim, n.dec_dim, n.last_dim].map(|width| 2 * width);
    }
    let precision = if asked_for("bf16") { Precision::Bf16 } else { Precision::F32 };
    let predictor = Some(random_predictor(&config, 1, &device));
    let masters = Networks { predictor, regressors: Vec::new() };
    let regressor = random_regressors(&config, 1, &device).remove(0);
    let threads = rayon::current_num_threads();

    let channels = config.network.input_channels();
    let images =
        Tensor::<4>::random([2 * batch, channels, side, side], Distribution::Uniform(-1.0, 1.0), &device);
    if !asked_for("regressor") {
        let grid = [side / config.network.patch; 2];
        let time = measure(seconds, || {
            let start = Instant::now();
            let predictor = masters.in_precision(precision).predictor.expect("the predictor");
            let input = Input { images: images.clone(), grid };
            let raw = predictor.raw(&predictor.decode(predictor.encode(input)));
            let loss = Tensor::cat(raw.into_iter().map(|raw| raw.square().mean()).collect(), 0).sum();
            let forward = start.elapsed();
            black_box(GradientsParams::from_grads(loss.backward(), &masters));
            (forward, start.elapsed() - forward)
        });
        println!(
            "predictor, {}, batch {batch}, {side}², {threads} threads: {time}{}",
            precision.name(),
            peak()
        );
    }

    if asked_for("predictor") {
        return;
    }
    let input = Tensor::<4>::random([2, 6, side, side], Distribution::Uniform(-1.0, 1.0), &device);
    let time = measure(seconds, || {
        let start = Instant::now();
        let loss = regressor.forward(input.clone()).square().mean();
        let forward = start.elapsed();
        black_box(GradientsParams::from_grads(loss.backward(), &regressor));
        (forward, start.elapsed() - forward)
    });
    println!("regressor, 2×{side}², {threads} threads: {time}{}", peak());
}
