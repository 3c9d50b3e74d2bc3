//! The TOML schema of the networks: sizes, heads and modes, with the published size as the default.

mod check;
mod modes;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
pub use snapsnap_base::config::{ConfigError, Schema};

pub use modes::{
    Anchor, Body, ConfMode, Downsample, Fusion, HeadKind, Precision, PrecisionChoice, RegressorColor,
    RegressorStart, RotationFrame, Sides, Upsample, WorldFrame,
};

/// Largest distance, in pixels, of an input pixel that influences an output pixel of the regressor, statistics aside. It is
/// the reach of the 3×3 convolutions on the longest path: 14 at full size, 12 at half size (·2), 14 at a quarter (·4), and
/// up to 3 more because an enlarged pixel lies beside its source. Rounded up to a multiple of 4.
pub const RECEPTIVE_RADIUS: usize = 100;

/// `network.pair_degrees` of a front and a back.
pub const OPPOSITE: f64 = 180.0;

/// The config of the networks.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The point predictor (docs/method.md, "Point predictor").
    pub network: NetworkConfig,
    /// The Gaussian regressor (docs/method.md, "Gaussian regressor").
    pub regressor: RegressorConfig,
    /// Reproduction of the published code's quirks (docs/method.md, "Quirks of the published code").
    pub mode: ModeConfig,
}

/// Size and modes of the point predictor. The default is DUSt3R's `ViTLarge_BaseDecoder_512_dpt` with four heads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// Network between photographs and raw points. A `convolution` uses these sizes: those of the encoder for its coarsest
    /// level, those of the decoder for the sides, `mlp_ratio`, `patch` (8 or 16), `rope_base`, `layer_dims` for the channels at
    /// 1, 2, 4 and 8 times the finest pixel, and `last_dim`.
    pub body: Body,
    /// Channels of an encoder token.
    pub enc_dim: usize,
    /// Encoder blocks.
    pub enc_depth: usize,
    /// Attention heads of an encoder block.
    pub enc_heads: usize,
    /// Channels of a decoder token.
    pub dec_dim: usize,
    /// Blocks of each of the two decoders.
    pub dec_depth: usize,
    /// Attention heads of a decoder block.
    pub dec_heads: usize,
    /// Hidden channels of a block's MLP, as a multiple of its token channels.
    pub mlp_ratio: usize,
    /// Side of a square patch in pixels.
    pub patch: usize,
    /// Base of the rotary position embedding.
    pub rope_base: f64,
    /// Channels of the four DPT branches.
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub layer_dims: [usize; 4],
    /// Channels inside the DPT fusion blocks.
    pub feature_dim: usize,
    /// Channels before the last DPT convolution.
    pub last_dim: usize,
    /// Token maps that feed the DPT branches: 0 is the encoder's output, l the l-th decoder layer's.
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub hooks: [usize; 4],
    /// Kind of head.
    pub head: HeadKind,
    /// Whether the right and left heads exist; without them only the two photographed sides are predicted.
    pub side_heads: bool,
    /// Origin of the maps of the unseen sides.
    pub sides: Sides,
    /// Channels of the network of completed sides at 1, 2, 4 and 8 times the finest pixel.
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub side_dims: [usize; 4],
    /// Whether completed sides have the second surface that faces their cameras, too, such as the flank behind an arm.
    pub second_layer: bool,
    /// Fusion of the tokens of the two photographs into those of the unseen sides.
    pub fusion: Fusion,
    /// Activation of the confidence channel.
    pub conf_mode: ConfMode,
    /// Side of the square canvas in pixels, of points and Gaussians.
    pub resolution: usize,
    /// Side of the square image that the point predictor receives, in pixels.
    pub net_resolution: usize,
    /// A side pixel becomes a Gaussian where its confidence exceeds this.
    pub conf_threshold: f32,
    /// Enlargement of points and confidences from `net_resolution` to `resolution`; unset: as in `mode.compat`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub upsample: Option<Upsample>,
    /// Initial value of δ, the learned global scale of the points (metres per network unit).
    pub delta: f64,
    /// Origin of the predicted points.
    pub anchor: Anchor,
    /// Whether the predictor's input is only the window of the canvas that holds the person
    /// (docs/method.md, "Window").
    pub window: bool,
    /// Whether the predictor receives each pixel's share of the person as a channel.
    pub mask_channel: bool,
    /// Whether the predictor receives the direction of each pixel's ray in two channels.
    pub ray_channels: bool,
    /// Whether the back photograph is mirrored, so that both show a limb at the same place.
    pub mirror: bool,
    /// Precision in which the weights were trained. A training writes it, and a reconstruction uses the same.
    #[serde(skip_serializing_if = "Precision::is_f32")]
    pub precision: Precision,
    /// Whether maps are the means of the predictions for the photographs and for their mirror images.
    pub both_ways: bool,
    /// Whether the photographs' points are moved onto the rays of their pixels.
    pub on_rays: bool,
    /// Largest distance, in pixels of a canvas of 1024, of a point of an unseen side from the photographs' silhouettes. Points
    /// beyond are left out. Unset: all points are kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hull_margin: Option<usize>,
    /// Largest way in metres by which a point of an unseen side moves along its line of sight, away from its camera, until it lies
    /// inside both silhouettes. Unset: 0.05 with [`Self::hull_margin`], else 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hull_reach: Option<f64>,
    /// Whether Gaussians close the top of head and shoulders between front and back, where there are sides.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub closed_top: bool,
    /// Degrees that the camera of the second photograph stands around the person from the first one's, counter-clockwise as seen from
    /// above. 180: front and back. Others are for scenes of several known cameras, and have no unseen sides.
    #[serde(skip_serializing_if = "is_opposite")]
    pub pair_degrees: f64,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            body: Body::Transformer,
            enc_dim: 1024,
            enc_depth: 24,
            enc_heads: 16,
            dec_dim: 768,
            dec_depth: 12,
            dec_heads: 12,
            mlp_ratio: 4,
            patch: 16,
            rope_base: 100.0,
            layer_dims: [96, 192, 384, 768],
            feature_dim: 256,
            last_dim: 128,
            hooks: [0, 6, 9, 12],
            head: HeadKind::Dpt,
            side_heads: true,
            sides: Sides::Predicted,
            side_dims: [32, 48, 64, 96],
            second_layer: false,
            fusion: Fusion::Mean,
            conf_mode: ConfMode::Sigmoid,
            resolution: 1024,
            net_resolution: 512,
            conf_threshold: 0.9,
            upsample: None,
            delta: 5.0,
            anchor: Anchor::None,
            window: false,
            mask_channel: false,
            ray_channels: false,
            mirror: false,
            precision: Precision::F32,
            both_ways: false,
            on_rays: false,
            hull_margin: None,
            hull_reach: None,
            closed_top: false,
            pair_degrees: OPPOSITE,
        }
    }
}

fn is_opposite(degrees: &f64) -> bool {
    *degrees == OPPOSITE
}

impl NetworkConfig {
    /// Channels of a photograph for the network: colours, and the channels that the config adds.
    pub fn input_channels(&self) -> usize {
        3 + usize::from(self.mask_channel) + 2 * usize::from(self.ray_channels)
    }

    /// Largest way in metres by which a point of an unseen side moves into the silhouettes.
    pub fn hull_reach(&self) -> f64 {
        self.hull_reach.unwrap_or(if self.hull_margin.is_some() { 0.05 } else { 0.0 })
    }

    /// Channels of the four token maps that feed the DPT branches.
    pub fn hook_widths(&self) -> [usize; 4] {
        self.hooks.map(|hook| if hook == 0 { self.enc_dim } else { self.dec_dim })
    }
}

/// Size of the Gaussian regressor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegressorConfig {
    /// 1: one network for all views; 2: one for front and back, one for the sides (the paper's ablation).
    pub networks: usize,
    /// Channels of every UNet stage.
    pub channels: usize,
    /// Groups of every group normalisation.
    pub groups: usize,
    /// Start of the network's output; unset: as published.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<RegressorStart>,
    /// Source of a Gaussian's colour; unset: the pixel with a geometric start, else the network.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color: Option<RegressorColor>,
    /// Largest corrections of the colours of photographed pixels and of the pixels of unseen sides, as shares of the range from
    /// black to white. Unset: half of the range.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color_limits: Option<[f64; 2]>,
    /// Least opacities of the Gaussians of photographed pixels and of the pixels of unseen sides. Unset: 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub least_opacities: Option<[f64; 2]>,
    /// With `mode.crop`, pixels around the person's box that the network receives; unset: all that influence the person's
    /// pixels. Training and inference should use the same value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub margin: Option<usize>,
}

impl RegressorConfig {
    /// Pixels around the person's box.
    pub fn margin(&self) -> usize {
        self.margin.unwrap_or(RECEPTIVE_RADIUS)
    }

    /// Start of the network's output.
    pub fn start(&self) -> RegressorStart {
        self.start.unwrap_or(RegressorStart::Published)
    }

    /// Largest corrections of colours of photographs and of unseen sides, as shares of the range from black to white.
    pub fn color_limits(&self) -> [f64; 2] {
        self.color_limits.unwrap_or([0.5; 2])
    }

    /// Least opacities of the Gaussians of photographs and of unseen sides.
    pub fn least_opacities(&self) -> [f64; 2] {
        self.least_opacities.unwrap_or([0.0; 2])
    }

    /// Source of a Gaussian's colour.
    pub fn color(&self) -> RegressorColor {
        self.color.unwrap_or(match self.start() {
            RegressorStart::Published => RegressorColor::Free,
            RegressorStart::Geometric => RegressorColor::Residual,
        })
    }
}

impl Default for RegressorConfig {
    fn default() -> Self {
        Self {
            networks: 1,
            channels: 16,
            groups: 16,
            start: None,
            color: None,
            color_limits: None,
            least_opacities: None,
            margin: None,
        }
    }
}

/// Quirk or fix, one key each. An unset key follows `compat`; a key that contradicts `compat = true` is refused.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModeConfig {
    /// Reproduces every quirk of the published code, which the published weights were trained with.
    pub compat: bool,
    /// Axes that predicted quaternions refer to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rotation_frame: Option<RotationFrame>,
    /// Reduction of the canvas from `resolution` to `net_resolution`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub downsample: Option<Downsample>,
    /// World frame of the PLY.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub world_frame: Option<WorldFrame>,
    /// Whether the regressor receives only the person's box and `regressor.margin` around it. Its group norms then
    /// measure less background, which changes the results of weights trained on the whole canvas (docs/inference.md).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<bool>,
    /// Height to which the person is scaled, in pixels of a canvas of 1024.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub person_height: Option<usize>,
}

impl Config {
    /// The same config with all keys set that follow another key if unset, such as those of `mode.compat`.
    pub fn resolved(&self) -> Self {
        let mut config = self.clone();
        config.network.upsample = Some(self.upsample());
        config.network.hull_reach =
            self.network.hull_reach.or(self.network.hull_margin.map(|_| self.network.hull_reach()));
        config.regressor.start = Some(self.regressor.start());
        config.regressor.color = Some(self.regressor.color());
        config.regressor.margin = self.crop().then(|| self.regressor.margin());
        config.mode = ModeConfig {
            compat: self.mode.compat,
            rotation_frame: Some(self.rotation_frame()),
            downsample: Some(self.downsample()),
            world_frame: Some(self.world_frame()),
            crop: Some(self.crop()),
            person_height: Some(self.person_height()),
        };
        config
    }

    /// Canvas pixels per network pixel, along an axis.
    pub fn upsample_factor(&self) -> usize {
        self.network.resolution / self.network.net_resolution
    }

    /// The value in force of a key of the modes: of the published code with `mode.compat`, else the corrected one.
    fn mode<T>(&self, key: Option<T>, published: T, corrected: T) -> T {
        key.unwrap_or(if self.mode.compat { published } else { corrected })
    }

    /// Interpolation of points and confidences.
    pub fn upsample(&self) -> Upsample {
        self.mode(self.network.upsample, Upsample::Bilinear, Upsample::MaskAware)
    }

    /// Frame of the predicted quaternions.
    pub fn rotation_frame(&self) -> RotationFrame {
        self.mode(self.mode.rotation_frame, RotationFrame::World, RotationFrame::Camera)
    }

    /// Reduction of the canvas to the network's input.
    pub fn downsample(&self) -> Downsample {
        self.mode(self.mode.downsample, Downsample::Nearest, Downsample::Area)
    }

    /// World frame of the PLY.
    pub fn world_frame(&self) -> WorldFrame {
        self.mode(self.mode.world_frame, WorldFrame::Mirrored, WorldFrame::Upright)
    }

    /// Whether the regressor's input is only the person's box.
    pub fn crop(&self) -> bool {
        self.mode(self.mode.crop, false, true)
    }

    /// Height to which the person is scaled, in pixels of a canvas of 1024: that of the training subjects, which cover
    /// rows 124 to 863, or the published demo's (docs/method.md, "Photographs on the canvas").
    pub fn person_height(&self) -> usize {
        self.mode(self.mode.person_height, 700, 739)
    }
}
