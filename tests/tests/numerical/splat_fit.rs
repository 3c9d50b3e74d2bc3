//! Gradient descent through the splatting operation: random Gaussians are fitted to a scene.

use burn::module::{Module, Param};
use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};
use snapsnap_tests::scenes::{HostScene, Random};
use snapsnap_tests::{device, is_on_gpu, values};

const SIZE: u32 = 64;
const STEPS: usize = 500;
const VIEWS: usize = 8;
/// Views per step.
const BATCH: usize = 2;

/// Gaussians before activation.
#[derive(Module, Debug)]
struct Model {
    means: Param<Tensor<2>>,
    rotations: Param<Tensor<2>>,
    log_scales: Param<Tensor<2>>,
    opacity_logits: Param<Tensor<1>>,
    color_logits: Param<Tensor<2>>,
}

impl Model {
    fn random(n: usize, device: &Device) -> Self {
        let mut random = Random(1);
        let mut rows = |columns: usize, value: fn(&mut Random, usize) -> f32| {
            let values = (0..n * columns).map(|i| value(&mut random, i % columns)).collect::<Vec<_>>();
            Param::from_tensor(Tensor::<2>::from_data(TensorData::new(values, [n, columns]), device))
        };
        Self {
            means: rows(3, |r, k| [0.0, 0.85, 0.0][k] + r.between(-0.6, 0.6)),
            rotations: rows(4, |r, _| r.between(-1.0, 1.0)),
            log_scales: rows(3, |r, _| r.between(-4.0, -3.0)),
            color_logits: rows(3, |r, _| r.between(-1.0, 1.0)),
            opacity_logits: Param::from_tensor(Tensor::full([n], -1.0, device)),
        }
    }

    fn gaussians(&self) -> Gaussians {
        Gaussians::new(
            self.means.val(),
            self.rotations.val(),
            self.log_scales.val().exp(),
            sigmoid(self.opacity_logits.val()),
            sigmoid(self.color_logits.val()),
        )
        .expect("shapes")
    }
}

/// Coloured blobs inside a ball of 0.5 m.
fn target() -> HostScene {
    let mut r = Random(2);
    let gaussian = |_| {
        let p: [f32; 3] = std::array::from_fn(|_| r.between(-0.4, 0.4));
        let q: [f32; 4] = std::array::from_fn(|_| r.between(-1.0, 1.0));
        let s: [f32; 3] = std::array::from_fn(|_| r.between(0.04, 0.12));
        let c: [f32; 3] = std::array::from_fn(|_| r.uniform());
        [p[0], 0.85 + p[1], p[2], q[0], q[1], q[2], q[3], s[0], s[1], s[2], 0.9, c[0], c[1], c[2]]
    };
    HostScene { gaussians: (0..60).map(gaussian).collect(), background: [0.0; 3] }
}

/// Loss of each step, and the PSNR of an unseen view before and after.
fn fit(device: &Device) -> (Vec<f32>, f32, f32) {
    let orbit = |i: f64| Camera::orbit_at_yaw_degrees(i * 360.0 / VIEWS as f64, SIZE);
    let cameras: Vec<Camera> = (0..VIEWS).map(|i| orbit(i as f64)).collect();
    let options = RenderOptions::inria();
    let picture = |gaussians: &Gaussians, cameras: &[Camera]| {
        render(gaussians, cameras, &options).expect("rendered").color
    };
    let truth = target().on(device).gaussians();
    let held_out = [orbit(0.5)];
    let psnr = |model: &Model| {
        let error = picture(&model.gaussians(), &held_out).inner() - picture(&truth, &held_out);
        -10.0 * values(error.square().mean().reshape([1]))[0].log10()
    };
    let tracking = device.clone().autodiff();
    let pictures = Tensor::<4>::from_data(picture(&truth, &cameras).into_data(), &tracking);
    let mut model = Model::random(2000, &tracking);
    let before = psnr(&model);
    let mut adam = AdamConfig::new().with_epsilon(1e-15).init();
    let mut losses = Vec::new();
    for step in 0..STEPS {
        let first = step * BATCH % VIEWS;
        let color = picture(&model.gaussians(), &cameras[first..first + BATCH]);
        let error = color - pictures.clone().narrow(0, first, BATCH);
        let loss = error.square().mean();
        losses.push(loss.clone());
        let grads = GradientsParams::from_grads(loss.backward(), &model);
        let rate = 0.02 * 0.05_f64.powf(step as f64 / STEPS as f64);
        model = adam.step(rate, model, grads);
    }
    let after = psnr(&model);
    (losses.into_iter().map(|loss| values(loss.reshape([1]))[0]).collect(), before, after)
}

#[test]
fn random_gaussians_are_fitted_to_a_scene() {
    let Some(device) = device() else { return };
    let (losses, before, after) = fit(&device);
    println!("unseen view: {before:.2} dB before, {after:.2} dB after {STEPS} steps");
    assert!(before < 20.0, "nothing to learn: {before} dB");
    assert!(after > 30.0, "{after} dB");
    if is_on_gpu() {
        let (expected, _, cpu) = fit(&Device::flex());
        let worst = losses.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let relative = losses.iter().zip(&expected).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f32::max);
        println!("against the CPU: loss within {worst:.1e}, relatively {relative:.1e}; {cpu:.2} dB there");
        // Rounding errors grow with the steps. Both descents agree to 1e-3 of the first loss.
        assert!(worst < 1e-3 * expected[0] && (after - cpu).abs() < 0.3);
    }
}
