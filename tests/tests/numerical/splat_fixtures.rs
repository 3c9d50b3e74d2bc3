//! The splatting operation against the f64 reference renders and gradients of `tests/data/splat`.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, cameras, render};
use snapsnap_tests::{Numbers, device, fixture, values};

use crate::distance;

/// One fixture: inputs, expected pictures and gradients.
struct Case {
    numbers: Numbers,
    cameras: Vec<Camera>,
    options: RenderOptions,
}

/// Names of the differentiable inputs.
const INPUTS: [&str; 6] = ["means", "rotations", "scales", "opacities", "colors", "background"];

impl Case {
    fn load(name: &str) -> Self {
        let path = fixture(&format!("splat/{name}.safetensors"));
        let cameras = cameras::read(&fixture(&format!("splat/{name}.cameras.json"))).expect("cameras");
        let numbers = Numbers::read(&path);
        let preset = match numbers.metadata("preset").as_str() {
            "inria" => RenderOptions::inria(),
            "gsplat_1_5" => RenderOptions::gsplat_1_5(),
            other => panic!("preset {other}"),
        };
        let antialiased = numbers.metadata("antialiased") == "true";
        Self { numbers, cameras, options: RenderOptions { antialiased, depth: true, ..preset } }
    }

    /// Largest error of an un-banded pixel, and per input the relative L2 error and the cosine of its gradient.
    fn errors(&self, device: &Device) -> (f64, Vec<(&'static str, f64, f64)>) {
        let device = device.clone().autodiff();
        let n = &self.numbers;
        let means = n.tensor::<2>("means", &device).require_grad();
        let rotations = n.tensor::<2>("rotations", &device).require_grad();
        let scales = n.tensor::<2>("scales", &device).require_grad();
        let opacities = n.tensor::<1>("opacities", &device).require_grad();
        let colors = n.tensor::<2>("colors", &device).require_grad();
        let background = n.tensor::<1>("background", &device).require_grad();
        let gaussians = Gaussians::new(
            means.clone(),
            rotations.clone(),
            scales.clone(),
            opacities.clone(),
            colors.clone(),
        )
        .expect("shapes");
        let options = RenderOptions { background: Some(background.clone()), ..self.options.clone() };
        let mut loss = Tensor::<1>::zeros([1], &device);
        let mut worst = 0.0_f64;
        for (i, camera) in self.cameras.iter().enumerate() {
            let rendered = render(&gaussians, std::slice::from_ref(camera), &options).expect("rendered");
            let (_, banded) = n.u8(&format!("banded.{i}"));
            let parts = [
                ("color", rendered.color.squeeze_dim::<3>(0).reshape([-1])),
                ("alpha", rendered.alpha.reshape([-1])),
                ("depth", rendered.depth.expect("asked for").reshape([-1])),
            ];
            for (part, got) in parts {
                let (_, expected) = n.f64(&format!("{part}.{i}"));
                let channels = expected.len() / banded.len();
                let found: Vec<f32> = values(got.clone());
                for (at, (f, e)) in found.iter().zip(&expected).enumerate() {
                    if banded[at / channels] == 0 {
                        worst = worst.max(distance(f64::from(*f), *e));
                    }
                }
                let (_, upstream) = n.f32(&format!("grad_{part}.{i}"));
                let len = upstream.len();
                let upstream = Tensor::<1>::from_data(TensorData::new(upstream, [len]), &device);
                loss = loss + (got * upstream).sum();
            }
        }
        let grads = loss.backward();
        let found = [
            values(means.grad(&grads).expect("tracked").reshape([-1])),
            values(rotations.grad(&grads).expect("tracked").reshape([-1])),
            values(scales.grad(&grads).expect("tracked").reshape([-1])),
            values(opacities.grad(&grads).expect("tracked")),
            values(colors.grad(&grads).expect("tracked").reshape([-1])),
            values(background.grad(&grads).expect("tracked")),
        ];
        let errors = INPUTS.iter().zip(found).map(|(input, found)| {
            let (_, expected) = n.f64(&format!("vjp.{input}"));
            let (mut dot, mut ff, mut ee, mut dd) = (0.0, 0.0, 0.0, 0.0);
            for (f, e) in found.iter().map(|&f| f64::from(f)).zip(expected) {
                (dot, ff, ee, dd) = (dot + f * e, ff + f * f, ee + e * e, dd + (f - e) * (f - e));
            }
            (*input, (dd / ee).sqrt(), dot / (ff * ee).sqrt())
        });
        (worst, errors.collect())
    }
}

fn check(name: &str) {
    let (case, Some(device)) = (Case::load(name), device()) else { return };
    let (pixels, gradients) = case.errors(&device);
    println!("{name}: pixels {pixels:.1e}");
    for (input, error, cosine) in &gradients {
        println!("{name}: {input} relative L2 {error:.1e}, 1 - cosine {:.1e}", 1.0 - cosine);
    }
    assert!(pixels <= 2e-5, "{name}: pixels differ by {pixels:e}");
    for (input, error, cosine) in gradients {
        assert!(error <= 1e-3, "{name}: gradient of {input} is off by {error:e}");
        assert!(cosine >= 0.99999, "{name}: gradient of {input} has cosine {cosine}");
    }
}

macro_rules! fixtures {
    ($($name:ident)*) => {
        $(#[test]
        fn $name() {
            check(stringify!($name));
        })*
    };
}

fixtures!(
    plain
    antialiased
    human_like
    stack
    unnormalised_rotations
    needles
    near_plane
    far_from_origin
);
