//! Burn's two CPU backends on top of [`cpu`].

use std::sync::Arc;

#[cfg(feature = "gpu")]
#[allow(deprecated, reason = "the CPU test backend")]
use burn::backend::NdArray;
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, TensorMetadata};
use burn::tensor::{TensorData, read_sync};

use super::cpu::{self, State};
use super::inputs::{Inputs, Upstream, Wanted};
use super::job::Job;
use super::{Forward, SplatBackend, SplatInputs, SplatKernels, SplatOutput, splat_untracked};

/// Implements the operation for a backend. `$read` makes an owner of a tensor's values, `$slice` borrows the values.
macro_rules! on_the_cpu {
    ($backend:ty, $read:expr, $slice:expr) => {
        #[allow(deprecated, reason = "the CPU test backend")]
        impl SplatBackend for $backend {
            fn splat(inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self> {
                splat_untracked(inputs.tensors(), &job)
            }
        }

        #[allow(deprecated, reason = "the CPU test backend")]
        impl SplatKernels for $backend {
            type State = Arc<State>;

            fn forward(inputs: &Inputs<FloatTensor<Self>>, job: &Job, keep: bool) -> Forward<Self> {
                let values = inputs.as_ref().map($read);
                let (image, state, counts) = cpu::forward(values.as_ref().map($slice), job, keep)?;
                let shape = [job.views.len(), job.height, job.width, job.channels()];
                let image = Self::float_from_data(TensorData::new(image, shape), &Default::default());
                Ok((image, keep.then(|| Arc::new(state)), counts))
            }

            fn backward(
                inputs: &Inputs<FloatTensor<Self>>,
                job: &Job,
                state: &Self::State,
                upstream: Upstream<FloatTensor<Self>>,
                wanted: Wanted,
            ) -> Inputs<Option<FloatTensor<Self>>> {
                let values = inputs.as_ref().map($read);
                let upstream = upstream.as_ref().map($read);
                let (scene, upstream) = (values.as_ref().map($slice), upstream.as_ref().map($slice));
                let gradients = cpu::backward(scene, job, state, &upstream, wanted);
                gradients.with(inputs.as_ref(), |gradient, input| {
                    let data = TensorData::new(gradient?, input.shape());
                    Some(Self::float_from_data(data, &Default::default()))
                })
            }
        }
    };
}

on_the_cpu!(Flex, FlexTensor::to_contiguous, slice);
#[cfg(feature = "gpu")]
on_the_cpu!(NdArray, read::<NdArray>, Vec::as_slice);

fn slice(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("contiguous and f32: `render` casts")
}

fn read<B: Backend>(tensor: &FloatTensor<B>) -> Vec<f32> {
    let data = read_sync(B::float_into_data(tensor.clone())).expect("the CPU can be read");
    data.try_into_vec().expect("f32: `render` casts")
}
