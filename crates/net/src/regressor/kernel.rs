//! The regressor on `flex`: one operator with its own backward pass, whose parameters are one vector.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use burn::module::Param;
use burn::nn::conv::Conv2d;
use burn::tensor::{Tensor, TensorData};
use snapsnap_ops::fused::{GroupStatistics, Needed};
use snapsnap_ops::op::{self, Kept, Kernel};
use snapsnap_ops::regressor::{FEATURES, Network, Saved};

use super::statistics::Statistics;
use super::unet::{GROUPS, UNet};
use crate::parameters::{NamedVisitor, ParameterPath, visit_named};

/// One pass of the network.
#[derive(Debug)]
struct Pass {
    network: Network,
    /// B, H, W.
    size: [usize; 3],
    frozen: Option<Vec<GroupStatistics>>,
    /// Statistics that the forward pass measured.
    measured: Arc<Mutex<Vec<GroupStatistics>>>,
}

impl Kernel for Pass {
    fn shape(&self) -> Vec<usize> {
        self.size.into_iter().chain([FEATURES]).collect()
    }

    fn forward(&self, [input, parameters, _]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let frozen = self.frozen.as_deref();
        let pass = self.network.forward(parameters, input, self.size, frozen, keep);
        *self.measured.lock().unwrap_or_else(PoisonError::into_inner) = pass.statistics;
        (pass.features, pass.saved.map(|saved| Box::new(saved) as _))
    }

    fn backward(
        &self,
        [input, parameters, _]: [&[f32]; 3],
        kept: Kept,
        upstream: &[f32],
        [wants_input, wants_parameters, _]: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let saved = kept.and_then(|kept| kept.downcast::<Saved>().ok()).expect("kept by the forward pass");
        let wanted = Needed { input: wants_input, parameters: wants_parameters };
        let gradients = self.network.backward(parameters, input, *saved, upstream, wanted);
        [wants_input.then_some(gradients.input), wants_parameters.then_some(gradients.parameters), None]
    }
}

/// Input `[B, 6, H, W]` → features `[B, H, W, 14]`: `unet`, then the 1×1 convolution `last`.
pub fn regress(unet: &UNet, last: &Conv2d, input: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
    let ([b, _, h, w], device) = (input.dims(), input.device());
    let (network, parameters) = flat(unet, last);
    let measured = Arc::default();
    let pass =
        Pass { network, size: [b, h, w], frozen: statistics.of_batch(), measured: Arc::clone(&measured) };
    let none: Option<Tensor<1>> = None;
    let features = op::run(pass, input.permute([0, 2, 3, 1]), Some(parameters), none);
    let measured = std::mem::take(&mut *measured.lock().unwrap_or_else(PoisonError::into_inner));
    statistics.record(measured.into_iter().map(|layer| {
        layer.map(|values| {
            let groups = values.len() / b;
            Tensor::from_data(TensorData::new(values, [b, groups]), &device)
        })
    }));
    features
}

/// The network's layout, and all parameters in its order.
fn flat(unet: &UNet, last: &Conv2d) -> (Network, Tensor<1>) {
    #[derive(Default)]
    struct Collect {
        shapes: HashMap<String, Vec<usize>>,
        values: HashMap<String, Tensor<1>>,
    }
    impl NamedVisitor for Collect {
        fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
            let (name, values) = (path.name(), parameter.val());
            self.shapes.insert(name.clone(), values.dims().to_vec());
            self.values.insert(name, values.reshape([-1]));
        }
    }
    let mut collect = Collect::default();
    visit_named(unet, "", &mut collect);
    visit_named(last, "gs_conv.", &mut collect);
    let network = Network::new(GROUPS, &collect.shapes);
    let mut values = |name: &str| collect.values.remove(name).expect("the layout names existing parameters");
    let flat = Tensor::cat(network.tensors().iter().map(|tensor| values(&tensor.name)).collect(), 0);
    (network, flat)
}
