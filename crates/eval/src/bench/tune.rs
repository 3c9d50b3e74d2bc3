//! Fitting a person's Gaussians to the photographs that they were made of: what that costs with everything tracked, and with colours
//! alone.

use std::time::{Duration, Instant};

use burn::tensor::Tensor;
use snapsnap_data::sample::TestItem;
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use super::config::Tune;
use crate::EvalError;
use crate::evaluate::person::People;

/// Steps of a fit.
pub(super) const STEPS: usize = 40;
/// Step sizes of Adam: means in metres, rotations, scales and opacities as shares of themselves, colours.
const RATES: [f64; 5] = [1e-4, 1e-3, 5e-3, 5e-3, 1e-2];

/// Adam's memory of a parameter.
struct Moments<const D: usize> {
    mean: Tensor<D>,
    squares: Tensor<D>,
}

impl<const D: usize> Moments<D> {
    fn new(like: &Tensor<D>) -> Self {
        Self { mean: like.zeros_like(), squares: like.zeros_like() }
    }

    /// The step against a gradient, of about 1.
    fn direction(&mut self, gradient: Tensor<D>, step: usize) -> Tensor<D> {
        const BETAS: [f64; 2] = [0.9, 0.99];
        self.mean = self.mean.clone() * BETAS[0] + gradient.clone() * (1.0 - BETAS[0]);
        self.squares = self.squares.clone() * BETAS[1] + gradient.square() * (1.0 - BETAS[1]);
        let [mean, square] = BETAS.map(|beta| 1.0 - beta.powi(step as i32 + 1));
        self.mean.clone() / mean / ((self.squares.clone() / square).sqrt() + 1e-8)
    }
}

/// Fits Gaussians (world frame) to a person's photographs with an L1 loss; also the time of each step. What is not fitted is not
/// tracked, and costs neither gradients nor moments.
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
    let inner = |x: &Tensor<2>| Tensor::from_data(x.to_data(), &device);
    let mut rows = [&gaussians.means, &gaussians.rotations, &gaussians.scales, &gaussians.colors].map(inner);
    let mut opacities: Tensor<1> = Tensor::from_data(gaussians.opacities.to_data(), &device);
    let all = what == Tune::All;
    let mut moments: Vec<Option<Moments<2>>> = rows
        .iter()
        .enumerate()
        .map(|(i, x)| (all || i == 3).then(|| Moments::new(&x.clone().inner())))
        .collect();
    let mut of_opacities = all.then(|| Moments::new(&opacities.clone().inner()));
    let mut times = Vec::new();
    for step in 0..steps {
        let start = Instant::now();
        let tracked = |x: &Tensor<2>, is: bool| if is { x.clone().require_grad() } else { x.clone() };
        let leaves: Vec<Tensor<2>> =
            rows.iter().zip(&moments).map(|(x, moments)| tracked(x, moments.is_some())).collect();
        let open = if all { opacities.clone().require_grad() } else { opacities.clone() };
        let [means, rotations, scales, colors] = [0, 1, 2, 3].map(|i| leaves[i].clone());
        let set = Gaussians::new(means, rotations, scales, open.clone(), colors)?;
        let rendered = render(&set, &cameras, &RenderOptions::inria())?;
        let gradients = (rendered.color - targets.clone()).abs().mean().backward();
        for (i, moments) in moments.iter_mut().enumerate() {
            let Some(moments) = moments else { continue };
            let Some(gradient) = leaves[i].grad(&gradients) else { continue };
            let direction = moments.direction(gradient, step);
            let value = rows[i].clone().inner();
            // Colours are bound to what a picture can hold, scales grow and shrink by shares.
            let moved = match i {
                2 => value.clone() - value * direction * RATES[2],
                3 => (value - direction * RATES[4]).clamp(0.0, 1.0),
                _ => value - direction * RATES[i],
            };
            rows[i] = Tensor::from_inner(moved);
        }
        if let Some((moments, gradient)) = of_opacities.as_mut().zip(open.grad(&gradients)) {
            let value = opacities.clone().inner();
            let direction = moments.direction(gradient, step);
            opacities = Tensor::from_inner((value - direction * RATES[3]).clamp(0.0, 1.0));
        }
        device.sync().expect("the device finishes its work");
        times.push(start.elapsed());
    }
    let [means, rotations, scales, colors] = rows.map(Tensor::inner);
    Ok((Gaussians::new(means, rotations, scales, opacities.inner(), colors)?, times))
}
