//! Names, shapes and initial distributions of every tensor of a checkpoint, from the config alone (SNAPSNAP §3.1, §8.2).

use crate::config::{Body, Config, Fusion, HeadKind, NetworkConfig, RegressorConfig, RegressorStart};
use crate::network::LEVELS;
use crate::regressor::{FEATURES, INPUT_CHANNELS};

/// What of a checkpoint a tensor belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Stage 1: the point predictor.
    PointPredictor,
    /// Stage 2: the Gaussian regressor.
    Regressor,
}

/// How a tensor starts when no file gives it (SNAPSNAP §1.1 "init").
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
/// Prefix of the second regressor's keys (`regressor.networks = 2`), which sees the side views.
pub const SIDE: &str = "side.";

/// Every tensor of both parts.
pub fn tensors(config: &Config) -> Vec<TensorSpec> {
    let mut list = List { tensors: Vec::new(), part: Part::PointPredictor };
    list.push(SCALE.into(), &[], Init::Constant(config.network.delta as f32));
    match config.network.body {
        Body::Transformer => point_predictor(&config.network, &mut list),
        Body::Convolution => point_unet(&config.network, &mut list),
    }
    list.part = Part::Regressor;
    regressor(&config.regressor, "", &mut list);
    if config.regressor.networks == 2 {
        regressor(&config.regressor, SIDE, &mut list);
    }
    list.tensors
}

/// Number of parameters of one part.
pub fn parameters(config: &Config, part: Part) -> usize {
    tensors(config).iter().filter(|t| t.part == part).map(TensorSpec::elements).sum()
}

struct List {
    tensors: Vec<TensorSpec>,
    part: Part,
}

impl List {
    fn push(&mut self, name: String, shape: &[usize], init: Init) {
        self.tensors.push(TensorSpec { name, shape: shape.to_vec(), init, part: self.part });
    }

    /// Weight and bias of a normalisation.
    fn norm(&mut self, key: &str, width: usize) {
        self.push(format!("{key}.weight"), &[width], Init::Constant(1.0));
        self.push(format!("{key}.bias"), &[width], Init::Constant(0.0));
    }

    /// Linear layer or patch convolution of the trunk: Xavier-uniform weight, zero bias.
    fn xavier(&mut self, key: &str, shape: &[usize]) {
        let (out, fan_in) = (shape[0], shape[1..].iter().product::<usize>());
        let bound = (6.0 / (fan_in + out) as f32).sqrt();
        self.push(format!("{key}.weight"), shape, Init::Uniform(bound));
        self.push(format!("{key}.bias"), &[out], Init::Constant(0.0));
    }

    /// Layer that keeps PyTorch's default initialisation: ±1/√fan_in for weight and bias.
    fn torch_default(&mut self, key: &str, shape: &[usize], biases: Option<usize>) {
        // For a transposed convolution PyTorch too takes the fan from the second axis.
        let bound = (1.0 / shape[1..].iter().product::<usize>() as f32).sqrt();
        self.push(format!("{key}.weight"), shape, Init::Uniform(bound));
        if let Some(width) = biases {
            self.push(format!("{key}.bias"), &[width], Init::Uniform(bound));
        }
    }

    fn conv(&mut self, key: &str, from: usize, to: usize, kernel: usize) {
        self.torch_default(key, &[to, from, kernel, kernel], Some(to));
    }

    fn mlp(&mut self, key: &str, dim: usize, ratio: usize) {
        self.xavier(&format!("{key}.fc1"), &[ratio * dim, dim]);
        self.xavier(&format!("{key}.fc2"), &[dim, ratio * dim]);
    }

    /// Blocks of self-attention and MLP.
    fn encoder_blocks(&mut self, key: &str, depth: usize, dim: usize, ratio: usize) {
        for n in 0..depth {
            self.norm(&format!("{key}.{n}.norm1"), dim);
            self.self_attention(&format!("{key}.{n}.attn"), dim);
            self.norm(&format!("{key}.{n}.norm2"), dim);
            self.mlp(&format!("{key}.{n}.mlp"), dim, ratio);
        }
    }

    /// A residual unit of two convolutions of each width.
    fn units(&mut self, key: &str, widths: &[usize]) {
        for (level, width) in widths.iter().enumerate() {
            (1..=2).for_each(|n| self.conv(&format!("{key}.{level}.conv{n}"), *width, *width, 3));
        }
    }

    fn self_attention(&mut self, key: &str, dim: usize) {
        self.xavier(&format!("{key}.qkv"), &[3 * dim, dim]);
        self.xavier(&format!("{key}.proj"), &[dim, dim]);
    }
}

/// Layers of the convolutional body.
fn point_unet(c: &NetworkConfig, list: &mut List) {
    let (widths, coarsest) = (c.layer_dims, c.layer_dims[LEVELS - 1]);
    list.conv(&format!("{UNET}conv_in"), 2 * c.input_channels(), widths[0], 3);
    list.units(&format!("{UNET}units"), &widths);
    for level in 1..LEVELS {
        list.conv(&format!("{UNET}down.{}", level - 1), widths[level - 1], widths[level], 3);
    }
    let attention = |list: &mut List, key: &str, [from, dim, depth]: [usize; 3]| {
        let key = format!("{UNET}{key}");
        list.xavier(&format!("{key}.embed"), &[dim, from]);
        list.encoder_blocks(&format!("{key}.blocks"), depth, dim, c.mlp_ratio);
        list.norm(&format!("{key}.norm"), dim);
        list.xavier(&format!("{key}.proj"), &[coarsest, dim]);
    };
    let decoder = |list: &mut List, key: &str| {
        let key = format!("{UNET}{key}");
        list.units(&format!("{key}.units"), &widths);
        for level in 1..LEVELS {
            list.conv(&format!("{key}.up.{}", level - 1), widths[level], widths[level - 1], 1);
        }
        list.conv(&format!("{key}.conv_mid"), widths[0], c.last_dim, 3);
        list.conv(&format!("{key}.conv_out"), c.last_dim, 8, 1);
    };
    attention(list, "attention", [coarsest, c.enc_dim, c.enc_depth]);
    decoder(list, "decoder");
    if c.side_heads {
        attention(list, "side_attention", [c.enc_dim, c.dec_dim, c.dec_depth]);
        decoder(list, "side_decoder");
    }
}

fn point_predictor(c: &NetworkConfig, list: &mut List) {
    list.xavier(&format!("{DUST3R}patch_embed.proj"), &[c.enc_dim, c.input_channels(), c.patch, c.patch]);
    list.encoder_blocks(&format!("{DUST3R}enc_blocks"), c.enc_depth, c.enc_dim, c.mlp_ratio);
    list.norm(&format!("{DUST3R}enc_norm"), c.enc_dim);
    list.xavier(&format!("{DUST3R}decoder_embed"), &[c.dec_dim, c.enc_dim]);
    for stack in ["dec_blocks", "dec_blocks2"] {
        for m in 0..c.dec_depth {
            let key = format!("{DUST3R}{stack}.{m}");
            for norm in ["norm1", "norm2", "norm3", "norm_y"] {
                list.norm(&format!("{key}.{norm}"), c.dec_dim);
            }
            list.self_attention(&format!("{key}.attn"), c.dec_dim);
            for proj in ["projq", "projk", "projv", "proj"] {
                list.xavier(&format!("{key}.cross_attn.{proj}"), &[c.dec_dim, c.dec_dim]);
            }
            list.mlp(&format!("{key}.mlp"), c.dec_dim, c.mlp_ratio);
        }
    }
    list.norm(&format!("{DUST3R}dec_norm"), c.dec_dim);
    for k in 1..=if c.side_heads { 4 } else { 2 } {
        let double = if k > 2 && c.fusion == Fusion::Concat { 2 } else { 1 };
        let key = format!("{DUST3R}downstream_head{k}");
        match c.head {
            HeadKind::Linear => {
                let out = 4 * c.patch * c.patch;
                list.torch_default(&format!("{key}.proj"), &[out, double * c.dec_dim], Some(out));
            }
            HeadKind::Dpt => dpt(c, &format!("{key}.dpt"), c.hook_widths().map(|w| double * w), list),
        }
    }
}

fn dpt(c: &NetworkConfig, key: &str, widths: [usize; 4], list: &mut List) {
    let (d, f) = (c.layer_dims, c.feature_dim);
    for i in 0..4 {
        let key = format!("{key}.act_postprocess.{i}");
        list.conv(&format!("{key}.0"), widths[i], d[i], 1);
        match i {
            0 => list.torch_default(&format!("{key}.1"), &[d[0], d[0], 4, 4], Some(d[0])),
            1 => list.torch_default(&format!("{key}.1"), &[d[1], d[1], 2, 2], Some(d[1])),
            3 => list.conv(&format!("{key}.1"), d[3], d[3], 3),
            _ => {}
        }
    }
    for (i, &width) in d.iter().enumerate() {
        list.torch_default(&format!("{key}.scratch.layer{}_rn", i + 1), &[f, width, 3, 3], None);
    }
    for i in 1..=4 {
        let key = format!("{key}.scratch.refinenet{i}");
        list.conv(&format!("{key}.out_conv"), f, f, 1);
        for unit in ["resConfUnit1", "resConfUnit2"] {
            list.conv(&format!("{key}.{unit}.conv1"), f, f, 3);
            list.conv(&format!("{key}.{unit}.conv2"), f, f, 3);
        }
    }
    list.conv(&format!("{key}.head.0"), f, f / 2, 3);
    list.conv(&format!("{key}.head.2"), f / 2, c.last_dim, 3);
    list.conv(&format!("{key}.head.4"), c.last_dim, 4, 1);
}

fn regressor(c: &RegressorConfig, prefix: &str, list: &mut List) {
    let width = c.channels;
    let unet = format!("{prefix}pred_unet");
    let mut block = |key: String, from: usize| {
        list.norm(&format!("{key}.norm1"), from);
        list.conv(&format!("{key}.conv1"), from, width, 3);
        list.norm(&format!("{key}.norm2"), width);
        list.conv(&format!("{key}.conv2"), width, width, 3);
        if from != width {
            list.conv(&format!("{key}.shortcut"), from, width, 1);
        }
    };
    for i in 0..3 {
        (0..2).for_each(|j| block(format!("{unet}.down_blocks.{i}.nets.{j}"), width));
        (0..3).for_each(|j| block(format!("{unet}.up_blocks.{i}.nets.{j}"), 2 * width));
    }
    (0..2).for_each(|j| block(format!("{unet}.mid_block.nets.{j}"), width));
    for i in 0..2 {
        list.conv(&format!("{unet}.down_blocks.{i}.downsample"), width, width, 3);
        list.conv(&format!("{unet}.up_blocks.{i}.upsample"), width, width, 3);
    }
    list.conv(&format!("{unet}.conv_in"), INPUT_CHANNELS, width, 3);
    list.norm(&format!("{unet}.norm_out"), width);
    list.conv(&format!("{unet}.conv_out"), width, FEATURES, 3);
    list.conv(&format!("{prefix}gs_conv"), FEATURES, FEATURES, 1);
    if c.start() == RegressorStart::Geometric {
        // Nothing is corrected at first.
        list.tensors.iter_mut().rev().take(2).for_each(|spec| spec.init = Init::Constant(0.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts of SNAPSNAP §3.1, §3.3 and §8.2.
    #[test]
    fn the_default_config_has_the_published_number_of_parameters() {
        let mut config = Config::default();
        assert_eq!(parameters(&config, Part::PointPredictor), 611_573_777);
        assert_eq!(parameters(&config, Part::Regressor), 117_966 + 210);
        config.network.side_heads = false;
        // DUSt3R's own count has a mask token of 768 and no δ.
        assert_eq!(parameters(&config, Part::PointPredictor), 571_171_208 - 768 + 1);
        config.network.head = HeadKind::Linear;
        assert_eq!(parameters(&config, Part::PointPredictor), 532_342_784 - 768 + 1);
    }

    #[test]
    fn no_key_is_listed_twice() {
        let mut config = Config::default();
        config.regressor.networks = 2;
        let mut names: Vec<_> = tensors(&config).into_iter().map(|t| t.name).collect();
        let count = names.len();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), count);
    }
}
