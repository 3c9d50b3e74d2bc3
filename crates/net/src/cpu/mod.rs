//! Placeholder until measured.
use burn::tensor::Tensor;
use burn::nn::Linear;
use crate::network::Rope;
use crate::regressor::{Regressor, Statistics};
pub(crate) const UNET_CHANNELS: usize = 16;
pub(crate) fn is_fast<const D: usize>(_x: &Tensor<D>) -> bool { false }
pub(crate) fn rotary_attention(_q: Tensor<3>, _k: Tensor<3>, _v: Tensor<3>, _rq: &Rope, _rk: &Rope, _heads: usize) -> Tensor<3> { unreachable!() }
pub(crate) fn linear_gelu(_l: &Linear, _x: Tensor<3>) -> Tensor<3> { unreachable!() }
pub(crate) fn regress(_r: &Regressor, _x: Tensor<4>, _s: &mut Statistics) -> Tensor<4> { unreachable!() }
