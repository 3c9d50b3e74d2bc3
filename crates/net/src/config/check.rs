//! Which values of a config make sense, alone and beside each other.

use crate::weights::schema::{self, TensorSpec};

use super::{
    Anchor, Body, Config, Downsample, HeadKind, RegressorColor, RegressorStart, RotationFrame, Schema,
    Upsample, WorldFrame,
};

/// Seven times the published size, 16 GB of f32. A larger number is taken for a typing error.
const MAX_PARAMETERS: usize = 4_000_000_000;

impl Schema for Config {
    fn refusal(&self) -> Option<(String, String)> {
        self.problem().map(|(key, message)| (key.to_owned(), message))
    }
}

impl Config {
    fn problem(&self) -> Option<(&'static str, String)> {
        let n = &self.network;
        let sizes = [
            ("network.enc_dim", n.enc_dim, 8_192),
            ("network.enc_depth", n.enc_depth, 128),
            ("network.enc_heads", n.enc_heads, 1_024),
            ("network.dec_dim", n.dec_dim, 8_192),
            ("network.dec_depth", n.dec_depth, 128),
            ("network.dec_heads", n.dec_heads, 1_024),
            ("network.mlp_ratio", n.mlp_ratio, 16),
            ("network.patch", n.patch, 64),
            ("network.layer_dims", n.layer_dims.into_iter().min().unwrap_or(0), 8_192),
            ("network.layer_dims", n.layer_dims.into_iter().max().unwrap_or(0), 8_192),
            ("network.feature_dim", n.feature_dim, 8_192),
            ("network.last_dim", n.last_dim, 8_192),
            ("network.resolution", n.resolution, 4_096),
            ("network.net_resolution", n.net_resolution, 4_096),
            ("regressor.channels", self.regressor.channels, 1_024),
            ("regressor.groups", self.regressor.groups, 1_024),
        ];
        for (key, value, most) in sizes {
            if value == 0 || value > most {
                return Some((key, format!("is {value}, must be between 1 and {most}")));
            }
        }
        for (key, dim, heads) in
            [("network.enc_heads", n.enc_dim, n.enc_heads), ("network.dec_heads", n.dec_dim, n.dec_heads)]
        {
            if !dim.is_multiple_of(4 * heads) {
                let message = format!(
                    "{dim} channels over {heads} heads: the channels of one head must be a multiple of 4 (rotary \
                     position embedding)"
                );
                return Some((key, message));
            }
        }
        if !n.rope_base.is_finite() || n.rope_base <= 0.0 {
            return Some(("network.rope_base", format!("is {}, must be positive", n.rope_base)));
        }
        if !n.feature_dim.is_multiple_of(2) {
            return Some(("network.feature_dim", format!("is {}, must be even", n.feature_dim)));
        }
        let hooked = (n.body == Body::Transformer).then_some(n.hooks);
        if let Some(hook) = hooked.into_iter().flatten().find(|&h| h > n.dec_depth) {
            return Some(("network.hooks", format!("{hook} is beyond the last layer {}", n.dec_depth)));
        }
        if n.body == Body::Convolution {
            if ![8, 16].contains(&n.patch) {
                let message = format!("is {}, a convolution has 8 or 16", n.patch);
                return Some(("network.patch", message));
            }
            if n.drop_empty {
                return Some((
                    "network.drop_empty",
                    "is a transformer's: a convolution has no tokens to drop".into(),
                ));
            }
        } else if n.head == HeadKind::Dpt && n.patch != 16 {
            return Some((
                "network.patch",
                format!("is {}; the DPT head is built for patches of 16 pixels", n.patch),
            ));
        }
        if !n.net_resolution.is_multiple_of(n.patch) {
            let message = format!("{} is no multiple of the patch {}", n.net_resolution, n.patch);
            return Some(("network.net_resolution", message));
        }
        if !n.resolution.is_multiple_of(n.net_resolution) || !n.resolution.is_multiple_of(4) {
            let message = format!(
                "is {}, must be a multiple of `network.net_resolution` ({}) and of 4",
                n.resolution, n.net_resolution
            );
            return Some(("network.resolution", message));
        }
        if n.hull_margin.is_some_and(|margin| margin > 1024) {
            return Some(("network.hull_margin", "must be at most 1024 (of a canvas of 1024)".into()));
        }
        if n.steepest.is_some_and(|steepest| steepest.is_nan() || steepest < 1.0) {
            return Some((
                "network.steepest",
                "must be at least 1 (as on a surface that faces the camera)".into(),
            ));
        }
        if n.conf_threshold.is_nan() {
            return Some(("network.conf_threshold", "is not a number".into()));
        }
        if !(n.delta as f32).is_normal() {
            return Some((
                "network.delta",
                format!("is {}, which as f32 is zero, tiny or infinite", n.delta),
            ));
        }
        if !(16..=1024).contains(&self.person_height()) {
            let message =
                format!("is {}, must be between 16 and 1024 (of a canvas of 1024)", self.person_height());
            return Some(("mode.person_height", message));
        }
        let r = &self.regressor;
        if !(1..=2).contains(&r.networks) {
            return Some(("regressor.networks", format!("is {}, allowed: 1, 2", r.networks)));
        }
        if r.networks == 2 && !n.side_heads {
            return Some((
                "regressor.networks",
                "is 2, but `network.side_heads = false` leaves the second unused".into(),
            ));
        }
        if r.margin.is_some_and(|margin| margin > 4_096) {
            return Some(("regressor.margin", format!("is {}, must be at most 4096", r.margin())));
        }
        if r.margin.is_some() && !self.crop() {
            return Some(("regressor.margin", "has no meaning where `mode.crop` is false".into()));
        }
        if !r.channels.is_multiple_of(r.groups) {
            return Some((
                "regressor.channels",
                format!("{} is no multiple of {} groups", r.channels, r.groups),
            ));
        }
        let parameters: usize = schema::tensors(self).iter().map(TensorSpec::elements).sum();
        if parameters > MAX_PARAMETERS {
            let message =
                format!("all sizes together make {parameters} parameters, more than {MAX_PARAMETERS}");
            return Some(("network", message));
        }
        self.contradiction()
    }

    fn contradiction(&self) -> Option<(&'static str, String)> {
        if !self.mode.compat {
            return (self.rotation_frame() == RotationFrame::Camera
                && self.world_frame() == WorldFrame::Mirrored)
                .then(|| {
                    let message = "\"mirrored\" is a reflection, which no quaternion can follow: set \
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
            ("network.both_ways", !self.network.both_ways, "false"),
            ("network.on_rays", !self.network.on_rays, "false"),
            ("network.hull_margin", self.network.hull_margin.is_none(), "unset"),
            ("network.steepest", self.network.steepest.is_none(), "unset"),
            ("network.drop_empty", !self.network.drop_empty, "false"),
            ("regressor.start", self.regressor.start() == RegressorStart::Published, "\"published\""),
            ("regressor.color", self.regressor.color() == RegressorColor::Free, "\"free\""),
            ("regressor.straight_color", !self.regressor.straight_color, "false"),
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
