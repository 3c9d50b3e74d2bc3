//! Optimisers: AdamW as published, and Muon for hidden matrices and kernels with AdamW for the rest (LEARNING.md).

use std::collections::BTreeMap;

use burn::optim::decay::WeightDecayConfig;
use burn::optim::momentum::MomentumConfig;
use burn::optim::{
    AdjustLrFn, Muon, MuonConfig, MuonState, Optimizer as _, RecordState, StateSink, StateSource,
};
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use snapsnap_net::weights::NamedMapper;

use crate::networks::{Networks, Rows, host, row};

/// Values per task of a step on the CPU.
const PIECE: usize = 1 << 14;

/// The section `[optimizer]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Highest learning rate of AdamW.
    pub rate: f64,
    /// Decay of the gradients' mean.
    pub beta1: f64,
    /// Decay of their squares' mean.
    pub beta2: f64,
    /// Added to the root of the squares' mean.
    pub epsilon: f64,
    /// Share of a weight that a step at rate 1 would take away.
    pub weight_decay: f64,
    /// Whether norms, biases and δ decay as well, as in the published code.
    pub decay_all: bool,
    /// Muon for hidden matrices and kernels.
    pub muon: Option<MuonSettings>,
}

/// The section `[optimizer.muon]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MuonSettings {
    /// Highest learning rate; updates are scaled to the size of AdamW's.
    pub rate: f64,
    /// Share of the past in the direction of a step.
    pub momentum: f64,
    /// As AdamW's.
    pub weight_decay: f32,
}

impl Default for OptimizerConfig {
    /// The published one.
    fn default() -> Self {
        Self {
            rate: 1e-4,
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-8,
            weight_decay: 0.05,
            decay_all: true,
            muon: None,
        }
    }
}

impl Default for MuonSettings {
    fn default() -> Self {
        Self { rate: 1e-3, momentum: 0.95, weight_decay: 0.02 }
    }
}

impl OptimizerConfig {
    /// The first key that makes no sense, and why.
    pub fn problem(&self) -> Option<(&'static str, String)> {
        let muon = self.muon.clone().unwrap_or_default();
        let shares = [
            ("rate", self.rate, 10.0),
            ("beta1", self.beta1, 1.0),
            ("beta2", self.beta2, 1.0),
            ("epsilon", self.epsilon, 1.0),
            ("weight_decay", self.weight_decay, 10.0),
            ("muon.rate", muon.rate, 10.0),
            ("muon.momentum", muon.momentum, 1.0),
            ("muon.weight_decay", f64::from(muon.weight_decay), 10.0),
        ];
        let (key, value, limit) =
            shares.into_iter().find(|(_, value, limit)| !(0.0..*limit).contains(value))?;
        Some((key, format!("is {value}, must be at least 0 and less than {limit}")))
    }

    /// An optimiser that has made no step yet.
    pub fn init(&self) -> Optimizer {
        let muon = self.muon.as_ref().map(|muon| {
            let momentum = MomentumConfig { momentum: muon.momentum, dampening: 0.0, nesterov: true };
            MuonConfig::new()
                .with_momentum(momentum)
                .with_weight_decay(Some(WeightDecayConfig::new(muon.weight_decay)))
                .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
                .build()
        });
        Optimizer { config: self.clone(), muon, states: BTreeMap::new() }
    }
}

/// What an optimiser remembers of a parameter.
#[derive(Clone)]
enum State {
    AdamW { time: u64, mean: Tensor<1>, squares: Tensor<1> },
    Muon(MuonState<2>),
}

/// An optimiser in the middle of a training.
pub struct Optimizer {
    config: OptimizerConfig,
    muon: Option<Muon>,
    states: BTreeMap<String, State>,
}

/// Whether a parameter is a matrix or a kernel between the first layer and the last ones.
fn is_hidden(name: &str, rank: usize) -> bool {
    /// Parts of the names of first and last layers.
    const OUTER: [&str; 5] = ["patch_embed.", ".dpt.head.4.", "conv_in.", "conv_out.", "gs_conv."];
    // `downstream_headK.proj.weight` is the only layer of a linear head.
    let is_linear_head =
        name.contains("downstream_head") && name.ends_with("proj.weight") && !name.contains(".dpt.");
    rank >= 2 && !OUTER.iter().any(|part| name.contains(part)) && !is_linear_head
}

impl Optimizer {
    /// One step of all parameters that have a gradient, each multiplied by `factor` first, at `share` of the highest
    /// rates.
    pub fn step(&mut self, share: f64, networks: Networks, gradients: Rows, factor: f64) -> Networks {
        struct Step<'a> {
            optimizer: &'a mut Optimizer,
            share: f64,
            factor: f64,
            gradients: Rows,
        }
        impl NamedMapper for Step<'_> {
            fn map<const D: usize>(&mut self, name: &str, values: Tensor<D>) -> Tensor<D> {
                match self.gradients.remove(name) {
                    Some(gradient) => {
                        self.optimizer.step_one(self.share, name, values, gradient, self.factor)
                    }
                    None => values,
                }
            }
        }
        networks.map(&mut Step { optimizer: self, share, factor, gradients })
    }

    fn step_one<const D: usize>(
        &mut self,
        share: f64,
        name: &str,
        values: Tensor<D>,
        gradient: Tensor<1>,
        factor: f64,
    ) -> Tensor<D> {
        let (shape, state) = (values.shape(), self.states.remove(name));
        let (values, state) = match (&self.muon, &self.config.muon) {
            (Some(muon), Some(settings)) if is_hidden(name, D) => {
                // Kernels `[out, in, k, k]` are taken for matrices `[out, in·k·k]`.
                let size = [shape[0], shape.num_elements() / shape[0]];
                let state = match state {
                    Some(State::Muon(state)) => Some(state),
                    _ => None,
                };
                let gradient = if factor == 1.0 { gradient } else { gradient * factor };
                let (values, state) =
                    muon.step(share * settings.rate, values.reshape(size), gradient.reshape(size), state);
                (values.reshape([-1]), State::Muon(state.expect("Muon has a state after a step")))
            }
            _ => {
                let decays = D >= 2 || self.config.decay_all;
                self.adamw(share, decays, values.reshape([-1]), gradient, factor, state)
            }
        };
        self.states.insert(name.to_owned(), state);
        values.reshape(shape)
    }

    /// AdamW (Loshchilov and Hutter). Burn's corrects the moments' bias in f32, which makes the second step 1.5e-5 too long
    /// or too short; the published steps cannot be followed with it.
    fn adamw(
        &self,
        share: f64,
        decays: bool,
        values: Tensor<1>,
        gradient: Tensor<1>,
        factor: f64,
        state: Option<State>,
    ) -> (Tensor<1>, State) {
        let OptimizerConfig { beta1, beta2, epsilon, .. } = self.config;
        let device = values.device();
        let (time, mean, squares) = match state {
            Some(State::AdamW { time, mean, squares }) => {
                (time + 1, mean.to_device(&device), squares.to_device(&device))
            }
            _ => (1, gradient.zeros_like(), gradient.zeros_like()),
        };
        let rate = share * self.config.rate;
        let kept = 1.0 - if decays { rate * self.config.weight_decay } else { 0.0 };
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

    /// What a checkpoint needs: rows `KIND/NAME`, and AdamW's steps so far by name.
    pub fn record(&self) -> (BTreeMap<String, Vec<f32>>, BTreeMap<String, u64>) {
        let (mut rows, mut times) = (BTreeMap::new(), BTreeMap::new());
        for (name, state) in &self.states {
            match state {
                State::AdamW { time, mean, squares } => {
                    times.insert(name.clone(), *time);
                    rows.insert(format!("mean/{name}"), host(mean.clone()));
                    rows.insert(format!("squares/{name}"), host(squares.clone()));
                }
                State::Muon(state) => {
                    let mut sink = StateSink::default();
                    state.state_flatten(&format!("muon/{name}"), &mut sink);
                    let tensors = sink.tensors.into_iter();
                    rows.extend(tensors.map(|(path, values)| {
                        (path, values.try_into_vec().expect("all tensors here are f32"))
                    }));
                }
            }
        }
        (rows, times)
    }

    /// Goes on from a checkpoint's record; what belongs to no parameter is left out.
    pub fn restore(
        &mut self,
        networks: &Networks,
        rows: &mut BTreeMap<String, Vec<f32>>,
        times: &BTreeMap<String, u64>,
        device: &Device,
    ) {
        for (name, shape) in networks.shapes() {
            let prefix = format!("muon/{name}");
            // Muon keeps one tensor, under a name of Burn's.
            let path = rows.range(format!("{prefix}.")..).next().map(|(path, _)| path.clone());
            if let Some(path) = path.filter(|path| path.starts_with(&format!("{prefix}."))) {
                let velocity = rows.remove(&path).expect("just found");
                let size = [shape[0], velocity.len() / shape[0]];
                let mut source = StateSource::default();
                source.insert_tensor(path, TensorData::new(velocity, size));
                if let Some(state) = MuonState::state_unflatten(&prefix, &mut source, device) {
                    self.states.insert(name, State::Muon(state));
                }
                continue;
            }
            let mut take = |kind: &str| rows.remove(&format!("{kind}/{name}"));
            if let (Some(mean), Some(squares), Some(time)) = (take("mean"), take("squares"), times.get(&name))
            {
                let [mean, squares] = [mean, squares].map(|values| row(values, device));
                self.states.insert(name, State::AdamW { time: *time, mean, squares });
            }
        }
    }
}
