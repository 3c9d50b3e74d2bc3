//! The splatting operation against the dense f64 oracle and the fixtures of `tests/data/splat`, and the oracle against
//! itself and the fixtures.

use snapsnap_splat::reference::{self, Cutoff, Scene};
use snapsnap_splat::{Camera, RenderOptions, camera_file};
use snapsnap_tests::scenes::{HostScene, forward_camera, random_scene, random_upstream};
use snapsnap_tests::{Numbers, device, device_name, fixture};

use crate::distance;

/// Inputs, and their columns among the 14 numbers of a Gaussian.
const PARTS: [(&str, std::ops::Range<usize>); 5] =
    [("means", 0..3), ("rotations", 3..7), ("scales", 7..10), ("opacities", 10..11), ("colors", 11..14)];

/// Relative L2 error and 1 − cosine of `found` against `expected`.
fn compare(found: &[f64], expected: &[f64]) -> (f64, f64) {
    let (mut dot, mut ff, mut ee, mut dd) = (0.0, 0.0, 0.0, 0.0);
    for (f, e) in found.iter().zip(expected) {
        (dot, ff, ee, dd) = (dot + f * e, ff + f * f, ee + e * e, dd + (f - e) * (f - e));
    }
    if ee == 0.0 { (ff.sqrt(), 0.0) } else { ((dd / ee).sqrt(), 1.0 - dot / (ff * ee).sqrt()) }
}

fn flat(gaussians: &[[f64; 14]], part: &std::ops::Range<usize>) -> Vec<f64> {
    gaussians.iter().flat_map(|g| g[part.clone()].to_vec()).collect()
}

fn preset(numbers: &Numbers) -> RenderOptions {
    let preset = match numbers.metadata("preset").as_str() {
        "inria" => RenderOptions::inria(),
        "gsplat_1_5" => RenderOptions::gsplat_1_5(),
        other => panic!("preset {other}"),
    };
    RenderOptions { antialiased: numbers.metadata("antialiased") == "true", ..preset }
}

/// The oracle uses no device, so its own tests run once, on flex.
fn once() -> bool {
    device_name() == "flex"
}

const FIXTURES: [&str; 8] = [
    "plain",
    "antialiased",
    "human_like",
    "stack",
    "unnormalised_rotations",
    "needles",
    "near_plane",
    "far_from_origin",
];

/// A fixture: numbers, scene, cameras, options.
fn load(name: &str) -> (Numbers, HostScene, Vec<Camera>, RenderOptions) {
    let numbers = Numbers::read(&fixture(&format!("splat/{name}.safetensors")));
    let cameras = camera_file::read(&fixture(&format!("splat/{name}.cameras.json"))).expect("cameras");
    let columns = |name: &str| numbers.f32(name).1;
    let [m, q, s, o, c] = ["means", "rotations", "scales", "opacities", "colors"].map(columns);
    let gaussian = |i: usize| {
        let all = [
            &m[3 * i..3 * i + 3],
            &q[4 * i..4 * i + 4],
            &s[3 * i..3 * i + 3],
            &o[i..=i],
            &c[3 * i..3 * i + 3],
        ];
        <[f32; 14]>::try_from(all.concat()).expect("14 numbers")
    };
    let background = columns("background").try_into().expect("three");
    let scene = HostScene { gaussians: (0..o.len()).map(gaussian).collect(), background };
    let options = preset(&numbers);
    (numbers, scene, cameras, options)
}

/// Largest difference of `found` `[H·W]` from camera `camera` of the fixture, over the pixels that are not `banded`.
fn worst<'a>(
    numbers: &Numbers,
    camera: usize,
    found: impl Iterator<Item = [f64; 5]> + 'a,
    banded: &[bool],
) -> f64 {
    let [color, alpha, depth] =
        ["color", "alpha", "depth"].map(|part| numbers.f64(&format!("{part}.{camera}")).1);
    let mut worst = 0.0_f64;
    for (p, found) in found.enumerate().filter(|(p, _)| !banded[*p]) {
        let expected = [color[3 * p], color[3 * p + 1], color[3 * p + 2], alpha[p], depth[p]];
        for (f, e) in found.iter().zip(expected) {
            worst = worst.max(distance(*f, e));
        }
    }
    worst
}

/// The fixture's weights of a camera's pixels `[H·W]`: red, green, blue, alpha, depth.
fn upstream(numbers: &Numbers, camera: usize) -> Vec<[f32; 5]> {
    let [color, alpha, depth] =
        ["color", "alpha", "depth"].map(|part| numbers.f32(&format!("grad_{part}.{camera}")).1);
    (0..alpha.len()).map(|p| [color[3 * p], color[3 * p + 1], color[3 * p + 2], alpha[p], depth[p]]).collect()
}

/// Compares pixels of all fixtures, and gradients of the small ones.
#[test]
fn the_oracle_agrees_with_the_fixtures() {
    for name in FIXTURES.into_iter().filter(|_| once()) {
        let (numbers, host, cameras, options) = load(name);
        let scene = host.in_f64();
        let mut gradient: Option<Scene<f64>> = None;
        for (i, camera) in cameras.iter().enumerate() {
            let pixels = reference::render(&scene, camera, &options, Cutoff::Hard);
            let worst = worst(&numbers, i, pixels.iter().copied(), &vec![false; pixels.len()]);
            println!("{name}, camera {i}: pixels {worst:.1e}");
            // The constants ε, α_max and 1/255 are f32 here, f64 in the fixtures.
            assert!(worst < 1e-7, "{name}: {worst:e}");
            let upstream: Vec<[f64; 5]> =
                upstream(&numbers, i).into_iter().map(|weights| weights.map(f64::from)).collect();
            if ["antialiased", "near_plane", "far_from_origin"].contains(&name) {
                let part = reference::gradient(&scene, camera, &options, Cutoff::Hard, &upstream);
                match &mut gradient {
                    None => gradient = Some(part),
                    Some(sum) => {
                        let pairs = sum.gaussians.iter_mut().flatten().zip(part.gaussians.iter().flatten());
                        pairs.for_each(|(s, p)| *s += p);
                    }
                }
            }
        }
        if let Some(gradient) = gradient {
            for (part, range) in PARTS {
                let (_, expected) = numbers.f64(&format!("vjp.{part}"));
                let (error, _) = compare(&flat(&gradient.gaussians, &range), &expected);
                println!("{name}: {part} {error:.1e}");
                assert!(error < 1e-6, "{name}: gradient of {part}: {error:e}");
            }
        }
    }
}

/// Compares pixels and gradients of the operation, and pixels of the textbook formulas in f32, with every fixture.
#[test]
fn the_operation_agrees_with_the_fixtures_better_than_plain_f32() {
    let Some(device) = device() else { return };
    for name in FIXTURES {
        let (numbers, host, cameras, options) = load(name);
        let (mut plain, mut ours) = (0.0_f64, 0.0_f64);
        let mut gradient = vec![[0.0_f64; 14]; host.gaussians.len()];
        let mut background = [0.0_f64; 3];
        for (i, camera) in cameras.iter().enumerate() {
            let banded: Vec<bool> = numbers.u8(&format!("banded.{i}")).1.iter().map(|b| *b != 0).collect();
            let scene = Scene { gaussians: host.gaussians.clone(), background: host.background };
            let pixels = reference::render(&scene, camera, &options, Cutoff::Hard);
            plain = plain.max(worst(&numbers, i, pixels.iter().map(|p| p.map(f64::from)), &banded));
            let upstream = upstream(&numbers, i).concat();
            let pass = host.pass(std::slice::from_ref(camera), &options, &upstream, &device);
            let found = pass.image.chunks(5).map(|p| std::array::from_fn(|c| f64::from(p[c])));
            ours = ours.max(worst(&numbers, i, found, &banded));
            let sums = gradient.iter_mut().flatten().chain(&mut background);
            let parts = pass.gradient.iter().flatten().chain(&pass.background);
            sums.zip(parts).for_each(|(sum, part)| *sum += f64::from(*part));
        }
        println!("{name}: pixels {plain:.1e} with the plain formulas, {ours:.1e} with ours");
        assert!(ours <= 2e-5, "{name}: pixels differ by {ours:e}");
        let inputs = PARTS.map(|(part, range)| (part, flat(&gradient, &range)));
        for (part, found) in inputs.into_iter().chain([("background", background.to_vec())]) {
            let (error, angle) = compare(&found, &numbers.f64(&format!("vjp.{part}")).1);
            println!("{name}: {part} relative L2 {error:.1e}, 1 - cosine {angle:.1e}");
            assert!(error <= 1e-3 && angle <= 1e-5, "{name}: gradient of {part}: {error:e}, {angle:e}");
        }
        if name == "far_from_origin" {
            assert!(ours < 0.5 * plain, "{name}: {ours:e}, plain {plain:e}");
        }
    }
}

/// With the smooth cut-off the image is differentiable. Differences agree with the dual numbers for every single input.
#[test]
fn the_oracles_gradients_agree_with_finite_differences() {
    if !once() {
        return;
    }
    for (seed, antialiased) in [(1, false), (2, true)] {
        let camera = forward_camera(20, 16);
        let options = RenderOptions { antialiased, max_alpha: 0.9999, ..RenderOptions::inria() };
        let mut host = random_scene(8, seed);
        host.gaussians.iter_mut().for_each(|g| g[10] *= 0.9);
        let scene = host.in_f64();
        let upstream: Vec<[f64; 5]> =
            random_upstream(320, seed).chunks(5).map(|c| std::array::from_fn(|k| f64::from(c[k]))).collect();
        let loss = |scene: &Scene<f64>| -> f64 {
            let pixels = reference::render(scene, &camera, &options, Cutoff::Smooth);
            pixels.iter().zip(&upstream).flat_map(|(p, u)| p.iter().zip(u)).map(|(p, u)| p * u).sum()
        };
        let gradient = reference::gradient(&scene, &camera, &options, Cutoff::Smooth, &upstream);
        let check = |what: String, analytic: f64, difference: f64| {
            assert!(
                (analytic - difference).abs() < 1e-5 * (1.0 + analytic.abs()),
                "{what}: {analytic} {difference}"
            );
        };
        let step = 1e-6;
        for i in 0..scene.gaussians.len() {
            for k in 0..14 {
                let at = |h: f64| {
                    let mut moved = scene.clone();
                    moved.gaussians[i][k] += h;
                    loss(&moved)
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                check(format!("Gaussian {i}, number {k}"), gradient.gaussians[i][k], difference);
            }
        }
        for k in 0..3 {
            let at = |h: f64| {
                let mut moved = scene.clone();
                moved.background[k] += h;
                loss(&moved)
            };
            check(format!("background {k}"), gradient.background[k], (at(step) - at(-step)) / (2.0 * step));
        }
    }
}

/// One random scene on the device and in the oracle.
fn check(name: &str, host: &HostScene, camera: &Camera, options: &RenderOptions) {
    let Some(device) = device() else { return };
    let scene = host.in_f64();
    let pixels = (camera.width * camera.height) as usize;
    let banded = reference::banded(&scene, camera, options);
    let mut upstream = random_upstream(pixels, 5);
    for (pixel, _) in banded.iter().enumerate().filter(|(_, banded)| **banded) {
        upstream[5 * pixel..5 * pixel + 5].fill(0.0);
    }
    let pass = host.pass(std::slice::from_ref(camera), options, &upstream, &device);
    let expected = reference::render(&scene, camera, options, Cutoff::Hard);
    let mut worst = 0.0_f64;
    for (pixel, (found, expected)) in pass.image.chunks(5).zip(&expected).enumerate() {
        for (f, e) in found.iter().zip(*expected) {
            if !banded[pixel] {
                worst = worst.max(distance(f64::from(*f), e));
            }
        }
    }
    let upstream: Vec<[f64; 5]> =
        upstream.chunks(5).map(|c| std::array::from_fn(|k| f64::from(c[k]))).collect();
    let gradient = reference::gradient(&scene, camera, options, Cutoff::Hard, &upstream);
    let share = banded.iter().filter(|b| **b).count() as f64 / pixels as f64;
    assert!(share < 0.2 || pixels < 100, "{name}: {share} of the pixels are banded, nothing is tested");
    assert!(worst < 2e-5, "{name}: pixels differ by {worst:e}");
    let found: Vec<[f64; 14]> = pass.gradient.iter().map(|g| g.map(f64::from)).collect();
    let plain = Scene { gaussians: host.gaussians.clone(), background: host.background };
    let plain = reference::render(&plain, camera, options, Cutoff::Hard);
    let mut plain_worst = 0.0_f64;
    for ((found, expected), _) in plain.iter().zip(&expected).zip(&banded).filter(|(_, banded)| !**banded) {
        for (f, e) in found.iter().zip(*expected) {
            plain_worst = plain_worst.max(distance(f64::from(*f), e).min(9.0));
        }
    }
    let mut report = format!("{name}: pixels {worst:.0e} (plain formulas {plain_worst:.0e})");
    for (part, range) in PARTS {
        let (error, angle) = compare(&flat(&found, &range), &flat(&gradient.gaussians, &range));
        report += &format!(", {part} {error:.0e}");
        assert!(error < 1e-3 && angle < 1e-5, "{name}: gradient of {part}: {error:e}, 1 - cosine {angle:e}");
        // Gradients that are zero in the oracle are exactly zero.
        for (f, e) in found.iter().zip(&gradient.gaussians) {
            if e[range.clone()].iter().all(|e| *e == 0.0) {
                assert!(f[range.clone()].iter().all(|f| *f == 0.0), "{name}: {part} of an unseen Gaussian");
            }
        }
    }
    let (error, _) = compare(&pass.background.map(f64::from), &gradient.background);
    assert!(error < 1e-4, "{name}: gradient of the background: {error:e}");
    println!("{report}");
}

#[test]
fn odd_sizes() {
    for (seed, (width, height)) in [(1, 1), (15, 47), (17, 17), (97, 129), (64, 16)].into_iter().enumerate() {
        let host = random_scene(16, seed as u64);
        check(&format!("{width}x{height}"), &host, &forward_camera(width, height), &RenderOptions::inria());
    }
}

#[test]
fn presets_and_antialiasing() {
    for (name, preset) in [("inria", RenderOptions::inria()), ("gsplat", RenderOptions::gsplat_1_5())] {
        for antialiased in [false, true] {
            let options = RenderOptions { antialiased, ..preset.clone() };
            let name = format!("{name}, antialiased {antialiased}");
            check(&name, &random_scene(30, 11), &forward_camera(40, 33), &options);
            // Antialiasing matters most for splats below a pixel.
            let mut tiny = random_scene(30, 12);
            tiny.gaussians.iter_mut().for_each(|g| (7..10).for_each(|k| g[k] *= 0.05));
            check(&format!("{name}, tiny"), &tiny, &forward_camera(40, 33), &options);
        }
    }
}

/// Thin disks and needles of one to a thousand pixels, some of no thickness at all.
#[test]
fn needles_and_disks() {
    let mut host = random_scene(24, 21);
    for (i, g) in host.gaussians.iter_mut().enumerate() {
        g[7] *= 10.0_f32.powi(i as i32 % 4 - 1);
        g[8] *= 1e-3;
        g[9] *= if i % 3 == 0 { 0.0 } else { 1e-4 };
    }
    check("needles", &host, &forward_camera(40, 33), &RenderOptions::inria());
    // Thick enough that antialiasing leaves some opacity.
    let mut host = random_scene(24, 22);
    for (i, g) in host.gaussians.iter_mut().enumerate() {
        g[7] *= 10.0_f32.powi(i as i32 % 3);
        g[8] *= 0.05;
        g[9] *= 0.1;
        g[10] = 1.0;
    }
    check(
        "needles, antialiased",
        &host,
        &forward_camera(40, 33),
        &RenderOptions { antialiased: true, ..RenderOptions::inria() },
    );
}

/// Opaque layers: pixels close, and α is clamped.
#[test]
fn opaque_layers() {
    let mut host = random_scene(40, 31);
    host.gaussians.iter_mut().for_each(|g| g[10] = 1.0);
    check("opaque", &host, &forward_camera(33, 40), &RenderOptions::inria());
    check("opaque, gsplat", &host, &forward_camera(33, 40), &RenderOptions::gsplat_1_5());
}

/// Centres far outside the image, where J is clamped, and large enough to reach into it.
#[test]
fn beyond_the_border() {
    let mut host = random_scene(24, 41);
    for g in &mut host.gaussians {
        (g[0], g[1]) = (2.2 * g[0], 2.2 * g[1]);
        (7..10).for_each(|k| g[k] *= 4.0);
    }
    check("beyond the border", &host, &forward_camera(40, 33), &RenderOptions::inria());
}
