//! The point predictor in 16 bits: its matrix products and convolutions. Norms, activations, the rasteriser and the
//! regressor, whose input is coordinates, stay in f32.
//!
//! On a GPU the layers' tensors are of 16 bits. On the CPU they are f32, and kernels round the factors of products
//! ([`snapsnap_ops::bf16`]).

use burn::module::Param;
use burn::tensor::{Device, FloatDType, Tensor};

use crate::config::Config;
pub use crate::config::Precision;
use crate::network::PointPredictor;
use crate::parameters::{NamedMapper, ParameterPath, map_named};

impl Precision {
    /// The precision of a reconstruction for which none is asked: the training's on a CPU with instructions for bf16,
    /// f32 elsewhere.
    pub fn of_weights(config: &Config, device: &Device) -> Self {
        let is_fast = *device == Device::flex() && snapsnap_ops::bf16::is_there();
        if is_fast { config.network.precision } else { Self::F32 }
    }

    /// The predictor in this precision. Norms, δ and the last layers of the heads stay in f32. Gradients reach the
    /// given predictor.
    pub fn lower(self, predictor: PointPredictor) -> PointPredictor {
        if self == Self::F32 {
            return predictor;
        }
        map_named(predictor, "", &mut Lower(self.dtype()))
    }
}

/// Layers that output raw points stay in f32: bf16 rounds points at 2 m by a centimetre.
struct Lower(FloatDType);

impl NamedMapper for Lower {
    fn map<const D: usize>(&mut self, path: &ParameterPath, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = path.name();
        let layer = name.rsplit_once('.').map_or("", |(layer, _)| layer);
        let is_layer =
            ["Struct:Linear", "Struct:Conv2d", "Struct:ConvTranspose2d"].contains(&path.container());
        if !is_layer || PointPredictor::is_last_layer(layer) {
            return param;
        }
        let (id, values, mapper) = param.consume();
        Param::from_mapped_value(id, values.cast(self.0), mapper)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::config::{Body, Config, DetailsConfig, HeadKind};
    use crate::weights::{NamedVisitor, random_predictor, visit_named};

    /// Names of the weights of layers that stay in f32.
    fn in_f32(config: &Config) -> Vec<String> {
        struct Collect(Vec<String>);
        impl NamedVisitor for Collect {
            fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
                if D > 1 && parameter.val().dtype() == DType::F32 {
                    self.0.push(path.name());
                }
            }
        }
        let mut names = Collect(Vec::new());
        let predictor = Precision::Bf16.lower(random_predictor(config, 1, &Device::flex()));
        visit_named(&predictor, "", &mut names);
        names.0
    }

    #[test]
    fn the_last_layers_of_every_body_and_head_stay_in_f32() {
        let mut config = Config::default();
        let n = &mut config.network;
        (n.enc_dim, n.enc_depth, n.dec_dim, n.dec_depth) = (64, 1, 48, 1);
        (n.enc_heads, n.dec_heads, n.hooks) = (4, 4, [0, 1, 1, 1]);
        (n.layer_dims, n.feature_dim, n.last_dim) = ([8, 8, 8, 8], 8, 8);
        let of_heads = |tail: &str| -> Vec<String> {
            (1..=4).map(|k| format!("dust3r.downstream_head{k}.{tail}.weight")).collect()
        };
        assert_eq!(in_f32(&config), of_heads("dpt.head.4"));
        config.network.head = HeadKind::Linear;
        config.network.details = Some(DetailsConfig::default());
        let details = ["details.decoder.conv_out.weight".to_owned()];
        assert_eq!(in_f32(&config), [of_heads("proj"), details.to_vec()].concat());
        (config.network.body, config.network.patch) = (Body::Convolution, 8);
        let last = ["unet.decoder.conv_out", "unet.side_decoder.conv_out", "details.decoder.conv_out"];
        assert_eq!(in_f32(&config), last.map(|name| format!("{name}.weight")));
    }
}
