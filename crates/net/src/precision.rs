//! The point predictor in 16 bits: its matrix products and convolutions. The regressor, which reads coordinates, is left alone,
//! as are norms, activations and the rasteriser.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{FloatDType, Tensor};
use serde::{Deserialize, Serialize};

use crate::network::PointPredictor;

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

    /// A predictor in this precision; gradients lead back to the one that was given. Norms, δ and the last layers of the heads
    /// stay as they are.
    pub fn lower(self, predictor: PointPredictor) -> PointPredictor {
        if self == Self::F32 {
            return predictor;
        }
        predictor.map(&mut Lower { dtype: self.dtype(), open: Vec::new() })
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
