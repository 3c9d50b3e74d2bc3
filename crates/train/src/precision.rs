//! Steps in 16 bits: the point predictor's matrix products and convolutions, and what they keep for the backward pass. The
//! regressor, which reads coordinates, is left alone, as are weights, moments, norms, losses and the rasteriser.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{FloatDType, Tensor};
use serde::{Deserialize, Serialize};

use crate::networks::Networks;

/// What the point predictor computes in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 24 bits of mantissa.
    #[default]
    F32,
    /// 8 bits of mantissa, the range of f32.
    Bf16,
    /// 11 bits of mantissa, up to 65,504: the loss is scaled, so that small gradients do not vanish.
    F16,
}

impl Precision {
    /// As in configs.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
        }
    }

    /// Burn's name.
    pub fn dtype(self) -> FloatDType {
        match self {
            Self::F32 => FloatDType::F32,
            Self::Bf16 => FloatDType::BF16,
            Self::F16 => FloatDType::F16,
        }
    }

    /// The networks with a predictor in this precision; gradients lead back to the one that was given. Norms, δ and the last
    /// layers of the heads stay as they are.
    pub fn lower(self, networks: &Networks) -> Networks {
        let mut networks = networks.clone();
        if self != Self::F32 {
            let mut lower = Lower { dtype: self.dtype(), open: Vec::new() };
            networks.predictor = networks.predictor.map(|predictor| predictor.map(&mut lower));
        }
        networks
    }
}

struct Lower {
    dtype: FloatDType,
    /// Names and kinds of the open modules.
    open: Vec<[String; 2]>,
}

impl Lower {
    /// Whether the open module is a layer of weights, and none that gives what is activated: points of 2 m would be
    /// rounded by a centimetre in bf16.
    fn applies(&self) -> bool {
        // The innermost entry is the parameter's own.
        let [.., [name, _], [_, kind]] = self.open.as_slice() else { return false };
        let is_layer = ["Struct:Linear", "Struct:Conv2d", "Struct:ConvTranspose2d"].contains(&kind.as_str());
        let in_head = self.open.iter().any(|[name, _]| name.starts_with("downstream_head"));
        is_layer && !(in_head && ["at_4", "proj"].contains(&name.as_str()))
    }
}

impl ModuleMapper for Lower {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.open.push([name.to_owned(), container_type.to_owned()]);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.open.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if !self.applies() {
            return param;
        }
        let (id, values, mapper) = param.consume();
        Param::from_mapped_value(id, values.cast(self.dtype), mapper)
    }
}

/// What the loss is multiplied by before it is differentiated, and its gradients are divided by: halved where a gradient
/// is not finite, doubled after long without.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossScale {
    /// A power of two.
    pub factor: f64,
    /// Steps since it was changed.
    pub steps: u64,
}

impl Default for LossScale {
    /// At the beginning of a training.
    fn default() -> Self {
        Self { factor: Self::MOST, steps: 0 }
    }
}

impl LossScale {
    /// Where a training begins, and the most there is: 1 is reached before twenty failed steps in a row end a run.
    const MOST: f64 = 65_536.0;
    /// Steps until a larger one is tried.
    const PATIENCE: u64 = 2000;

    /// Whether a training can have come to this.
    pub fn is_sound(&self) -> bool {
        (1.0..=Self::MOST).contains(&self.factor) && self.steps < Self::PATIENCE
    }

    /// After a step that was made, or was not because of its gradients.
    pub fn update(&mut self, made: bool) {
        self.steps += 1;
        if !made {
            *self = Self { factor: (self.factor / 2.0).max(1.0), steps: 0 };
        } else if self.steps >= Self::PATIENCE {
            *self = Self { factor: (self.factor * 2.0).min(Self::MOST), steps: 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loss_scale_falls_at_once_and_rises_late() {
        let mut scale = LossScale::default();
        scale.update(false);
        assert_eq!(scale, LossScale { factor: 32_768.0, steps: 0 });
        (0..1999).for_each(|_| scale.update(true));
        assert_eq!(scale, LossScale { factor: 32_768.0, steps: 1999 });
        scale.update(true);
        assert_eq!(scale, LossScale { factor: 65_536.0, steps: 0 });
        (0..40).for_each(|_| scale.update(false));
        assert_eq!(scale.factor, 1.0);
    }
}
