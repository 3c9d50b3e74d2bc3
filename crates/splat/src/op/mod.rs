#![allow(deprecated, reason = "NdArray is the CPU test backend")]

//! The splatting operation as a Burn backend extension. Everything that knows Burn's backend interfaces is in this
//! file, [`flex_ndarray`] and [`gpu`]; those interfaces change with every minor version of Burn.

mod cpu;
mod flex_ndarray;
mod gpu;
mod job;

use std::fmt::Debug;
use std::sync::Arc;

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, ExtensionType, backend_extension};

use crate::SplatError;
pub use job::{Counts, Job, MAX_SIDE, Wanted};

/// Tensors of one call, all f32: means `[N,3]`, rotations `[N,4]`, scales `[N,3]`, opacities `[N]`, colours `[N,3]`,
/// background `[3]`.
#[derive(ExtensionType, Clone, Debug)]
pub struct SplatInputs<B: Backend> {
    pub(crate) means: FloatTensor<B>,
    pub(crate) rotations: FloatTensor<B>,
    pub(crate) scales: FloatTensor<B>,
    pub(crate) opacities: FloatTensor<B>,
    pub(crate) colors: FloatTensor<B>,
    pub(crate) background: FloatTensor<B>,
}

/// Image `[V,H,W,C]` with C = red, green, blue, alpha and, if asked for, depth. On an error the image means nothing.
#[derive(ExtensionType)]
pub struct SplatOutput<B: Backend> {
    pub(crate) image: FloatTensor<B>,
    pub(crate) counts: Result<Counts, SplatError>,
}

/// Backends that can splat. Users call [`render`](crate::render()).
#[backend_extension(Cube, Flex, NdArray, Autodiff)]
pub trait SplatBackend: Backend {
    /// Renders `inputs` as `job` says.
    fn splat(#[extension_type] inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self>;
}

/// Image, state if kept, counts.
pub type Forward<B> = Result<(FloatTensor<B>, Option<<B as SplatKernels>::State>, Counts), SplatError>;

/// What a backend without autodiff brings along.
pub trait SplatKernels: Backend {
    /// What the backward pass needs beside the inputs.
    type State: Clone + Send + Debug + 'static;

    /// Image, and the state where `keep`.
    ///
    /// # Errors
    /// [`SplatError::TooManyIntersections`].
    fn forward(inputs: &SplatInputs<Self>, job: &Job, keep: bool) -> Forward<Self>;

    /// Gradients in the order of the fields of [`SplatInputs`], those that are not wanted `None`. `upstream` is
    /// ∂L/∂image.
    fn backward(
        inputs: &SplatInputs<Self>,
        job: &Job,
        state: &Self::State,
        upstream: FloatTensor<Self>,
        wanted: Wanted,
    ) -> [Option<FloatTensor<Self>>; 6];
}

/// The untracked operation on a concrete backend.
fn splat_untracked<B: SplatKernels>(inputs: SplatInputs<B>, job: &Job) -> SplatOutput<B> {
    match B::forward(&inputs, job, false) {
        Ok((image, _, counts)) => SplatOutput { image, counts: Ok(counts) },
        Err(error) => SplatOutput { image: inputs.background, counts: Err(error) },
    }
}

#[derive(Debug)]
struct SplatBackward;

/// Inputs, call and kept state, for the backward pass.
#[derive(Debug, Clone)]
struct Kept<B: SplatKernels> {
    inputs: SplatInputs<B>,
    job: Arc<Job>,
    state: Option<B::State>,
}

impl<B: SplatKernels> Backward<B, 6> for SplatBackward {
    type State = Kept<B>;

    fn backward(self, ops: Ops<Self::State, 6>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let Kept { inputs, job, state } = ops.state;
        let [means, rotations, scales, opacities, colors, background] =
            ops.parents.each_ref().map(Option::is_some);
        let wanted = Wanted { geometry: means || rotations || scales, opacities, colors, background };
        let state = state.expect("kept by the forward pass, which tracks only what succeeded");
        let gradients = B::backward(&inputs, &job, &state, upstream, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(gradients) {
            if let Some((parent, gradient)) = parent.zip(gradient) {
                grads.register::<B>(parent.id, gradient);
            }
        }
    }
}

impl<B: SplatKernels, C: CheckpointStrategy> SplatBackend for Autodiff<B, C> {
    fn splat(inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self> {
        let nodes = [
            inputs.means.node(),
            inputs.rotations.node(),
            inputs.scales.node(),
            inputs.opacities.node(),
            inputs.colors.node(),
            inputs.background.node(),
        ];
        let inputs = SplatInputs {
            means: inputs.means.into_primitive(),
            rotations: inputs.rotations.into_primitive(),
            scales: inputs.scales.into_primitive(),
            opacities: inputs.opacities.into_primitive(),
            colors: inputs.colors.into_primitive(),
            background: inputs.background.into_primitive(),
        };
        match SplatBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => {
                let (image, state, counts) = match B::forward(&inputs, &job, true) {
                    Ok((image, state, counts)) => (image, state, Ok(counts)),
                    Err(error) => (inputs.background.clone(), None, Err(error)),
                };
                let kept = Kept { inputs, job, state };
                SplatOutput { image: prepared.finish(kept, image), counts }
            }
            OpsKind::UnTracked(prepared) => {
                let SplatOutput { image, counts } = splat_untracked(inputs, &job);
                SplatOutput { image: prepared.finish(image), counts }
            }
        }
    }
}
