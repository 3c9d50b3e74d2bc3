//! Optimisers: AdamW as published, and Muon for hidden matrices and kernels with AdamW for the rest (LEARNING.md).

use burn::module::{Module, Param, ParamGroup, ParamId};
use burn::optim::decay::WeightDecayConfig;
use burn::optim::momentum::MomentumConfig;
use burn::optim::{
    AdjustLrFn, LearningRate, ModuleOptimizer, Muon, MuonConfig, MuonState, Optimizer, RecordState,
    StateSink, StateSource,
};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use snapsnap_net::weights::{NamedVisitor, visit_named};

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
    /// An optimiser for `module`, to be stepped with the schedule's share of the highest rate.
    pub fn init<M: Module>(&self, module: &M) -> ModuleOptimizer {
        let adamw = |weight_decay: f64| {
            let Self { rate, beta1, beta2, epsilon, .. } = *self;
            AdamW { rate, beta1, beta2, epsilon, weight_decay }
        };
        let mut parameters = Parameters::default();
        visit_named(module, "", &mut parameters);
        let mut optimizer = ModuleOptimizer::from(adamw(self.weight_decay));
        if !self.decay_all {
            optimizer = optimizer.with_group(ParamGroup::from_ids(parameters.vectors), adamw(0.0), None);
        }
        if let Some(muon) = &self.muon {
            let momentum = MomentumConfig { momentum: muon.momentum, dampening: 0.0, nesterov: true };
            let inner = MuonConfig::new()
                .with_momentum(momentum)
                .with_weight_decay(Some(WeightDecayConfig::new(muon.weight_decay)))
                .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
                .build();
            let group = ParamGroup::from_ids(parameters.hidden);
            optimizer = optimizer.with_group(group, RatedMuon { inner, rate: muon.rate }, None);
        }
        optimizer
    }
}

/// Which parameters are what.
#[derive(Default)]
struct Parameters {
    /// Norms, biases and δ.
    vectors: Vec<ParamId>,
    /// Matrices and kernels between the first layer and the last ones.
    hidden: Vec<ParamId>,
}

impl NamedVisitor for Parameters {
    fn visit<const D: usize>(&mut self, name: &str, _: bool, parameter: &Param<Tensor<D>>) {
        /// Parts of the names of first and last layers.
        const OUTER: [&str; 5] = ["patch_embed.", ".dpt.head.4.", "conv_in.", "conv_out.", "gs_conv."];
        if D < 2 {
            self.vectors.push(parameter.id);
        } else if !OUTER.iter().any(|part| name.contains(part)) && !is_linear_head(name) {
            self.hidden.push(parameter.id);
        }
    }
}

/// `downstream_headK.proj.weight`: the only layer of a linear head.
fn is_linear_head(name: &str) -> bool {
    name.contains("downstream_head") && name.ends_with("proj.weight") && !name.contains(".dpt.")
}

/// AdamW (Loshchilov and Hutter) whose rate is the schedule's share times its own. Burn's corrects the moments' bias in
/// f32, which makes the second step 1.5e-5 too long or too short; the published steps cannot be followed with it.
#[derive(Clone)]
struct AdamW {
    rate: f64,
    beta1: f64,
    beta2: f64,
    epsilon: f64,
    weight_decay: f64,
}

/// Steps so far, mean of the gradients and of their squares.
#[derive(Clone)]
struct AdamWState<const D: usize> {
    time: usize,
    mean: Tensor<D>,
    squares: Tensor<D>,
}

impl<const D: usize> RecordState for AdamWState<D> {
    fn state_flatten(&self, prefix: &str, out: &mut StateSink) {
        out.push_tensor(prefix, "time", TensorData::from([self.time as i64]));
        out.push_tensor(prefix, "mean", self.mean.to_data());
        out.push_tensor(prefix, "squares", self.squares.to_data());
    }

    fn state_unflatten(prefix: &str, src: &mut StateSource, device: &Device) -> Option<Self> {
        let time = src.take_tensor(prefix, "time")?.try_into_vec::<i64>().ok()?;
        let mut tensor = |leaf| Some(Tensor::from_data(src.take_tensor(prefix, leaf)?, device));
        Some(Self { time: *time.first()? as usize, mean: tensor("mean")?, squares: tensor("squares")? })
    }
}

impl Optimizer for AdamW {
    type State<const D: usize> = AdamWState<D>;

    fn step<const D: usize>(
        &self,
        share: LearningRate,
        tensor: Tensor<D>,
        gradient: Tensor<D>,
        state: Option<Self::State<D>>,
    ) -> (Tensor<D>, Option<Self::State<D>>) {
        let rate = share * self.rate;
        let new = gradient.clone() * (1.0 - self.beta1);
        let new_squares = gradient.square() * (1.0 - self.beta2);
        let (time, mean, squares) = match state {
            Some(AdamWState { time, mean, squares }) => {
                (time + 1, mean * self.beta1 + new, squares * self.beta2 + new_squares)
            }
            None => (1, new, new_squares),
        };
        let correction = |beta: f64| 1.0 - beta.powf(time as f64);
        let length = squares.clone().sqrt() * correction(self.beta2).sqrt().recip() + self.epsilon;
        let update = mean.clone() * (rate / correction(self.beta1)) / length;
        (tensor * (1.0 - rate * self.weight_decay) - update, Some(AdamWState { time, mean, squares }))
    }

    fn to_device<const D: usize>(state: Self::State<D>, device: &Device) -> Self::State<D> {
        let AdamWState { time, mean, squares } = state;
        AdamWState { time, mean: mean.to_device(device), squares: squares.to_device(device) }
    }
}

/// Muon likewise; kernels `[out, in, k, k]` are taken for matrices `[out, in·k·k]`.
#[derive(Clone)]
struct RatedMuon {
    inner: Muon,
    rate: f64,
}

impl Optimizer for RatedMuon {
    type State<const D: usize> = MuonState<2>;

    fn step<const D: usize>(
        &self,
        share: LearningRate,
        tensor: Tensor<D>,
        gradient: Tensor<D>,
        state: Option<Self::State<D>>,
    ) -> (Tensor<D>, Option<Self::State<D>>) {
        let shape = tensor.shape();
        let matrix = |x: Tensor<D>| {
            let columns = x.shape().num_elements() / shape[0];
            x.reshape([shape[0], columns])
        };
        let (tensor, state) = self.inner.step(share * self.rate, matrix(tensor), matrix(gradient), state);
        (tensor.reshape(shape.clone()), state)
    }

    fn to_device<const D: usize>(state: Self::State<D>, device: &Device) -> Self::State<D> {
        Muon::to_device(state, device)
    }
}
