//! Name, shape and initial distribution of every tensor of a checkpoint, read from the networks' own modules
//! (docs/method.md, "Weight files").

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};

use crate::config::{Config, RegressorStart, Schema};
use crate::network::PointPredictor;
use crate::parameters::{NamedVisitor, ParameterPath, visit_named};
use crate::regressor::Regressor;

/// The part of a checkpoint that a tensor belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Part {
    /// Stage 1: the point predictor.
    PointPredictor,
    /// Stage 2: the Gaussian regressor.
    Regressor,
}

/// Distribution of a tensor that no file gives (docs/method.md, "Weight files").
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Every entry the same.
    Constant(f32),
    /// Uniform in ±bound.
    Uniform(f32),
}

/// One tensor of a checkpoint.
#[derive(Debug, Clone, PartialEq)]
pub struct TensorSpec {
    /// The authors' key.
    pub name: String,
    /// Extents in PyTorch's order, outermost first.
    pub shape: Vec<usize>,
    /// Initial distribution.
    pub init: Init,
    /// Part it belongs to.
    pub part: Part,
}

impl TensorSpec {
    /// Number of entries.
    pub fn elements(&self) -> usize {
        self.shape.iter().product()
    }
}

/// Key of δ.
pub const SCALE: &str = "scale";
/// Prefix of the two-view network's keys.
pub const DUST3R: &str = "dust3r.";
/// Prefix of the convolutional network's keys.
pub const UNET: &str = "unet.";
/// Prefix of the keys of the network of details.
pub const DETAILS: &str = "details.";
/// Prefix of the second regressor's keys (`regressor.networks = 2`), which receives the side views.
pub const SIDE: &str = "side.";

/// Every tensor of both parts.
pub fn tensors(config: &Config) -> Vec<TensorSpec> {
    let device = Device::flex();
    // The parameters of new modules have shapes but no memory yet.
    let mut tensors = list(&PointPredictor::new(&config.network, &device), "", Part::PointPredictor);
    for prefix in &["", SIDE][..config.regressor.networks] {
        tensors.extend(list(&Regressor::new(&device), prefix, Part::Regressor));
    }
    for spec in &mut tensors {
        if spec.name == SCALE {
            // A scalar in files.
            (spec.shape, spec.init) = (Vec::new(), Init::Constant(config.network.delta as f32));
        }
        // With a geometric start, an untrained network corrects nothing.
        if config.regressor.start() == RegressorStart::Geometric && spec.name.contains("gs_conv.") {
            spec.init = Init::Constant(0.0);
        }
    }
    tensors
}

// Here, since the networks know the config, and not the other way round.
impl Schema for Config {
    fn refusal(&self) -> Option<(String, String)> {
        self.refused(|| tensors(self).iter().map(TensorSpec::elements).sum())
    }
}

fn list<M: Module>(module: &M, prefix: &str, part: Part) -> Vec<TensorSpec> {
    let mut list = List { tensors: Vec::new(), part, bound: 0.0 };
    visit_named(module, prefix, &mut list);
    list.tensors
}

struct List {
    tensors: Vec<TensorSpec>,
    part: Part,
    /// PyTorch's default bound of the layer whose weight was visited last.
    bound: f32,
}

impl NamedVisitor for List {
    fn visit<const D: usize>(&mut self, path: &ParameterPath, param: &Param<Tensor<D>>) {
        let (name, mut shape) = (path.name(), param.lazy_shape().to_vec());
        if path.is_transposed() {
            shape.reverse();
        }
        let is_weight = name.ends_with("weight");
        if is_weight && shape.len() > 1 {
            // For a transposed convolution PyTorch too takes the fan from the second axis.
            self.bound = (1.0 / shape[1..].iter().product::<usize>() as f32).sqrt();
        }
        // The trunk starts Xavier-uniform with zero biases; convolutions and heads keep PyTorch's default.
        let is_linear = path.container() == "Struct:Linear" && !name.contains("downstream_head");
        let init = if path.container().ends_with("Norm") {
            Init::Constant(if is_weight { 1.0 } else { 0.0 })
        } else if is_linear || name.contains("patch_embed.") {
            let fans: usize = shape.iter().take(1).sum::<usize>() + shape.iter().skip(1).product::<usize>();
            if is_weight { Init::Uniform((6.0 / fans as f32).sqrt()) } else { Init::Constant(0.0) }
        } else {
            Init::Uniform(self.bound)
        };
        self.tensors.push(TensorSpec { name, shape, init, part: self.part });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_start_as_the_published_code_starts_them() {
        let tensors = tensors(&Config::default());
        let init = |name: &str| tensors.iter().find(|t| t.name == name).expect("a tensor").init;
        let xavier = |fans: f32| Init::Uniform((6.0 / fans).sqrt());
        assert_eq!(init("dust3r.patch_embed.proj.weight"), xavier(768.0 + 1024.0));
        assert_eq!(init("dust3r.enc_blocks.3.attn.qkv.weight"), xavier(1024.0 + 3072.0));
        assert_eq!(init("dust3r.enc_blocks.3.attn.qkv.bias"), Init::Constant(0.0));
        assert_eq!(init("dust3r.enc_norm.weight"), Init::Constant(1.0));
        // 4×4 places of 96 channels.
        let bound = Init::Uniform((1.0 / 1536.0_f32).sqrt());
        assert_eq!(init("dust3r.downstream_head1.dpt.act_postprocess.0.1.bias"), bound);
        assert_eq!(init("pred_unet.conv_in.bias"), Init::Uniform((1.0 / 54.0_f32).sqrt()));
        assert_eq!(init("pred_unet.norm_out.bias"), Init::Constant(0.0));
        assert_eq!(init("scale"), Init::Constant(5.0));
    }
}
