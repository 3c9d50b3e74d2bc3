//! The regressor on `flex`: one operator with its own backward pass, whose parameters are one vector.

use std::collections::HashMap;

use burn::module::Param;
use burn::nn::conv::Conv2d;
use burn::tensor::Tensor;
use snapsnap_ops::fused::Needed;
use snapsnap_ops::op::{self, Given, InputGradients, Kept, Kernel};
use snapsnap_ops::regressor::{FEATURES, Network, Saved};

use super::unet::UNet;
use crate::parameters::{NamedVisitor, ParameterPath, visit_named};

/// One pass of the network.
#[derive(Debug)]
struct Pass {
    network: Network,
    /// B, H, W.
    size: [usize; 3],
}

impl Kernel for Pass {
    fn forward(&self, [input, parameters, _]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let (features, saved) = self.network.forward(parameters, input, self.size, keep);
        (features, saved.map(|saved| Box::new(saved) as _))
    }

    fn backward(&self, given: Given) -> InputGradients {
        let Given { inputs: [input, parameters, _], kept, upstream, wanted } = given;
        let saved = kept.and_then(|kept| kept.downcast::<Saved>().ok()).expect("kept by the forward pass");
        let wanted = Needed { input: wanted[0], parameters: wanted[1] };
        let [input, parameters] = self.network.backward(parameters, input, *saved, upstream, wanted);
        [input, parameters, None]
    }
}

/// Input `[B, 6, H, W]` → features `[B, H, W, 14]`: `unet`, then the 1×1 convolution `last`.
pub fn regress(unet: &UNet, last: &Conv2d, input: Tensor<4>) -> Tensor<4> {
    let [b, _, h, w] = input.dims();
    let network = Network::default();
    let parameters = flat(&network, unet, last);
    let none: Option<Tensor<1>> = None;
    let pass = Pass { network, size: [b, h, w] };
    op::run(pass, [b, h, w, FEATURES], input.permute([0, 2, 3, 1]), Some(parameters), none)
}

/// All parameters in the order of the network's layout.
fn flat(network: &Network, unet: &UNet, last: &Conv2d) -> Tensor<1> {
    struct Collect(HashMap<String, Tensor<1>>);
    impl NamedVisitor for Collect {
        fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
            self.0.insert(path.name(), parameter.val().reshape([-1]));
        }
    }
    let mut collect = Collect(HashMap::new());
    visit_named(unet, "", &mut collect);
    visit_named(last, "gs_conv.", &mut collect);
    let values = |name: &String| collect.0.remove(name).expect("the layout names existing parameters");
    Tensor::cat(network.names().iter().map(values).collect(), 0)
}
