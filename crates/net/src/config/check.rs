//! The refused values and combinations of values of a config.

use snapsnap_base::config::outside;

use super::{
    Anchor, Body, CELL, COLOR_LIMITS, Config, Downsample, HULL_REACH, HeadKind, LEAST_OPACITIES,
    NetworkConfig, OPPOSITE, PATCH, RegressorStart, RotationFrame, Sides, Upsample, WorldFrame,
};

/// Largest number of parameters: seven times the published size, 16 GB of f32.
const MAX_PARAMETERS: usize = 4_000_000_000;

/// A key and the reason why its value is refused.
type Problem = (&'static str, String);

impl Config {
    /// The first refused key, and the reason. `parameters` counts the parameters of networks whose sizes are in their
    /// ranges.
    pub(crate) fn refused(&self, parameters: impl FnOnce() -> usize) -> Option<(String, String)> {
        let too_large = || {
            let count = parameters();
            let message = format!("all sizes together make {count} parameters, more than {MAX_PARAMETERS}");
            (count > MAX_PARAMETERS).then_some(("network", message))
        };
        let problem = self
            .range_problem()
            .or_else(|| self.problem())
            .or_else(too_large)
            .or_else(|| self.contradiction());
        problem.map(|(key, message)| (key.to_owned(), message))
    }

    /// The first value that is outside of its range.
    fn range_problem(&self) -> Option<Problem> {
        let (n, r) = (&self.network, &self.regressor);
        let branches = n.layer_dims.map(|dim| ("network.layer_dims", dim, 1..=8_192));
        let sides = n.side_dims.map(|dim| ("network.side_dims", dim, 1..=8_192));
        let details = n.details.clone().unwrap_or_default();
        let detail_dims = details.dims.map(|dim| ("network.details.dims", dim, 1..=8_192));
        let sizes = [
            ("network.details.resolution", details.resolution, 1..=4_096),
            ("network.enc_dim", n.enc_dim, 1..=8_192),
            ("network.enc_depth", n.enc_depth, 1..=128),
            ("network.enc_heads", n.enc_heads, 1..=1_024),
            ("network.dec_dim", n.dec_dim, 1..=8_192),
            ("network.dec_depth", n.dec_depth, 1..=128),
            ("network.dec_heads", n.dec_heads, 1..=1_024),
            ("network.patch", n.patch, 1..=64),
            ("network.feature_dim", n.feature_dim, 1..=8_192),
            ("network.last_dim", n.last_dim, 1..=8_192),
            ("network.resolution", n.resolution, 1..=4_096),
            ("network.net_resolution", n.net_resolution, 1..=4_096),
            ("network.hull_margin", n.hull_margin.unwrap_or(0), 0..=1_024),
            ("mode.person_height", self.person_height(), 16..=1_024),
            ("regressor.networks", r.networks, 1..=2),
            ("regressor.margin", r.margin.unwrap_or(0), 0..=4_096),
        ];
        let least = r.least_opacities.map(|least| ("regressor.least_opacities", least, 0.0..=1.0));
        let limits = r.color_limits.map(|limit| ("regressor.color_limits", limit, 1e-3..=1.0));
        let values = [
            ("network.pair_degrees", n.pair_degrees, 1.0..=359.0),
            ("network.hull_reach", n.hull_reach, 0.0..=1.0),
            ("network.delta", n.delta, 1e-6..=1e6),
        ];
        outside(sizes.into_iter().chain(branches).chain(sides).chain(detail_dims))
            .or_else(|| outside(values.into_iter().chain(least).chain(limits)))
    }

    /// The first refused combination. Each value must be in its range already.
    fn problem(&self) -> Option<Problem> {
        let (n, r) = (&self.network, &self.regressor);
        let &NetworkConfig { patch, resolution, net_resolution: small, feature_dim, dec_depth, .. } = n;
        let is_transformer = n.body == Body::Transformer;
        let is_completed = n.sides == Sides::Completed;
        let is_ray = n.anchor == Anchor::Ray;
        let is_oblique = n.pair_degrees != OPPOSITE;
        let is_geometric = r.start() == RegressorStart::Geometric;
        let hook = n.hooks.into_iter().find(|hook| *hook > dec_depth).unwrap_or(0);
        let heads =
            [("network.enc_heads", n.enc_dim, n.enc_heads), ("network.dec_heads", n.dec_dim, n.dec_heads)];
        let heads = heads.map(|(key, dim, heads)| {
            let rule = "the channels of one head must be a multiple of 4 (rotary position embedding)";
            (key, !dim.is_multiple_of(4 * heads), format!("{dim} channels over {heads} heads: {rule}"))
        });
        let completed = |needed: &str| format!("must be {needed} with `network.sides = \"completed\"`");
        let opposite = |other: &str| format!("must be 180 with `{other}`");
        let of_geometry = || "has no meaning where `regressor.start` is \"published\"".to_owned();
        let is_patched = small.is_multiple_of(patch);
        let is_enlarged = resolution.is_multiple_of(small) && resolution.is_multiple_of(4);
        // Both halves of an image have a whole number of pixels at every level.
        let is_halved = small.is_multiple_of(2 * patch);
        // Details are left out of smaller canvases.
        let details = n.details.as_ref().map(|details| details.resolution).filter(|size| *size <= resolution);
        // Windows are whole patches of the predictor's input.
        let is_detailed = details.is_none_or(|size| {
            size.is_multiple_of(PATCH * small)
                && resolution.is_multiple_of(size)
                && (patch * size / small).is_multiple_of(PATCH * CELL)
        });
        let problems = [
            ("network.feature_dim", feature_dim % 2 == 1, format!("is {feature_dim}, must be even")),
            (
                "network.hooks",
                is_transformer && hook > dec_depth,
                format!("{hook} is beyond the last layer {dec_depth}"),
            ),
            (
                "network.patch",
                is_transformer && n.head == HeadKind::Dpt && patch != 16,
                format!("is {patch}; the DPT head has patches of 16 pixels"),
            ),
            (
                "network.patch",
                !is_transformer && ![8, 16].contains(&patch),
                format!("is {patch}, must be 8 or 16 with `network.body = \"convolution\"`"),
            ),
            ("network.body", is_completed && is_transformer, completed("\"convolution\"")),
            ("network.anchor", is_completed && !is_ray, completed("\"ray\"")),
            ("network.mask_channel", is_completed && !n.mask_channel, completed("true")),
            ("network.mirror", is_completed && !n.mirror, completed("true")),
            ("network.patch", is_completed && patch != 8, completed("8")),
            ("network.net_resolution", is_completed && !is_halved, completed("a multiple of 16")),
            (
                "network.second_layer",
                n.second_layer && !(is_completed && n.side_heads),
                "needs `network.sides = \"completed\"` and `network.side_heads = true`".into(),
            ),
            ("network.details", n.details.is_some() && !is_ray, "needs `network.anchor = \"ray\"`".into()),
            ("network.pair_degrees", details.is_some() && is_oblique, opposite("network.details")),
            (
                "network.details.resolution",
                !is_detailed,
                format!(
                    "must be a multiple of twice `network.net_resolution` ({small}) and divide `network.resolution` \
                     ({resolution}); a patch must have a multiple of {} of its pixels",
                    PATCH * CELL
                ),
            ),
            // The mirror image of the second photograph belongs to a camera at minus this angle.
            ("network.pair_degrees", is_oblique && n.side_heads, opposite("network.side_heads = true")),
            ("network.pair_degrees", is_oblique && n.mirror, opposite("network.mirror = true")),
            ("network.pair_degrees", is_oblique && n.both_ways, opposite("network.both_ways = true")),
            ("network.net_resolution", !is_patched, format!("{small} is no multiple of the patch {patch}")),
            (
                "network.resolution",
                !is_enlarged,
                format!("is {resolution}, must be a multiple of `network.net_resolution` ({small}) and of 4"),
            ),
            (
                "network.closed_top",
                n.closed_top && !is_geometric,
                "needs `regressor.start = \"geometric\"`: the regressor does not make these Gaussians".into(),
            ),
            ("network.conf_threshold", n.conf_threshold.is_nan(), "is not a number".into()),
            ("regressor.color_limits", !is_geometric && r.color_limits != COLOR_LIMITS, of_geometry()),
            (
                "regressor.least_opacities",
                !is_geometric && r.least_opacities != LEAST_OPACITIES,
                of_geometry(),
            ),
            (
                "regressor.networks",
                r.networks == 2 && !n.side_heads,
                "is 2, but `network.side_heads = false` leaves the second unused".into(),
            ),
            (
                "network.hull_reach",
                n.hull_margin.is_none() && n.hull_reach != HULL_REACH,
                "has no meaning without `network.hull_margin`".into(),
            ),
            (
                "regressor.margin",
                r.margin.is_some() && !self.crop(),
                "has no meaning where `mode.crop` is false".into(),
            ),
        ];
        let (key, _, message) = heads.into_iter().chain(problems).find(|(_, is_refused, _)| *is_refused)?;
        Some((key, message))
    }

    fn contradiction(&self) -> Option<Problem> {
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
            ("network.details", self.network.details.is_none(), "unset"),
            ("network.both_ways", !self.network.both_ways, "false"),
            ("network.on_rays", !self.network.on_rays, "false"),
            ("network.hull_margin", self.network.hull_margin.is_none(), "unset"),
            ("network.closed_top", !self.network.closed_top, "false"),
            ("regressor.start", self.regressor.start() == RegressorStart::Published, "\"published\""),
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
