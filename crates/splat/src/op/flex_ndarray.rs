//! Burn's two CPU backends on top of [`cpu`].

use std::sync::Arc;

#[allow(deprecated, reason = "the CPU test backend")]
use burn::backend::NdArray;
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex};
use burn::tensor::{TensorData, read_sync};

use super::cpu::{self, Scene, State};
use super::job::{Job, Wanted};
use super::{Forward, SplatBackend, SplatInputs, SplatKernels, SplatOutput, Upstream, splat_untracked};

/// Implements the operation for a backend. `$read` makes an owner of a tensor's values, `$slice` borrows the values.
macro_rules! on_the_cpu {
    ($backend:ty, $read:expr, $slice:expr) => {
        #[allow(deprecated, reason = "the CPU test backend")]
        impl SplatBackend for $backend {
            fn splat(inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self> {
                splat_untracked(inputs, &job)
            }
        }

        #[allow(deprecated, reason = "the CPU test backend")]
        impl SplatKernels for $backend {
            type State = Arc<State>;

            fn forward(inputs: &SplatInputs<Self>, job: &Job, keep: bool) -> Forward<Self> {
                let fields = fields(inputs).map($read);
                let (image, state, counts) = cpu::forward(scene(fields.each_ref().map($slice)), job, keep)?;
                let image = Self::float_from_data(image_data(image, job), &Default::default());
                Ok((image, keep.then(|| Arc::new(state)), counts))
            }

            fn backward(
                inputs: &SplatInputs<Self>,
                job: &Job,
                state: &Self::State,
                upstream: Upstream<FloatTensor<Self>>,
                wanted: Wanted,
            ) -> [Option<FloatTensor<Self>>; 6] {
                let fields = fields(inputs).map($read);
                let scene = scene(fields.each_ref().map($slice));
                let upstream = upstream.as_ref().map($read);
                let gradients = cpu::backward(scene, job, state, &upstream.as_ref().map($slice), wanted);
                gradient_data(gradients, scene.opacities.len())
                    .map(|data| data.map(|data| Self::float_from_data(data, &Default::default())))
            }
        }
    };
}

on_the_cpu!(Flex, FlexTensor::to_contiguous, slice);
on_the_cpu!(NdArray, read::<NdArray>, Vec::as_slice);

fn fields<B: Backend>(inputs: &SplatInputs<B>) -> [&FloatTensor<B>; 6] {
    let SplatInputs { means, rotations, scales, opacities, colors, background } = inputs;
    [means, rotations, scales, opacities, colors, background]
}

fn scene([means, rotations, scales, opacities, colors, background]: [&[f32]; 6]) -> Scene<'_> {
    Scene { means, rotations, scales, opacities, colors, background }
}

fn slice(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("contiguous and f32: `render` casts")
}

fn read<B: Backend>(tensor: &FloatTensor<B>) -> Vec<f32> {
    let data = read_sync(B::float_into_data(tensor.clone())).expect("the CPU can be read");
    data.try_into_vec().expect("f32: `render` casts")
}

fn image_data(image: Vec<f32>, job: &Job) -> TensorData {
    TensorData::new(image, [job.views.len(), job.height, job.width, job.channels()])
}

/// In the order of the fields of [`SplatInputs`].
fn gradient_data(gradients: cpu::Gradients, n: usize) -> [Option<TensorData>; 6] {
    let rows = |values: Vec<f32>, columns| {
        // Empty if the gradient is unwanted, or if there are no Gaussians.
        (!values.is_empty() || n == 0).then(|| TensorData::new(values, [n, columns]))
    };
    let flat = |values: Vec<f32>| {
        let len = values.len();
        (len > 0 || n == 0).then(|| TensorData::new(values, [len]))
    };
    let cpu::Gradients { means, rotations, scales, opacities, colors, background } = gradients;
    let background = (!background.is_empty()).then(|| TensorData::new(background, [3]));
    [rows(means, 3), rows(rotations, 4), rows(scales, 3), flat(opacities), rows(colors, 3), background]
}
