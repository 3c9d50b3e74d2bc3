//! The TOML schema of the networks: sizes, heads and modes, with the published size as the default.

mod check;
mod modes;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
pub use snapsnap_base::config::{ConfigError, Schema};

pub use modes::{
    Anchor, Body, ConfMode, Downsample, Fusion, HeadKind, Precision, RegressorStart, RotationFrame, Sides,
    Upsample, WorldFrame,
};

/// Receptive radius of the regressor in pixels, group-norm statistics aside: the sum over the 3×3 convolutions of the
/// longest path, 14 at full size, 12 at half size (·2), 14 at a quarter (·4), and up to 3 more because an enlarged
/// pixel lies beside its source. Rounded up to a multiple of 4.
pub const RECEPTIVE_RADIUS: usize = 100;

/// `network.pair_degrees` of a front and a back photograph.
pub const OPPOSITE: f64 = 180.0;

/// Pixels of the finest level per pixel of the coarsest level of a U-shaped network, along an axis.
pub(crate) const CELL: usize = 8;
/// Pixels of the image of [`DetailsConfig`] per pixel of its network's finest level, along an axis.
pub(crate) const PATCH: usize = 2;

const HULL_REACH: f64 = 0.05;
/// Half of the range from black to white.
const COLOR_LIMITS: [f64; 2] = [0.5; 2];
const LEAST_OPACITIES: [f64; 2] = [0.0; 2];

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
    /// Network between photographs and raw points. A `convolution` uses `enc_*` for the attention at its coarsest
    /// level, `dec_*` for the attention of the sides, `layer_dims` for the channels of its four levels (pixels of 1,
    /// 2, 4 and 8 times the finest size), `patch` (8 or 16) and `last_dim`.
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
    /// Side of a square patch in pixels.
    pub patch: usize,
    /// Channels of the four DPT branches.
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub layer_dims: [usize; 4],
    /// Channels inside the DPT fusion blocks.
    pub feature_dim: usize,
    /// Channels before the last DPT convolution.
    pub last_dim: usize,
    /// Token maps that feed the DPT branches: 0 is the encoder's output, l the output of the l-th decoder layer.
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub hooks: [usize; 4],
    /// Kind of head.
    pub head: HeadKind,
    /// Whether the right and left heads exist; without them only the two photographed sides are predicted.
    pub side_heads: bool,
    /// The network that refines the photographs' points; unset: none.
    pub details: Option<DetailsConfig>,
    /// How the maps of the unseen sides are made.
    pub sides: Sides,
    /// Channels of the completion network's four levels (pixels of 1, 2, 4 and 8 times the finest size).
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub side_dims: [usize; 4],
    /// Whether completed sides also have the second surface that faces their camera, such as the flank behind an arm.
    pub second_layer: bool,
    /// Fusion of the photographs' tokens into the tokens of the unseen sides.
    pub fusion: Fusion,
    /// Activation of the confidence channel.
    pub conf_mode: ConfMode,
    /// Side of the square canvas in pixels: the resolution of point maps and Gaussians.
    pub resolution: usize,
    /// Side of the square image that the point predictor receives, in pixels.
    pub net_resolution: usize,
    /// A side pixel becomes a Gaussian where its confidence exceeds this value.
    pub conf_threshold: f32,
    /// Enlargement of points and confidences from `net_resolution` to `resolution`; unset: follows `mode.compat`.
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
    /// Whether the back photograph is mirrored, so that both photographs show a limb at the same place.
    pub mirror: bool,
    /// Precision in which the weights were trained. A training writes it, and a reconstruction uses the same.
    #[serde(skip_serializing_if = "Precision::is_f32")]
    pub precision: Precision,
    /// Whether maps are the means of the predictions for the photographs and for their mirror images.
    pub both_ways: bool,
    /// Whether the photographs' points are moved onto the rays of their pixels.
    pub on_rays: bool,
    /// Margin around the photographs' silhouettes, in pixels of a canvas of 1024. Points of an unseen side that
    /// project outside of the grown silhouettes are left out. Unset: all points are kept.
    pub hull_margin: Option<usize>,
    /// Largest distance in metres by which a point of an unseen side moves along its line of sight, away from the
    /// side's camera, to lie inside both silhouettes. In force only with [`Self::hull_margin`].
    #[serde(skip_serializing_if = "is_hull_reach")]
    pub hull_reach: f64,
    /// Whether Gaussians close the top of head and shoulders between front and back. Needs sides.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub closed_top: bool,
    /// Angle around the person from the first camera to the second, in degrees, counter-clockwise as seen from above.
    /// 180: front and back. Other angles are for scenes of several known cameras, without unseen sides.
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
            patch: 16,
            layer_dims: [96, 192, 384, 768],
            feature_dim: 256,
            last_dim: 128,
            hooks: [0, 6, 9, 12],
            head: HeadKind::Dpt,
            side_heads: true,
            details: None,
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
            hull_reach: HULL_REACH,
            closed_top: false,
            pair_degrees: OPPOSITE,
        }
    }
}

fn is_opposite(degrees: &f64) -> bool {
    *degrees == OPPOSITE
}

fn is_hull_reach(reach: &f64) -> bool {
    *reach == HULL_REACH
}

fn are_color_limits(limits: &[f64; 2]) -> bool {
    *limits == COLOR_LIMITS
}

fn are_least_opacities(least: &[f64; 2]) -> bool {
    *least == LEAST_OPACITIES
}

impl NetworkConfig {
    /// Pixels of the convolutional body's input per pixel of its finest level, along an axis.
    pub(crate) fn stride(&self) -> usize {
        self.patch / CELL
    }

    /// Channels of a photograph for the network: colours, and the channels that the config adds.
    pub fn input_channels(&self) -> usize {
        3 + usize::from(self.mask_channel) + 2 * usize::from(self.ray_channels)
    }

    /// Largest distance in metres by which a point of an unseen side moves into the silhouettes.
    pub fn hull_reach(&self) -> f64 {
        if self.hull_margin.is_some() { self.hull_reach } else { 0.0 }
    }
}

/// Size of the network that refines the photographs' points (docs/method.md, "Details").
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DetailsConfig {
    /// Side of the square image of the canvas that the network receives, in pixels. Its finest level has half of it.
    pub resolution: usize,
    /// Channels of its four levels (2, 4, 8 and 16 pixels of the image).
    #[serde(deserialize_with = "snapsnap_base::config::four")]
    pub dims: [usize; 4],
}

impl Default for DetailsConfig {
    fn default() -> Self {
        Self { resolution: 1024, dims: [24, 48, 72, 96] }
    }
}

/// Size of the Gaussian regressor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegressorConfig {
    /// 1: one network for all views; 2: one for front and back, one for the sides (the paper's ablation).
    pub networks: usize,
    /// Reference of the network's output and source of the colours; unset: as published.
    pub start: Option<RegressorStart>,
    /// Largest colour corrections, for pixels of the photographs and of the unseen sides, as shares of the range from
    /// black to white.
    #[serde(skip_serializing_if = "are_color_limits")]
    pub color_limits: [f64; 2],
    /// Least opacities, for Gaussians of the photographs and of the unseen sides.
    #[serde(skip_serializing_if = "are_least_opacities")]
    pub least_opacities: [f64; 2],
    /// With `mode.crop`, margin in pixels around the person's box that the network receives; unset: the receptive
    /// radius. Training and inference should use the same value.
    pub margin: Option<usize>,
}

impl RegressorConfig {
    /// Margin in pixels around the person's box.
    pub fn margin(&self) -> usize {
        self.margin.unwrap_or(RECEPTIVE_RADIUS)
    }

    /// Reference of the network's output.
    pub fn start(&self) -> RegressorStart {
        self.start.unwrap_or(RegressorStart::Published)
    }
}

impl Default for RegressorConfig {
    fn default() -> Self {
        Self {
            networks: 1,
            start: None,
            color_limits: COLOR_LIMITS,
            least_opacities: LEAST_OPACITIES,
            margin: None,
        }
    }
}

/// The published code's quirks and their fixes. An unset key follows `compat`; a key that contradicts it is refused.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModeConfig {
    /// Reproduces every quirk of the published code, which the published weights were trained with.
    pub compat: bool,
    /// Axes that predicted quaternions refer to.
    pub rotation_frame: Option<RotationFrame>,
    /// Reduction of the canvas from `resolution` to `net_resolution`.
    pub downsample: Option<Downsample>,
    /// World frame of the PLY.
    pub world_frame: Option<WorldFrame>,
    /// Whether the regressor receives only the person's box and `regressor.margin` around it. Its group norms then
    /// measure less background, which changes the results of weights trained on the whole canvas (docs/inference.md).
    pub crop: Option<bool>,
    /// Height to which the person is scaled, in pixels of a canvas of 1024.
    pub person_height: Option<usize>,
}

impl Config {
    /// The same config with every key set that otherwise follows another key, such as `mode.compat`.
    pub fn resolved(&self) -> Self {
        let mut config = self.clone();
        config.network.upsample = Some(self.upsample());
        config.regressor.start = Some(self.regressor.start());
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

    /// The value of a mode: `key` if set, else `published` with `mode.compat`, else `corrected`.
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

    /// Height to which the person is scaled, in pixels of a canvas of 1024: 739 as for the training subjects, which
    /// cover rows 124 to 863, or 700 as in the published demo (docs/method.md, "Photographs on the canvas").
    pub fn person_height(&self) -> usize {
        self.mode(self.mode.person_height, 700, 739)
    }
}
