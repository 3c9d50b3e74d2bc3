//! The two-view transformer: shared encoder, twin cross-attention decoders, two or four heads
//! (docs/method.md, "Transformer blocks").
//!
//! Field names are the checkpoint's.

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{LayerNorm, Linear, LinearConfig, PaddingConfig2d};
use burn::tensor::{Device, Tensor};

use super::block::{DecoderBlock, EncoderBlock, layer_norm, normalise};
use super::dpt::DptHead;
use super::linear::LinearHead;
use super::rope;
use super::view::View;
use crate::config::{Fusion, HeadKind, NetworkConfig};
use snapsnap_ops::as_weight;
use snapsnap_ops::layers::{linear, patches};

#[derive(Module, Debug)]
struct PatchEmbed {
    proj: Conv2d,
}

#[derive(Module, Debug)]
#[allow(clippy::large_enum_variant, reason = "at most four of them exist")]
enum Head {
    Dpt(DptHead),
    Linear(LinearHead),
}

/// Token maps `[B, N, C]` of one photograph: entry 0 is the encoder's output, entry l the output of layer l.
pub type TokenMaps = Vec<Tensor<3>>;

/// The network of DUSt3R with two or four heads.
#[derive(Module, Debug)]
pub struct Dust3r {
    patch_embed: PatchEmbed,
    enc_blocks: Vec<EncoderBlock>,
    enc_norm: LayerNorm,
    decoder_embed: Linear,
    dec_blocks: Vec<DecoderBlock>,
    dec_blocks2: Vec<DecoderBlock>,
    dec_norm: LayerNorm,
    downstream_head1: Head,
    downstream_head2: Head,
    downstream_head3: Option<Head>,
    downstream_head4: Option<Head>,
    #[module(skip)]
    config: NetworkConfig,
}

impl Dust3r {
    pub(crate) fn new(config: &NetworkConfig, device: &Device) -> Self {
        let c = config;
        let patch = [c.patch, c.patch];
        let encoder = |_| EncoderBlock::new(c.enc_dim, c.enc_heads, device);
        let decoder = |_| DecoderBlock::new(c.dec_dim, c.dec_heads, device);
        let head = |fused: bool| {
            let double = if fused && c.fusion == Fusion::Concat { 2 } else { 1 };
            let widths = c.hooks.map(|hook| double * if hook == 0 { c.enc_dim } else { c.dec_dim });
            match c.head {
                HeadKind::Dpt => Head::Dpt(DptHead::new(c, widths, device)),
                HeadKind::Linear => Head::Linear(LinearHead::new(double * c.dec_dim, c.patch, device)),
            }
        };
        Self {
            patch_embed: PatchEmbed {
                proj: Conv2dConfig::new([c.input_channels(), c.enc_dim], patch)
                    .with_stride(patch)
                    .with_padding(PaddingConfig2d::Valid)
                    .init(device),
            },
            enc_blocks: (0..c.enc_depth).map(encoder).collect(),
            enc_norm: layer_norm(c.enc_dim, device),
            decoder_embed: LinearConfig::new(c.enc_dim, c.dec_dim).init(device),
            dec_blocks: (0..c.dec_depth).map(decoder).collect(),
            dec_blocks2: (0..c.dec_depth).map(decoder).collect(),
            dec_norm: layer_norm(c.dec_dim, device),
            downstream_head1: head(false),
            downstream_head2: head(false),
            downstream_head3: c.side_heads.then(|| head(true)),
            downstream_head4: c.side_heads.then(|| head(true)),
            config: c.clone(),
        }
    }

    /// The same network without the heads of the unseen sides.
    pub fn without_sides(self) -> Self {
        Self { downstream_head3: None, downstream_head4: None, ..self }
    }

    /// Whether the layer of this name gives the raw points.
    pub(super) fn is_last_layer(name: &str) -> bool {
        name.contains("downstream_head") && (name.ends_with(".head.4") || name.ends_with(".proj"))
    }

    /// Images `[B, C, H, W]`, colours in [−1, 1] first → normalised encoder tokens `[B, N, enc_dim]`. The token
    /// `grid` has rows and columns.
    pub fn encode(&self, images: Tensor<4>, grid: [usize; 2]) -> Tensor<3> {
        let c = &self.config;
        let rope = rope(grid, c.enc_dim / c.enc_heads, &images.device());
        let proj = &self.patch_embed.proj;
        let tokens = patches(proj, as_weight(images, &proj.weight));
        let tokens = self.enc_blocks.iter().fold(tokens, |x, block| block.forward(x, &rope));
        normalise(&self.enc_norm, tokens)
    }

    /// Encoder tokens of the two photographs `[B, N, enc_dim]` → all token maps of each.
    ///
    /// Each decoder reads the other decoder's tokens of the *previous* layer.
    pub fn decode(&self, front: Tensor<3>, back: Tensor<3>, grid: [usize; 2]) -> [TokenMaps; 2] {
        let c = &self.config;
        let rope = rope(grid, c.dec_dim / c.dec_heads, &front.device());
        let mut x = linear(&self.decoder_embed, front.clone());
        let mut y = linear(&self.decoder_embed, back.clone());
        let (mut front, mut back) = (vec![front], vec![back]);
        for (block, block2) in self.dec_blocks.iter().zip(&self.dec_blocks2) {
            (x, y) = (block.forward(x.clone(), y.clone(), &rope), block2.forward(y, x, &rope));
            front.push(x.clone());
            back.push(y.clone());
        }
        for maps in [&mut front, &mut back] {
            let last = maps.pop().expect("never empty");
            maps.push(normalise(&self.dec_norm, last));
        }
        [front, back]
    }

    /// Raw x, y, z, confidence `[B, 4, H, W]` of one view, from both photographs' token maps.
    ///
    /// # Panics
    /// If the network has no head for `view`.
    pub fn raw_points(&self, view: View, [front, back]: &[TokenMaps; 2], grid: [usize; 2]) -> Tensor<4> {
        let head = match view {
            View::Front => &self.downstream_head1,
            View::Back => &self.downstream_head2,
            View::Right => self.downstream_head3.as_ref().expect("a network with side heads"),
            View::Left => self.downstream_head4.as_ref().expect("a network with side heads"),
            View::RightSecond | View::LeftSecond => panic!("the transformer has no second surfaces"),
        };
        let tokens = |i: usize| match (view, self.config.fusion) {
            (View::Front, _) => front[i].clone(),
            (View::Back, _) => back[i].clone(),
            (_, Fusion::Mean) => (front[i].clone() + back[i].clone()) * 0.5,
            (_, Fusion::Concat) => Tensor::cat(vec![front[i].clone(), back[i].clone()], 2),
        };
        match head {
            Head::Linear(head) => head.forward(tokens(self.config.dec_depth), grid),
            Head::Dpt(head) => head.forward(self.config.hooks.map(tokens), grid),
        }
    }
}
