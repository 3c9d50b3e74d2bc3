//! Operators with their own gradients, as one Burn backend extension. Only this file, `gpu_convolution` and `gather` use
//! Burn's backend interfaces, which change with every minor version of Burn.

use std::any::Any;
use std::fmt::Debug;
use std::sync::{Arc, Mutex, PoisonError};

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{
    AutodiffBackend, Backend, Dispatch, ExtensionType, Flex, TensorMetadata, backend_extension,
};
use burn::tensor::{Shape, Tensor, TensorData};

/// An operator on contiguous f32 values: up to three input tensors, one result.
pub trait Kernel: Debug + Send + Sync + 'static {
    /// The result, and with `keep` the values that the backward pass needs beside inputs. An absent input is one zero.
    fn forward(&self, inputs: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept);

    /// The gradients of the wanted inputs, each as long as its input, from the gradient of the result.
    fn backward(&self, given: Given) -> InputGradients;
}

/// What a backward pass receives.
pub struct Given<'a> {
    /// The inputs of the forward pass.
    pub inputs: [&'a [f32]; 3],
    /// What the forward pass kept.
    pub kept: Kept,
    /// The gradient of the result.
    pub upstream: &'a [f32],
    /// The inputs whose gradients are wanted.
    pub wanted: [bool; 3],
}

/// The gradients of the inputs; `None` for unwanted ones.
pub type InputGradients = [Option<Vec<f32>>; 3];

/// Values that an operator keeps for its backward pass.
pub type Kept = Option<Box<dyn Any + Send>>;

/// The input tensors of a call.
#[derive(ExtensionType, Clone, Debug)]
pub struct Inputs<B: Backend> {
    x: FloatTensor<B>,
    y: FloatTensor<B>,
    z: FloatTensor<B>,
}

/// One tensor of a call: its result, or its only input.
#[derive(ExtensionType, Clone, Debug)]
pub struct One<B: Backend> {
    pub(crate) tensor: FloatTensor<B>,
}

/// Backends that run a [`Kernel`].
#[backend_extension(Flex, Autodiff)]
pub trait KernelBackend: Backend {
    /// Runs `kernel`, whose result has this `shape`.
    fn run(#[extension_type] inputs: Inputs<Self>, kernel: Arc<dyn Kernel>, shape: Shape) -> One<Self>;
}

impl KernelBackend for Flex {
    fn run(inputs: Inputs<Self>, kernel: Arc<dyn Kernel>, shape: Shape) -> One<Self> {
        One { tensor: forward(&inputs, &*kernel, shape, false).0 }
    }
}

/// As [`Kernel::forward`].
fn forward(inputs: &Inputs<Flex>, kernel: &dyn Kernel, shape: Shape, keep: bool) -> (FlexTensor, Kept) {
    let fields = contiguous(inputs);
    let (values, kept) = kernel.forward(fields.each_ref().map(slice), keep);
    (FlexTensor::from_data(TensorData::new(values, shape)), kept)
}

fn contiguous(inputs: &Inputs<Flex>) -> [FlexTensor; 3] {
    [&inputs.x, &inputs.y, &inputs.z].map(FlexTensor::to_contiguous)
}

fn slice(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("contiguous and f32: all tensors here are")
}

#[derive(Debug)]
struct KernelBackward;

/// What the backward pass needs of a call.
#[derive(Debug, Clone)]
struct Call {
    inputs: Inputs<Flex>,
    kernel: Arc<dyn Kernel>,
    kept: Arc<Mutex<Kept>>,
}

impl Backward<Flex, 3> for KernelBackward {
    type State = Call;

    fn backward(self, ops: Ops<Call, 3>, grads: &mut grads::Gradients, _checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<Flex>(&ops.node).to_contiguous();
        let Call { inputs, kernel, kept } = ops.state;
        let (fields, wanted) = (contiguous(&inputs), ops.parents.each_ref().map(Option::is_some));
        let kept = kept.lock().unwrap_or_else(PoisonError::into_inner).take();
        let inputs = fields.each_ref().map(slice);
        let gradients = kernel.backward(Given { inputs, kept, upstream: slice(&upstream), wanted });
        for ((parent, gradient), field) in ops.parents.into_iter().zip(gradients).zip(fields) {
            if let Some((parent, gradient)) = parent.zip(gradient) {
                let gradient = FlexTensor::from_data(TensorData::new(gradient, field.shape()));
                grads.register::<Flex>(parent.id, gradient);
            }
        }
    }
}

impl<C: CheckpointStrategy> KernelBackend for Autodiff<Flex, C> {
    fn run(inputs: Inputs<Self>, kernel: Arc<dyn Kernel>, shape: Shape) -> One<Self> {
        let nodes = [inputs.x.node(), inputs.y.node(), inputs.z.node()];
        let inputs = Inputs {
            x: inputs.x.into_primitive(),
            y: inputs.y.into_primitive(),
            z: inputs.z.into_primitive(),
        };
        let tensor = match KernelBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => {
                let (tensor, kept) = forward(&inputs, &*kernel, shape, true);
                prepared.finish(Call { inputs, kernel, kept: Arc::new(Mutex::new(kept)) }, tensor)
            }
            OpsKind::UnTracked(_) => Self::from_inner(forward(&inputs, &*kernel, shape, false).0),
        };
        One { tensor }
    }
}

/// Runs a kernel, whose result has this `shape`, on tensors of `flex`, tracked or not.
pub fn run<const A: usize, const B: usize, const C: usize, const D: usize>(
    kernel: impl Kernel,
    shape: [usize; D],
    x: Tensor<A>,
    y: Option<Tensor<B>>,
    z: Option<Tensor<C>>,
) -> Tensor<D> {
    let device = x.device();
    let none = || Tensor::<1>::zeros([1], &device).into_dispatch();
    let inputs = Inputs {
        x: x.into_dispatch(),
        y: y.map_or_else(none, Tensor::into_dispatch),
        z: z.map_or_else(none, Tensor::into_dispatch),
    };
    Tensor::from_dispatch(<Dispatch as KernelBackend>::run(inputs, Arc::new(kernel), shape.into()).tensor)
}
