//! Which tensors run on this crate's kernels, and their values and types.

use burn::module::Param;
use burn::tensor::{DType, Device, FloatDType, Tensor};

/// Whether `x` runs on this crate's kernels: f32 on `flex`, with autodiff or without.
pub fn has_kernels<const D: usize>(x: &Tensor<D>) -> bool {
    x.dtype() == DType::F32 && x.device().inner() == Device::flex()
}

/// Whether the device is the CPU, which uses the machine's memory. Without the feature `gpu` there is no other one.
pub fn is_cpu(device: &Device) -> bool {
    #[cfg(feature = "gpu")]
    let is_cpu = device.clone().inner().identity().is_none();
    #[cfg(not(feature = "gpu"))]
    let is_cpu = device.clone().inner() == Device::flex();
    is_cpu
}

/// Whether `x` is on a GPU and has gradients.
pub fn is_tracked_on_gpu<const D: usize>(x: &Tensor<D>) -> bool {
    let device = x.device();
    device.is_autodiff() && !is_cpu(&device)
}

/// `x` in the float type of a layer's weight; on `flex` `x` itself, because kernels round their factors themselves.
pub fn as_weight<const D: usize, const W: usize>(x: Tensor<D>, weight: &Param<Tensor<W>>) -> Tensor<D> {
    if has_kernels(&x) { x } else { x.cast(weight.val().dtype()) }
}

/// Whether a layer's weight is bf16; then the layer's products are in bf16, too.
pub fn is_bf16<const D: usize>(weight: &Param<Tensor<D>>) -> bool {
    weight.val().dtype() == DType::BF16
}

/// Runs `compute` in f32 and casts the result back, if `x` has 16 bits. For norms and rotations.
pub fn in_f32<const D: usize>(x: Tensor<D>, compute: impl FnOnce(Tensor<D>) -> Tensor<D>) -> Tensor<D> {
    let dtype = x.dtype();
    let is_narrow = matches!(dtype, DType::F16 | DType::BF16);
    if is_narrow { compute(x.cast(FloatDType::F32)).cast(dtype) } else { compute(x) }
}

/// The values on the host. There is no copy if the tensor is contiguous and has no other owner.
///
/// # Panics
/// If the values are not f32.
pub fn host<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_into_vec().expect("all tensors here are f32")
}
