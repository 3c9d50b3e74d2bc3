//! Fit of a person's Gaussians to the photographs: the cost of gradients of all parameters, or of colours alone.

use std::time::{Duration, Instant};

use burn::tensor::Tensor;
use snapsnap_data::sample::TestItem;
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::EvalError;
use crate::evaluate::person::People;
use crate::variant::Tune;

/// Number of steps of a fit.
pub(super) const STEPS: usize = 40;
/// Step sizes of Adam: means in metres, rotations, scales relative to their size, opacities, colours.
const RATES: [f64; 5] = [1e-4, 1e-3, 5e-3, 5e-3, 1e-2];

/// Adam's moments of a parameter.
struct Moments {
    mean: Tensor<2>,
    squares: Tensor<2>,
}

impl Moments {
    /// The direction of a step, with components of about 1.
    fn direction(&mut self, gradient: Tensor<2>, step: usize) -> Tensor<2> {
        const BETAS: [f64; 2] = [0.9, 0.99];
        self.mean = self.mean.clone() * BETAS[0] + gradient.clone() * (1.0 - BETAS[0]);
        self.squares = self.squares.clone() * BETAS[1] + gradient.square() * (1.0 - BETAS[1]);
        let [mean, square] = BETAS.map(|beta| 1.0 - beta.powi(step as i32 + 1));
        self.mean.clone() / mean / ((self.squares.clone() / square).sqrt() + 1e-8)
    }
}

/// Fits Gaussians (world frame) to a person's stored photographs with an L1 loss. Also returns the time of each step.
/// Parameters that are not fitted are not tracked and need neither gradients nor moments.
pub(super) fn fit(
    gaussians: &Gaussians,
    people: &People,
    (row, inputs, item): (usize, &[usize], &TestItem),
    what: Tune,
    steps: usize,
) -> Result<(Gaussians, Vec<Duration>), EvalError> {
    let side = item.side;
    let cameras: Vec<Camera> = inputs.iter().map(|view| item.cameras[*view]).collect();
    let device = gaussians.device().autodiff();
    let target = |view: &usize| -> Result<Tensor<4>, EvalError> {
        Ok(people.target(row, *view, side)?.0.tensor(&device).permute([0, 2, 3, 1]))
    };
    let targets = Tensor::cat(inputs.iter().map(target).collect::<Result<Vec<_>, _>>()?, 0);
    let Gaussians { means, rotations, scales, opacities, colors } = gaussians.clone();
    let mut rows = [means, rotations, scales, opacities.unsqueeze_dim(1), colors]
        .map(|x: Tensor<2>| Tensor::<2>::from_data(x.to_data(), &device));
    let fitted = if what == Tune::All { 0..5 } else { 4..5 };
    let zeros = |x: &Tensor<2>| x.clone().inner().zeros_like();
    let initial = |x| Moments { mean: zeros(x), squares: zeros(x) };
    let mut moments: Vec<Moments> = rows[fitted.clone()].iter().map(initial).collect();
    let assembled = |[means, rotations, scales, opacities, colors]: [Tensor<2>; 5]| {
        Gaussians::new(means, rotations, scales, opacities.squeeze_dim(1), colors)
    };
    let mut times = Vec::new();
    for step in 0..steps {
        let start = Instant::now();
        let mut tracked = rows.clone();
        for x in &mut tracked[fitted.clone()] {
            *x = x.clone().require_grad();
        }
        let rendered = render(&assembled(tracked.clone())?, &cameras, &RenderOptions::inria())?;
        let gradients = (rendered.color - targets.clone()).abs().mean().backward();
        for (i, moments) in fitted.clone().zip(&mut moments) {
            let Some(gradient) = tracked[i].grad(&gradients) else { continue };
            let direction = moments.direction(gradient, step);
            let value = rows[i].clone().inner();
            // Steps of scales are relative to the scales. Opacities and colours stay in [0, 1].
            let moved = match i {
                2 => value.clone() - value * direction * RATES[i],
                3 | 4 => (value - direction * RATES[i]).clamp(0.0, 1.0),
                _ => value - direction * RATES[i],
            };
            rows[i] = Tensor::from_inner(moved);
        }
        device.sync().expect("the device finishes its work");
        times.push(start.elapsed());
    }
    Ok((assembled(rows.map(Tensor::inner))?, times))
}
