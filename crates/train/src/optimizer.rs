//! Optimisers: AdamW as published, or Muon for hidden matrices and kernels with AdamW for the other parameters
//! (docs/method.md, "Optimisation and schedules").

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use snapsnap_ops::host;
use snapsnap_ops::orthogonal::orthogonalised;

use crate::networks::{Networks, Parameter, Rows, moved, row};

/// Values per task of a step on the CPU.
const PIECE: usize = 1 << 14;
/// AdamW: decay of the gradients' mean, the value that is added to the root of the mean of squared gradients, and the
/// share of a weight that a step at rate 1 would remove. All three are the published ones.
pub(crate) const BETA1: f64 = 0.9;
pub(crate) const EPSILON: f64 = 1e-8;
pub(crate) const WEIGHT_DECAY: f64 = 0.05;
/// Muon: share of the former velocity in the direction of a step, and of a weight that a step at rate 1 would remove.
const MUON_MOMENTUM: f64 = 0.95;
pub(crate) const MUON_WEIGHT_DECAY: f64 = 0.02;

/// The section `[optimizer]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Highest learning rate of AdamW.
    pub rate: f64,
    /// Decay of the mean of squared gradients.
    pub beta2: f64,
    /// Muon for hidden matrices and kernels.
    pub muon: Option<MuonSettings>,
}

/// The section `[optimizer.muon]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MuonSettings {
    /// Highest learning rate. Updates are scaled to the size of AdamW's updates.
    pub rate: f64,
}

impl Default for OptimizerConfig {
    /// The published optimiser.
    fn default() -> Self {
        Self { rate: 1e-4, beta2: 0.999, muon: None }
    }
}

impl Default for MuonSettings {
    fn default() -> Self {
        Self { rate: 1e-3 }
    }
}

impl OptimizerConfig {
    /// The first key that makes no sense, and why.
    pub fn problem(&self) -> Option<(&'static str, String)> {
        let muon = self.muon.clone().unwrap_or_default();
        let shares = [("rate", self.rate, 10.0), ("beta2", self.beta2, 1.0), ("muon.rate", muon.rate, 10.0)];
        let (key, value, limit) =
            shares.into_iter().find(|(_, value, limit)| !(0.0..*limit).contains(value))?;
        Some((key, format!("is {value}, must be at least 0 and less than {limit}")))
    }

    /// An optimiser before its first step. With `decays_all`, norms, biases and δ decay as well, as in the published code.
    pub fn init(&self, decays_all: bool) -> Optimizer {
        Optimizer { config: self.clone(), decays_all, states: BTreeMap::new() }
    }
}

/// State of the optimiser for one parameter.
#[derive(Clone)]
#[allow(clippy::large_enum_variant, reason = "the tensors' memory is far larger")]
pub(crate) enum State {
    AdamW { time: u64, mean: Tensor<1>, squares: Tensor<1> },
    Muon { velocity: Tensor<1> },
}

/// An optimiser with its state.
pub struct Optimizer {
    config: OptimizerConfig,
    decays_all: bool,
    states: BTreeMap<String, State>,
}

/// Whether a parameter is a matrix or a kernel between the first layer and the last layers.
fn is_hidden(name: &str, rank: usize) -> bool {
    /// Parts of the names of first and last layers.
    const OUTER: [&str; 5] = ["patch_embed.", ".dpt.head.4.", "conv_in.", "conv_out.", "gs_conv."];
    // `downstream_headK.proj.weight` is the only layer of a linear head.
    let is_linear_head =
        name.contains("downstream_head") && name.ends_with("proj.weight") && !name.contains(".dpt.");
    rank >= 2 && !OUTER.iter().any(|part| name.contains(part)) && !is_linear_head
}

impl Optimizer {
    /// The device of a step for networks on `device`. With Muon it is the host: matrices are many and small, and each
    /// would be dozens of kernels on a GPU.
    pub(crate) fn device(&self, device: Device) -> Device {
        if self.config.muon.is_some() { Device::flex() } else { device }
    }

    /// Makes one step of all parameters that have a gradient, at `share` of the highest rates, with gradients times
    /// `factor`. Returns the values of all parameters, on the optimiser's device.
    pub fn step(&mut self, share: f64, networks: &Networks, gradients: Rows, factor: f64) -> Rows {
        let parameters = networks.parameters();
        let Some(device) = parameters.first().map(|first| self.device(first.values.device())) else {
            return Rows::new();
        };
        let trained = parameters.iter().filter(|parameter| gradients.contains_key(&parameter.name));
        let values = trained.map(|parameter| (parameter.name.clone(), parameter.values.clone()));
        let mut rows = moved(values.collect(), &device);
        let mut gradients = moved(gradients, &device);
        let work = parameters.into_iter().filter_map(|Parameter { name, shape, .. }| {
            let gradient = gradients.remove(&name)?;
            let (values, state) = (rows.remove(&name)?, self.states.remove(&name));
            Some((name, shape, values, gradient, state))
        });
        let work: Vec<_> = work.collect();
        let one = |(name, shape, values, gradient, state): (String, Vec<usize>, _, _, _)| {
            let (values, state) = match &self.config.muon {
                Some(settings) if is_hidden(&name, shape.len()) => {
                    // Kernels `[out, in, k, k]` become matrices `[out, in·k·k]`.
                    let size = [shape[0], shape[1..].iter().product()];
                    muon(settings, share, values, gradient, factor, state, size)
                }
                _ => {
                    let decays = shape.len() >= 2 || self.decays_all;
                    self.adamw(share, decays, values, gradient, factor, state)
                }
            };
            (name, values, state)
        };
        // Parameters are many and small. On the CPU, cores share them. Other devices order work by the calling thread.
        let done: Vec<_> = if device == Device::flex() {
            work.into_par_iter().with_max_len(1).map(one).collect()
        } else {
            work.into_iter().map(one).collect()
        };
        for (name, values, state) in done {
            rows.insert(name.clone(), values);
            self.states.insert(name, state);
        }
        rows
    }

    /// AdamW (Loshchilov and Hutter). Burn's AdamW corrects the moments' bias in f32, so that its second step differs
    /// from PyTorch's by 1.5e-5.
    pub(crate) fn adamw(
        &self,
        share: f64,
        decays: bool,
        values: Tensor<1>,
        gradient: Tensor<1>,
        factor: f64,
        state: Option<State>,
    ) -> (Tensor<1>, State) {
        let (beta1, beta2, epsilon) = (BETA1, self.config.beta2, EPSILON);
        let device = values.device();
        let (time, mean, squares) = match state {
            Some(State::AdamW { time, mean, squares }) => {
                (time + 1, mean.to_device(&device), squares.to_device(&device))
            }
            _ => (1, gradient.zeros_like(), gradient.zeros_like()),
        };
        let rate = share * self.config.rate;
        let kept = 1.0 - if decays { rate * WEIGHT_DECAY } else { 0.0 };
        let corrections = [beta1, beta2].map(|beta| 1.0 - beta.powf(time as f64));
        let (pace, root) = (rate / corrections[0], corrections[1].sqrt().recip());
        if device == Device::flex() {
            // One pass over memory instead of ten.
            let [mut values, gradient, mut mean, mut squares] = [values, gradient, mean, squares].map(host);
            let [b1, b2] = [beta1, beta2].map(|beta| [beta as f32, (1.0 - beta) as f32]);
            let [kept, pace, root, epsilon, factor] =
                [kept, pace, root, epsilon, factor].map(|value| value as f32);
            let moments = mean.par_chunks_mut(PIECE).zip(squares.par_chunks_mut(PIECE));
            let pieces = values.par_chunks_mut(PIECE).zip(gradient.par_chunks(PIECE)).zip(moments);
            pieces.for_each(|((values, gradient), (mean, squares))| {
                for (((value, gradient), mean), squares) in
                    values.iter_mut().zip(gradient).zip(mean).zip(squares)
                {
                    let gradient = gradient * factor;
                    *mean = *mean * b1[0] + gradient * b1[1];
                    *squares = *squares * b2[0] + gradient * gradient * b2[1];
                    let length = squares.sqrt() * root + epsilon;
                    *value = *value * kept - *mean * pace / length;
                }
            });
            let [values, mean, squares] = [values, mean, squares].map(|values| row(values, &device));
            return (values, State::AdamW { time, mean, squares });
        }
        let gradient = gradient * factor;
        let mean = mean * beta1 + gradient.clone() * (1.0 - beta1);
        let squares = squares * beta2 + gradient.square() * (1.0 - beta2);
        let length = squares.clone().sqrt() * root + epsilon;
        (values * kept - mean.clone() * pace / length, State::AdamW { time, mean, squares })
    }

    /// State for a checkpoint: rows `KIND/NAME`, and the number of AdamW's steps by name.
    pub fn record(&self) -> (Rows, BTreeMap<String, u64>) {
        let (mut rows, mut times) = (Rows::new(), BTreeMap::new());
        for (name, state) in &self.states {
            match state {
                State::AdamW { time, mean, squares } => {
                    times.insert(name.clone(), *time);
                    rows.insert(format!("mean/{name}"), mean.clone());
                    rows.insert(format!("squares/{name}"), squares.clone());
                }
                State::Muon { velocity } => {
                    rows.insert(format!("velocity/{name}"), velocity.clone());
                }
            }
        }
        (rows, times)
    }

    /// Restores the state from a checkpoint. Rows of unknown parameters are ignored.
    pub fn restore(
        &mut self,
        networks: &Networks,
        rows: &mut BTreeMap<String, Vec<f32>>,
        times: &BTreeMap<String, u64>,
        device: &Device,
    ) {
        for name in networks.shapes().into_keys() {
            let mut take = |kind: &str| Some(row(rows.remove(&format!("{kind}/{name}"))?, device));
            if let Some(velocity) = take("velocity") {
                self.states.insert(name, State::Muon { velocity });
            } else if let (Some(mean), Some(squares), Some(time)) =
                (take("mean"), take("squares"), times.get(&name))
            {
                self.states.insert(name, State::AdamW { time: *time, mean, squares });
            }
        }
    }
}

/// Muon (Jordan et al.): values and state after a step along the orthogonalised Nesterov momentum. The factor
/// 0.2·√(longest side) makes the step as long as one of AdamW (Liu et al., "Muon is scalable"). On the host.
fn muon(
    settings: &MuonSettings,
    share: f64,
    values: Tensor<1>,
    gradient: Tensor<1>,
    factor: f64,
    state: Option<State>,
    [rows, columns]: [usize; 2],
) -> (Tensor<1>, State) {
    let device = values.device();
    let rate = share * settings.rate;
    let kept = 1.0 - rate * MUON_WEIGHT_DECAY;
    let pace = rate * 0.2 * (rows.max(columns) as f64).sqrt();
    let mut velocity = match state {
        Some(State::Muon { velocity }) => host(velocity),
        _ => vec![0.0; rows * columns],
    };
    let (mut values, mut direction) = (host(values), host(gradient));
    let [momentum, factor, kept, pace] = [MUON_MOMENTUM, factor, kept, pace].map(|value| value as f32);
    for (velocity, gradient) in velocity.iter_mut().zip(&mut direction) {
        *gradient *= factor;
        *velocity = *velocity * momentum + *gradient;
        *gradient += *velocity * momentum;
    }
    let update = orthogonalised(direction, [rows, columns]);
    values.iter_mut().zip(update).for_each(|(value, update)| *value = *value * kept - update * pace);
    (row(values, &device), State::Muon { velocity: row(velocity, &device) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::optim::decay::WeightDecayConfig;
    use burn::optim::momentum::MomentumConfig;
    use burn::optim::{AdjustLrFn, MuonConfig, Optimizer as _};
    use burn::tensor::Distribution;
    use snapsnap_net::config::{Body, Config};
    use snapsnap_net::weights::random_predictor;

    #[test]
    fn muon_changes_neither_the_first_layer_nor_the_last() {
        let mut config = Config::default();
        let n = &mut config.network;
        (n.body, n.patch, n.side_heads) = (Body::Convolution, 8, false);
        (n.enc_dim, n.enc_depth, n.enc_heads, n.layer_dims, n.last_dim) = (8, 1, 1, [8; 4], 8);
        let predictor = Some(random_predictor(&config, 0, &Device::flex()));
        let parameters = Networks { predictor, regressors: Vec::new() }.parameters();
        let outer = parameters.iter().filter(|p| p.shape.len() >= 2 && !is_hidden(&p.name, p.shape.len()));
        let outer: Vec<&str> = outer.map(|p| p.name.as_str()).collect();
        assert_eq!(outer, ["unet.conv_in.weight", "unet.decoder.conv_out.weight"]);
    }

    /// Burn's Muon takes matrices only.
    #[test]
    fn muon_is_burns() {
        let settings = MuonSettings { rate: 0.01 };
        let momentum = MomentumConfig { momentum: MUON_MOMENTUM, dampening: 0.0, nesterov: true };
        let burns = MuonConfig::new()
            .with_momentum(momentum)
            .with_weight_decay(Some(WeightDecayConfig { penalty: MUON_WEIGHT_DECAY as f32 }))
            .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
            .build();
        let device = Device::flex();
        for size in [[6, 10], [24, 7]] {
            let random = || Tensor::<2>::random(size, Distribution::Normal(0.0, 1.0), &device);
            let mut values = random();
            let (mut ours, mut own, mut theirs) = (values.clone().reshape([-1]), None, None);
            for _ in 0..3 {
                let gradient = random();
                let (new, state) = burns.step(0.01, values, gradient.clone(), theirs);
                (values, theirs) = (new, state);
                let (new, state) = muon(&settings, 1.0, ours, gradient.reshape([-1]), 1.0, own, size);
                (ours, own) = (new, Some(state));
            }
            let (ours, theirs) = (host(ours), host(values));
            let apart = ours.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            println!("{size:?}: {apart:e} apart");
            assert!(apart <= 1e-6, "{size:?}: {apart:e}");
        }
    }

    /// Networks of another device keep it, and Muon's steps equal the steps on the host.
    #[test]
    fn steps_on_another_device_are_the_hosts() {
        #[allow(deprecated, reason = "the second CPU implementation")]
        let devices = [Device::flex(), Device::ndarray()];
        let config = OptimizerConfig { muon: Some(MuonSettings::default()), ..OptimizerConfig::default() };
        let [host, other] = devices.map(|device| {
            let predictor = random_predictor(&crate::stability::config(&[]).networks(), 1, &device);
            let mut networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
            let mut optimizer = config.init(true);
            for step in 1..3 {
                let gradients = networks.rows().into_iter().map(|(name, values)| (name, values * step));
                let rows = optimizer.step(1.0, &networks, gradients.collect(), 0.5);
                networks = networks.with_rows(&rows);
            }
            assert!(networks.rows().values().all(|values| values.device() == device));
            networks.checkpoint()
        });
        assert!(host == other);
    }
}
