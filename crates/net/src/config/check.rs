//! The refused values of a config, alone and beside each other.

use snapsnap_base::config::{Removed, outside};

use crate::weights::schema::{self, TensorSpec};

use super::{
    Anchor, Body, Config, Downsample, HeadKind, OPPOSITE, RegressorColor, RegressorStart, RotationFrame,
    Schema, Sides, Upsample, WorldFrame,
};

/// Largest number of parameters: seven times the published size, 16 GB of f32.
const MAX_PARAMETERS: usize = 4_000_000_000;

/// A key and the reason why its value is refused.
type Problem = (&'static str, String);

impl Config {
    /// [`Schema::REMOVED`], also for configs that contain this one.
    pub const GONE: Removed = &[
        ("network.drop_empty", &["false"]),
        ("network.normals", &["false"]),
        ("network.steepest", &["4.0"]),
        // With a geometric start it is true.
        ("regressor.straight_color", &["true", "false"]),
    ];
}

impl Schema for Config {
    const REMOVED: &'static [Removed] = &[Self::GONE];

    fn refusal(&self) -> Option<(String, String)> {
        let problem = self.size_problem().or_else(|| self.problem()).or_else(|| self.contradiction());
        problem.map(|(key, message)| (key.to_owned(), message))
    }
}

impl Config {
    fn size_problem(&self) -> Option<Problem> {
        let (n, r) = (&self.network, &self.regressor);
        let branches = n.layer_dims.map(|dim| ("network.layer_dims", dim, 1..=8_192));
        let sides = n.side_dims.map(|dim| ("network.side_dims", dim, 1..=8_192));
        let sizes = [
            ("network.enc_dim", n.enc_dim, 1..=8_192),
            ("network.enc_depth", n.enc_depth, 1..=128),
            ("network.enc_heads", n.enc_heads, 1..=1_024),
            ("network.dec_dim", n.dec_dim, 1..=8_192),
            ("network.dec_depth", n.dec_depth, 1..=128),
            ("network.dec_heads", n.dec_heads, 1..=1_024),
            ("network.mlp_ratio", n.mlp_ratio, 1..=16),
            ("network.patch", n.patch, 1..=64),
            ("network.feature_dim", n.feature_dim, 1..=8_192),
            ("network.last_dim", n.last_dim, 1..=8_192),
            ("network.resolution", n.resolution, 1..=4_096),
            ("network.net_resolution", n.net_resolution, 1..=4_096),
            ("network.hull_margin", n.hull_margin.unwrap_or(0), 0..=1_024),
            ("mode.person_height", self.person_height(), 16..=1_024),
            ("regressor.networks", r.networks, 1..=2),
            ("regressor.channels", r.channels, 1..=1_024),
            ("regressor.groups", r.groups, 1..=1_024),
            ("regressor.margin", r.margin.unwrap_or(0), 0..=4_096),
        ];
        outside(sizes.into_iter().chain(branches).chain(sides))
    }

    /// The first refused value, for sizes that are each in their range.
    fn problem(&self) -> Option<Problem> {
        let (n, r) = (&self.network, &self.regressor);
        let is_transformer = n.body == Body::Transformer;
        let refuse = |key, message: String| Some((key, message));
        for (key, dim, heads) in
            [("network.enc_heads", n.enc_dim, n.enc_heads), ("network.dec_heads", n.dec_dim, n.dec_heads)]
        {
            if !dim.is_multiple_of(4 * heads) {
                let rule = "the channels of one head must be a multiple of 4 (rotary position embedding)";
                return refuse(key, format!("{dim} channels over {heads} heads: {rule}"));
            }
        }
        if !n.rope_base.is_finite() || n.rope_base <= 0.0 {
            return refuse("network.rope_base", format!("is {}, must be positive", n.rope_base));
        }
        if !n.feature_dim.is_multiple_of(2) {
            return refuse("network.feature_dim", format!("is {}, must be even", n.feature_dim));
        }
        if let Some(hook) = n.hooks.into_iter().find(|&h| is_transformer && h > n.dec_depth) {
            return refuse("network.hooks", format!("{hook} is beyond the last layer {}", n.dec_depth));
        }
        if is_transformer && n.head == HeadKind::Dpt && n.patch != 16 {
            return refuse("network.patch", format!("is {}; the DPT head has patches of 16 pixels", n.patch));
        }
        if !is_transformer && ![8, 16].contains(&n.patch) {
            return refuse(
                "network.patch",
                format!("is {}, must be 8 or 16 with `network.body = \"convolution\"`", n.patch),
            );
        }
        let completed = [
            ("network.body", n.body == Body::Convolution, "\"convolution\""),
            ("network.anchor", n.anchor == Anchor::Ray, "\"ray\""),
            ("network.mask_channel", n.mask_channel, "true"),
            ("network.mirror", n.mirror, "true"),
            ("network.patch", n.patch == 8, "8"),
            // The person's halves have a whole number of pixels at every level.
            ("network.net_resolution", n.net_resolution.is_multiple_of(2 * n.patch), "a multiple of 16"),
        ];
        if let Some((key, _, needed)) =
            completed.into_iter().find(|(_, holds, _)| n.sides == Sides::Completed && !holds)
        {
            return refuse(key, format!("must be {needed} with `network.sides = \"completed\"`"));
        }
        if n.second_layer && (n.sides != Sides::Completed || !n.side_heads) {
            let needed = "`network.sides = \"completed\"` and `network.side_heads = true`";
            return refuse("network.second_layer", format!("needs {needed}"));
        }
        if let Some((key, message)) = outside([("network.pair_degrees", n.pair_degrees, 1.0..=359.0)]) {
            return refuse(key, message);
        }
        // Mirrored, the second photograph would stand on the other side.
        let opposite = [("side_heads", n.side_heads), ("mirror", n.mirror), ("both_ways", n.both_ways)];
        if let Some((key, _)) = opposite.iter().find(|(_, set)| *set && n.pair_degrees != OPPOSITE) {
            let message = format!("must be 180 with `network.{key} = true`");
            return refuse("network.pair_degrees", message);
        }
        if !n.net_resolution.is_multiple_of(n.patch) {
            let message = format!("{} is no multiple of the patch {}", n.net_resolution, n.patch);
            return refuse("network.net_resolution", message);
        }
        if !n.resolution.is_multiple_of(n.net_resolution) || !n.resolution.is_multiple_of(4) {
            let rule = format!("a multiple of `network.net_resolution` ({}) and of 4", n.net_resolution);
            return refuse("network.resolution", format!("is {}, must be {rule}", n.resolution));
        }
        if n.hull_reach.is_some_and(|reach| !(0.0..=1.0).contains(&reach)) {
            return refuse("network.hull_reach", "must be between 0 and 1 (metres)".into());
        }
        if n.closed_top && r.start() != RegressorStart::Geometric {
            let needed = "`regressor.start = \"geometric\"`: the regressor does not make these Gaussians";
            return refuse("network.closed_top", format!("needs {needed}"));
        }
        if n.conf_threshold.is_nan() {
            return refuse("network.conf_threshold", "is not a number".into());
        }
        if let Some((key, message)) = outside([("network.delta", n.delta, 1e-6..=1e6)]) {
            return refuse(key, message);
        }
        if r.color_limits.is_some() && r.color() != RegressorColor::Residual {
            return refuse(
                "regressor.color_limits",
                "has no meaning where `regressor.color` is \"free\"".into(),
            );
        }
        if r.least_opacities.is_some() && r.start() != RegressorStart::Geometric {
            return refuse(
                "regressor.least_opacities",
                "has no meaning where `regressor.start` is \"published\"".into(),
            );
        }
        let least = r.least_opacities().map(|least| ("regressor.least_opacities", least, 0.0..=1.0));
        if let Some((key, message)) = outside(least) {
            return refuse(key, message);
        }
        let limits = r.color_limits().map(|limit| ("regressor.color_limits", limit, 1e-3..=1.0));
        if let Some((key, message)) = outside(limits) {
            return refuse(key, message);
        }
        if r.networks == 2 && !n.side_heads {
            let message = "is 2, but `network.side_heads = false` leaves the second unused";
            return refuse("regressor.networks", message.into());
        }
        if r.margin.is_some() && !self.crop() {
            return refuse("regressor.margin", "has no meaning where `mode.crop` is false".into());
        }
        if !r.channels.is_multiple_of(r.groups) {
            let message = format!("{} is no multiple of {} groups", r.channels, r.groups);
            return refuse("regressor.channels", message);
        }
        let parameters: usize = schema::tensors(self).iter().map(TensorSpec::elements).sum();
        if parameters > MAX_PARAMETERS {
            let message =
                format!("all sizes together make {parameters} parameters, more than {MAX_PARAMETERS}");
            return refuse("network", message);
        }
        None
    }

    fn contradiction(&self) -> Option<(&'static str, String)> {
        if !self.mode.compat {
            return (self.rotation_frame() == RotationFrame::Camera
                && self.world_frame() == WorldFrame::Mirrored)
                .then(|| {
                    let message = "\"mirrored\" is a reflection, which quaternions cannot represent: set \
                                   `mode.rotation_frame = \"world\"` or `mode.world_frame = \"upright\"`";
                    ("mode.world_frame", message.into())
                });
        }
        let quirks = [
            ("network.upsample", self.upsample() == Upsample::Bilinear, "\"bilinear\""),
            ("network.anchor", self.network.anchor == Anchor::None, "\"none\""),
            ("network.window", !self.network.window, "false"),
            ("network.body", self.network.body == Body::Transformer, "\"transformer\""),
            ("network.mask_channel", !self.network.mask_channel, "false"),
            ("network.ray_channels", !self.network.ray_channels, "false"),
            ("network.mirror", !self.network.mirror, "false"),
            ("network.sides", self.network.sides == Sides::Predicted, "\"predicted\""),
            ("network.pair_degrees", self.network.pair_degrees == OPPOSITE, "180"),
            ("network.second_layer", !self.network.second_layer, "false"),
            ("network.both_ways", !self.network.both_ways, "false"),
            ("network.on_rays", !self.network.on_rays, "false"),
            ("network.hull_margin", self.network.hull_margin.is_none(), "unset"),
            ("network.hull_reach", self.network.hull_reach.is_none(), "unset"),
            ("network.closed_top", !self.network.closed_top, "false"),
            ("regressor.start", self.regressor.start() == RegressorStart::Published, "\"published\""),
            ("regressor.color", self.regressor.color() == RegressorColor::Free, "\"free\""),
            ("regressor.color_limits", self.regressor.color_limits.is_none(), "unset"),
            ("regressor.least_opacities", self.regressor.least_opacities.is_none(), "unset"),
            ("mode.rotation_frame", self.rotation_frame() == RotationFrame::World, "\"world\""),
            ("mode.downsample", self.downsample() == Downsample::Nearest, "\"nearest\""),
            ("mode.world_frame", self.world_frame() == WorldFrame::Mirrored, "\"mirrored\""),
            ("mode.crop", !self.crop(), "false"),
            ("mode.person_height", self.person_height() == 700, "700"),
        ];
        let (key, _, allowed) = quirks.into_iter().find(|(_, holds, _)| !holds)?;
        Some((
            key,
            format!("contradicts `mode.compat = true`, which means {allowed}; leave one of the two out"),
        ))
    }
}
