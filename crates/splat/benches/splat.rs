//! Times and memory of the splatting operation:
//! `cargo bench --workspace --bench splat -- [--device cpu|wgpu|vulkan] [--full] [--only TEXT]`.
//!
//! Inputs are built outside the timed part and the device is synchronised before and after it. Each figure is the
//! median of the runs that fit into the time per case, at least three, after one warm-up.

use std::time::{Duration, Instant};

use burn::tensor::{Device, DeviceKind, Distribution, Tensor};
use peak_alloc::PeakAlloc;
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Time to spend on one figure.
const TIME_PER_FIGURE: Duration = Duration::from_millis(1500);

/// Which inputs are tracked.
#[derive(Clone, Copy, PartialEq)]
enum Tracked {
    Nothing,
    Colors,
    Everything,
}

/// `n` Gaussians on an ellipsoid as high as a person, which covers 30 % of a training camera's square image, with a
/// standard deviation of `sigma` pixels of an image of `size` pixels, half as thick along a random axis.
fn human(n: usize, size: u32, sigma: f32, tracked: Tracked, device: &Device) -> Gaussians {
    device.seed(7);
    let random = |columns: usize, low: f64, high: f64| {
        Tensor::<2>::random([n, columns], Distribution::Uniform(low, high), device)
    };
    let (y, angle) = (random(1, -1.0, 1.0), random(1, 0.0, std::f64::consts::TAU));
    let across = (-y.clone().square() + 1.0).sqrt();
    let (x, z) = (across.clone() * angle.clone().cos(), across * angle.sin());
    let pixel = 2.0 / (0.8 * f64::from(size));
    let scale = random(1, 0.8, 1.25) * (f64::from(sigma) * pixel);
    let device = if tracked == Tracked::Nothing { device.clone() } else { device.clone().autodiff() };
    let all = tracked == Tracked::Everything;
    let gaussians = Gaussians::new(
        leaf(Tensor::cat(vec![x * 0.64, y * 0.9 + 0.85, z * 0.3], 1), &device, all),
        leaf(random(4, -1.0, 1.0), &device, all),
        leaf(Tensor::cat(vec![scale.clone(), scale.clone(), scale * 0.5], 1), &device, all),
        leaf(random(1, 0.3, 1.0).reshape([n]), &device, all),
        leaf(random(3, 0.0, 1.0), &device, tracked != Tracked::Nothing),
    );
    gaussians.expect("shapes")
}

fn leaf<const D: usize>(tensor: Tensor<D>, device: &Device, is_tracked: bool) -> Tensor<D> {
    let tensor = Tensor::from_data(tensor.into_data(), device);
    if is_tracked { tensor.require_grad() } else { tensor }
}

/// Median time, and peak of host memory beyond the memory before the preparation.
#[derive(Clone, Copy)]
struct Figure {
    time: Duration,
    bytes: usize,
}

/// Times `part` with inputs from `prepare`, several times.
fn measure<T, R>(device: &Device, mut prepare: impl FnMut() -> T, mut part: impl FnMut(T) -> R) -> Figure {
    let mut times = Vec::new();
    let mut bytes = 0;
    let begin = Instant::now();
    while times.len() < 4 || (begin.elapsed() < TIME_PER_FIGURE && times.len() < 50) {
        MEMORY.reset_peak_usage();
        let before = MEMORY.current_usage();
        let input = prepare();
        device.sync().expect("the device finishes");
        let start = Instant::now();
        let output = part(input);
        device.sync().expect("the device finishes");
        times.push(start.elapsed());
        bytes = MEMORY.peak_usage().saturating_sub(before);
        drop(output);
    }
    times.remove(0);
    times.sort();
    Figure { time: times[times.len() / 2], bytes }
}

struct Case {
    n: usize,
    size: u32,
    views: usize,
    /// Standard deviation in pixels.
    sigma: f32,
}

/// One line of the table.
fn run(case: &Case, tracked: Tracked, device: &Device, on_host: bool) {
    let cameras = Camera::orbit(case.views, case.size, case.size);
    let options = RenderOptions::inria();
    let gaussians = human(case.n, case.size, case.sigma, tracked, device);
    let counts = render(&gaussians, &cameras, &options).expect("rendered").counts;
    let forward = measure(device, || (), |()| render(&gaussians, &cameras, &options).expect("rendered"));
    let shape = [case.views, case.size as usize, case.size as usize, 3];
    let inner = gaussians.device();
    let upstream = Tensor::<4>::full(shape, 0.5, &inner);
    let backward = (tracked != Tracked::Nothing).then(|| {
        let prepare = || {
            let rendered = render(&gaussians, &cameras, &options).expect("rendered");
            (rendered.color * upstream.clone()).sum()
        };
        let part = |loss: Tensor<1>| {
            let gradients = loss.backward();
            assert!(gaussians.colors.grad(&gradients).is_some());
            gradients
        };
        measure(device, prepare, part)
    });
    let ms = |figure: Figure| format!("{:.1}", figure.time.as_secs_f64() * 1e3);
    let pixels = case.views * case.size as usize * case.size as usize;
    let of_host = |text: String| if on_host { text } else { "–".into() };
    let mb = |figure: Figure| of_host(format!("{:.1}", figure.bytes as f64 / 1e6));
    // The image comes out, its gradient comes in, the inputs' gradients come out: they are not scratch memory.
    let (image, upstream) = (16 * pixels, 12 * pixels);
    let gradients = case.n * if tracked == Tracked::Everything { 56 } else { 12 };
    let budget = (400 * case.n + 40 * pixels) as f64;
    let share = |figure: Figure, outputs: usize| {
        of_host(format!("{:.0} %", 100.0 * figure.bytes.saturating_sub(outputs) as f64 / budget))
    };
    let tracked = match tracked {
        Tracked::Nothing => "nothing",
        Tracked::Colors => "colours",
        Tracked::Everything => "everything",
    };
    println!(
        "| {}k | {}² | {} | {:.1} | {tracked} | {:.2} M | {} | {} | {} | {} | {} | {} |",
        case.n / 1000,
        case.size,
        case.views,
        case.sigma,
        counts.intersections as f64 / 1e6,
        ms(forward),
        mb(forward),
        share(forward, image),
        backward.map_or("–".into(), ms),
        backward.map_or("–".into(), mb),
        backward.map_or("–".into(), |figure| share(figure, image + upstream + gradients)),
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |name: &str| {
        arguments.iter().position(|a| a == name).and_then(|i| arguments.get(i + 1)).map(String::as_str)
    };
    let full = arguments.iter().any(|a| a == "--full");
    let only = value("--only").unwrap_or_default();
    let name = value("--device").unwrap_or("cpu");
    let device = match name {
        "cpu" => Device::flex(),
        "wgpu" | "vulkan" => Device::wgpu(DeviceKind::DefaultDevice),
        other => {
            eprintln!("--device {other}: allowed are cpu, wgpu, vulkan");
            std::process::exit(2);
        }
    };
    let commit = std::process::Command::new("git").args(["rev-parse", "--short", "HEAD"]).output();
    let commit = commit.ok().and_then(|o| String::from_utf8(o.stdout).ok()).unwrap_or_default();
    println!("device {}, {} threads, commit {}", name, rayon::current_num_threads(), commit.trim());
    println!(
        "\n| N | image | V | σ, px | tracked | intersections | forward, ms | peak, MB | of budget | backward, ms | peak of both, MB | of budget |"
    );
    println!("|{}", " ---: |".repeat(12));
    let mut cases = vec![Case { n: 400_000, size: 1024, views: 1, sigma: 1.0 }];
    if full {
        for n in [50_000, 200_000, 400_000, 1_000_000] {
            for size in [512, 1024, 2048] {
                cases.extend([1, 4].map(|views| Case { n, size, views, sigma: 1.0 }));
            }
        }
        // The same splats on a larger, emptier canvas, and larger splats on the same canvas.
        cases.extend([0.5, 2.0, 4.0].map(|sigma| Case { n: 400_000, size: 1024, views: 1, sigma }));
    }
    for case in &cases {
        for tracked in [Tracked::Nothing, Tracked::Colors, Tracked::Everything] {
            let label = format!("{}k {} {}", case.n / 1000, case.size, case.views);
            if label.contains(only) {
                run(case, tracked, &device, name == "cpu");
            }
        }
    }
}
