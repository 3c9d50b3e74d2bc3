//! Gradient descent through the differentiable renderer: random Gaussians are fitted to pictures of a scene.
//!
//! ```sh
//! cargo run --release --example fit_gaussians             # 300 steps, about a second on a CPU
//! cargo run --release --example fit_gaussians -- 1000
//! ```
//!
//! The pictures are renders of known Gaussians from eight cameras. A ninth camera measures the result from an unseen view.

use std::error::Error;

use burn::module::{Module, Param};
use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Distribution, Tensor};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, SplatError, render};

/// Gaussians that are fitted.
const COUNT: usize = 400;
/// Gaussians of the scene.
const TRUE_COUNT: usize = 60;
/// Side of the pictures in pixels.
const SIZE: u32 = 64;
const VIEWS: usize = 8;
/// Steps of a fit, unless the command line has another number.
pub const STEPS: usize = 300;
/// Views that a step compares.
const BATCH: usize = 2;

/// Uniformly random values, drawn on the CPU: all devices get the same ones.
fn uniform(size: [usize; 2], low: f64, high: f64, device: &Device) -> Tensor<2> {
    let values = Tensor::<2>::random(size, Distribution::Uniform(low, high), &Device::flex());
    Tensor::from_data(values.into_data(), device)
}

/// The point that all cameras look at, metres: `[1, 3]`.
fn centre(device: &Device) -> Tensor<2> {
    Tensor::from_floats([[0.0, 0.85, 0.0]], device)
}

/// Coloured blobs in a cube of 0.8 m.
fn scene(device: &Device) -> Result<Gaussians, SplatError> {
    Gaussians::new(
        uniform([TRUE_COUNT, 3], -0.4, 0.4, device) + centre(device),
        uniform([TRUE_COUNT, 4], -1.0, 1.0, device),
        uniform([TRUE_COUNT, 3], 0.04, 0.12, device),
        Tensor::full([TRUE_COUNT], 0.9, device),
        uniform([TRUE_COUNT, 3], 0.0, 1.0, device),
    )
}

/// The parameters: Gaussians before their activations, so that every value is allowed.
#[derive(Module, Debug)]
struct Model {
    means: Param<Tensor<2>>,
    rotations: Param<Tensor<2>>,
    log_scales: Param<Tensor<2>>,
    opacity_logits: Param<Tensor<1>>,
    color_logits: Param<Tensor<2>>,
}

impl Model {
    fn random(device: &Device) -> Self {
        Self {
            means: Param::from_tensor(uniform([COUNT, 3], -0.5, 0.5, device) + centre(device)),
            rotations: Param::from_tensor(uniform([COUNT, 4], -1.0, 1.0, device)),
            log_scales: Param::from_tensor(uniform([COUNT, 3], -3.5, -2.5, device)),
            opacity_logits: Param::from_tensor(Tensor::full([COUNT], -1.0, device)),
            color_logits: Param::from_tensor(uniform([COUNT, 3], -1.0, 1.0, device)),
        }
    }

    fn gaussians(&self) -> Result<Gaussians, SplatError> {
        Gaussians::new(
            self.means.val(),
            self.rotations.val(),
            self.log_scales.val().exp(),
            sigmoid(self.opacity_logits.val()),
            sigmoid(self.color_logits.val()),
        )
    }
}

/// Pictures `[V,H,W,3]` of the Gaussians.
fn pictures(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Tensor<4>, SplatError> {
    Ok(render(gaussians, cameras, &RenderOptions::inria())?.color)
}

/// The result of a fit.
pub struct Fit {
    /// Loss of each step.
    pub losses: Vec<f32>,
    /// PSNR in dB of an unseen view before the first step.
    pub before: f32,
    /// PSNR in dB of an unseen view after the last step.
    pub after: f32,
}

/// Fits random Gaussians to the pictures of a scene.
pub fn fit(device: &Device, steps: usize) -> Result<Fit, SplatError> {
    let tracking = device.clone().autodiff();
    Device::flex().seed(1);

    let scene = scene(device)?;
    let cameras = Camera::orbit(VIEWS, SIZE, SIZE);
    let unseen = [Camera::orbit_at_yaw_degrees(180.0 / VIEWS as f64, SIZE)];
    let truth = Tensor::<4>::from_data(pictures(&scene, &cameras)?.into_data(), &tracking);
    let unseen_truth = pictures(&scene, &unseen)?;
    let psnr = |model: &Model| -> Result<f32, SplatError> {
        let error = pictures(&model.gaussians()?, &unseen)?.inner() - unseen_truth.clone();
        Ok(-10.0 * error.square().mean().into_scalar::<f32>().log10())
    };

    let mut model = Model::random(&tracking);
    let before = psnr(&model)?;
    let mut adam = AdamConfig::new().with_epsilon(1e-15).init();
    let mut losses = Vec::new();
    for step in 0..steps {
        let first = step * BATCH % VIEWS;
        let found = pictures(&model.gaussians()?, &cameras[first..first + BATCH])?;
        let loss = (found - truth.clone().narrow(0, first, BATCH)).square().mean();
        losses.push(loss.clone().inner());
        let gradients = GradientsParams::from_grads(loss.backward(), &model);
        let rate = 0.02 * 0.05_f64.powf(step as f64 / steps as f64);
        model = adam.step(rate, model, gradients);
    }
    let losses = losses.into_iter().map(|loss| loss.into_scalar::<f32>()).collect();
    Ok(Fit { losses, before, after: psnr(&model)? })
}

fn main() -> Result<(), Box<dyn Error>> {
    let steps: usize = std::env::args().nth(1).map_or(Ok(STEPS), |text| text.parse())?;
    let Fit { losses, before, after } = fit(&Device::flex(), steps)?;
    for (step, loss) in losses.iter().enumerate().step_by(50) {
        println!("step {step}: loss {loss:.5}");
    }
    println!("unseen view: {before:.2} dB before, {after:.2} dB after");
    Ok(())
}
