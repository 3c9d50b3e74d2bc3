#![allow(deprecated, reason = "NdArray is the CPU test backend")]

//! The splatting operation as a Burn backend extension. Burn's backend interfaces change with every minor version; only
//! this file, [`flex_ndarray`] and [`gpu`] use them.

mod cpu;
mod flex_ndarray;
#[cfg(feature = "gpu")]
mod gpu;
mod gradient;
mod inputs;
mod job;
mod splat;
mod twofold;

use std::fmt::Debug;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{AutodiffBackend, Backend, ExtensionType, TensorMetadata, backend_extension};
use burn::tensor::{FloatDType, Shape, Slice};

use crate::SplatError;
use inputs::{Inputs, Upstream, Wanted};
pub use job::{Counts, Job};

/// Tensors of one call, all f32: means `[N,3]`, rotations `[N,4]`, scales `[N,3]`, opacities `[N]`, colours `[N,3]`.
#[derive(ExtensionType, Clone, Debug)]
pub struct SplatInputs<B: Backend> {
    pub(crate) means: FloatTensor<B>,
    pub(crate) rotations: FloatTensor<B>,
    pub(crate) scales: FloatTensor<B>,
    pub(crate) opacities: FloatTensor<B>,
    pub(crate) colors: FloatTensor<B>,
}

impl<B: Backend> SplatInputs<B> {
    fn tensors(self) -> Inputs<FloatTensor<B>> {
        let Self { means, rotations, scales, opacities, colors } = self;
        Inputs { means, rotations, scales, opacities, colors }
    }
}

/// Colours `[V,H,W,3]`, alphas `[V,H,W,1]` and depths `[V,H,W,1]`. Without the depth channel, `depth` has the alphas.
/// After an error the tensors are meaningless.
#[derive(ExtensionType)]
pub struct SplatOutput<B: Backend> {
    pub(crate) color: FloatTensor<B>,
    pub(crate) alpha: FloatTensor<B>,
    pub(crate) depth: FloatTensor<B>,
    pub(crate) counts: Result<Counts, SplatError>,
}

/// Channels of colours, alphas and depths in an image `[V,H,W,C]`.
const CHANNELS: [Range<usize>; 3] = [0..3, 3..4, 4..5];

fn channels<B: Backend>(image: FloatTensor<B>, range: Range<usize>) -> FloatTensor<B> {
    let full = Slice::from(..);
    B::float_slice(image, &[full, full, full, Slice::from(range)])
}

/// Backends with the splatting operation. Users call [`render`](crate::render()).
#[cfg_attr(feature = "gpu", backend_extension(Cube, Flex, NdArray, Autodiff))]
#[cfg_attr(not(feature = "gpu"), backend_extension(Flex, Autodiff))]
pub trait SplatBackend: Backend {
    /// Renders `inputs`.
    fn splat(#[extension_type] inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self>;
}

/// Image `[V,H,W,C]`, state if kept, counts.
pub type Forward<B> = Result<(FloatTensor<B>, Option<<B as SplatKernels>::State>, Counts), SplatError>;

/// Operations of a backend without autodiff.
pub trait SplatKernels: Backend {
    /// Values that the backward pass needs beside the inputs.
    type State: Clone + Send + Debug + 'static;

    /// Renders; with `keep` returns the state for the backward pass as well.
    ///
    /// # Errors
    /// [`SplatError::TooManyIntersections`].
    fn forward(inputs: &Inputs<FloatTensor<Self>>, job: &Job, keep: bool) -> Forward<Self>;

    /// Gradients; `None` for unwanted ones.
    fn backward(
        inputs: &Inputs<FloatTensor<Self>>,
        job: &Job,
        state: &Self::State,
        upstream: Upstream<FloatTensor<Self>>,
        wanted: Wanted,
    ) -> Inputs<Option<FloatTensor<Self>>>;
}

/// The untracked operation on a concrete backend.
fn splat_untracked<B: SplatKernels>(inputs: Inputs<FloatTensor<B>>, job: &Job) -> SplatOutput<B> {
    match B::forward(&inputs, job, false) {
        Ok((image, _, counts)) => {
            let [color, alpha, depth] = CHANNELS;
            let depth = if job.options.depth { depth } else { alpha.clone() };
            SplatOutput {
                color: channels::<B>(image.clone(), color),
                alpha: channels::<B>(image.clone(), alpha),
                depth: channels::<B>(image, depth),
                counts: Ok(counts),
            }
        }
        Err(error) => failed(inputs.colors, error),
    }
}

fn failed<B: Backend>(anything: FloatTensor<B>, error: SplatError) -> SplatOutput<B> {
    let [color, alpha, depth] = [anything.clone(), anything.clone(), anything];
    SplatOutput { color, alpha, depth, counts: Err(error) }
}

/// Gradients of the outputs that have been computed, until [`SplatBackward`] reads them.
type Arrived<B> = Arc<Mutex<[Option<FloatTensor<B>>; 3]>>;

#[derive(Debug)]
struct SplatBackward;

/// Inputs, call and kept state, for the backward pass.
#[derive(Debug, Clone)]
struct Kept<B: SplatKernels> {
    inputs: Inputs<FloatTensor<B>>,
    job: Arc<Job>,
    state: Option<B::State>,
    arrived: Arrived<B>,
}

impl<B: SplatKernels> Backward<B, 5> for SplatBackward {
    type State = Kept<B>;

    fn backward(self, ops: Ops<Self::State, 5>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        // The node's own gradient is a token: the gradients of the outputs are in `arrived`.
        drop(grads.consume::<B>(&ops.node));
        let Kept { inputs, job, state, arrived } = ops.state;
        let [color, alpha, depth] = std::mem::take(&mut *lock(&arrived));
        let wanted = Wanted::from_array(ops.parents.each_ref().map(Option::is_some));
        let state = state.expect("kept by the forward pass, which tracks only what succeeded");
        let gradients = B::backward(&inputs, &job, &state, Upstream { color, alpha, depth }, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(gradients.into_array()) {
            if let Some((parent, gradient)) = parent.zip(gradient) {
                grads.register::<B>(parent.id, gradient);
            }
        }
    }
}

/// Passes the gradient of one output to the operation. Burn's own slice would first copy it into an image of zeros.
#[derive(Debug)]
struct ChannelsBackward;

impl<B: SplatKernels> Backward<B, 1> for ChannelsBackward {
    type State = (usize, Arrived<B>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let (output, arrived) = ops.state;
        let token = B::float_zeros(Shape::new([1]), &upstream.device(), FloatDType::F32);
        lock(&arrived)[output] = Some(upstream);
        let [image] = ops.parents;
        grads.register::<B>(image.expect("tracked, or this would not run").id, token);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // No holder leaves the value incomplete.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<B: SplatKernels, C: CheckpointStrategy> SplatBackend for Autodiff<B, C> {
    fn splat(inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self> {
        let inputs = inputs.tensors();
        let nodes = inputs.as_ref().map(|tensor| tensor.node()).into_array();
        let inputs = inputs.map(|tensor| tensor.into_primitive());
        match SplatBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => {
                let (image, state, counts) = match B::forward(&inputs, &job, true) {
                    Ok((image, state, counts)) => (image, state, counts),
                    Err(error) => return failed(Self::from_inner(inputs.colors), error),
                };
                let arrived = Arrived::<B>::default();
                let has_depth = job.options.depth;
                let kept = Kept::<B> { inputs, job, state, arrived: arrived.clone() };
                let whole = prepared.finish(kept, image.clone());
                let part = |output: usize| {
                    let part = channels::<B>(image.clone(), CHANNELS[output].clone());
                    match ChannelsBackward.prepare::<C>([whole.node()]).compute_bound().stateful() {
                        OpsKind::Tracked(prepared) => prepared.finish((output, arrived.clone()), part),
                        OpsKind::UnTracked(prepared) => prepared.finish(part),
                    }
                };
                let (color, alpha) = (part(0), part(1));
                let depth = if has_depth { part(2) } else { alpha.clone() };
                SplatOutput { color, alpha, depth, counts: Ok(counts) }
            }
            OpsKind::UnTracked(_) => {
                let SplatOutput { color, alpha, depth, counts } = splat_untracked::<B>(inputs, &job);
                let [color, alpha, depth] = [color, alpha, depth].map(Self::from_inner);
                SplatOutput { color, alpha, depth, counts }
            }
        }
    }
}
