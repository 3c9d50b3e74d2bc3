//! The point predictor: the two-view network, the activations of its raw points, and δ.

use burn::module::{Module, Param};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};

use super::completion::Photographed;
use super::convolution::PointUNet;
use super::details;
use super::dust3r::{Dust3r, TokenMaps};
use super::input::Input;
use super::rays::{anchors, on_rays};
use super::unet::{Levels, UNet};
use super::view::View;
use crate::config::{self, Anchor, ConfMode, Config, Downsample, NetworkConfig, Upsample};
use crate::resample::shrink;
use crate::window::Window;
use snapsnap_ops::bilinear;

/// Points and confidences on one view's pixel grid. [`PointPredictor::heads`] returns network units, and corrections
/// where `network.anchor` is a ray. [`PointPredictor::finished`] returns metres in the front camera's frame, on the
/// window; [`Self::pasted`] brings them onto the canvas.
#[derive(Debug, Clone)]
pub struct PointMap {
    /// `[B, H, W, 3]`.
    pub points: Tensor<4>,
    /// `[B, H, W]`: in (0, 1) with `sigmoid`, in (1, ∞) with `exp`; 0 outside of the window.
    pub conf: Tensor<3>,
}

impl PointMap {
    /// Pastes a view's map of a window into the whole canvas of `config`, which is 0 elsewhere. With
    /// `network.on_rays`, the points of a photograph are moved onto their pixels' rays. The losses of stage 1 compare
    /// maps before this move, so that the network still learns the directions of rays.
    pub fn pasted(self, config: &NetworkConfig, view: View, window: &Window) -> Self {
        let Self { mut points, conf } = self;
        let side = config.resolution;
        if config.on_rays && (view as usize) < 2 {
            points = on_rays(view, config.pair_degrees, side, window, points);
        }
        if *window == Window::whole(side) {
            return Self { points, conf };
        }
        let conf = window.pasted(conf.unsqueeze_dim(3), side).squeeze_dim(3);
        Self { points: window.pasted(points, side), conf }
    }
}

/// Largest exponent: e⁸⁸ is in the range of f32. Larger exponents are clamped. Only untrained networks reach it, but
/// their results must be finite, too.
const MAX_EXPONENT: f64 = 88.0;

/// Raw x, y, z, confidence `[B, 4, H, W]` → point map: p = r / ‖r‖ · (e^‖r‖ − 1), or p = r with anchors
/// (docs/method.md, "Points and confidence").
pub fn activate(raw: Tensor<4>, config: &NetworkConfig) -> PointMap {
    let [b, _, h, w] = raw.dims();
    let xyz = raw.clone().narrow(1, 0, 3).permute([0, 2, 3, 1]);
    let points = match config.anchor {
        Anchor::None => {
            // The square root has no gradient at 0, where the factor beside r is 1.
            const MIN_SQUARE: f64 = 1e-30;
            let norm = xyz.clone().square().sum_dim(3).clamp_min(MIN_SQUARE).sqrt();
            xyz * growth(norm)
        }
        Anchor::Ray => xyz,
    };
    let conf = raw.narrow(1, 3, 1).reshape([b, h, w]);
    let conf = match config.conf_mode {
        ConfMode::Sigmoid => sigmoid(conf),
        ConfMode::Exp => conf.clamp_max(MAX_EXPONENT).exp() + 1.0,
    };
    PointMap { points, conf }
}

/// (e^x − 1) / x for x > 0, without the cancellation of `exp(x) − 1` near 0: a series for small x.
fn growth(x: Tensor<4>) -> Tensor<4> {
    /// End of the series' range: the first omitted term, x⁶/5040, is 1.2e-7 of the sum here.
    const SMALL: f64 = 0.3;
    let terms = [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5];
    let series = terms.iter().fold(x.zeros_like(), |sum, &term| (sum + term) * x.clone()) + 1.0;
    let direct = (x.clone().clamp_max(MAX_EXPONENT).exp() - 1.0) / x.clone().clamp_min(SMALL);
    direct.mask_where(x.lower_elem(SMALL), series)
}

/// The mean of both halves of a batch, for `network.both_ways`. The second half has the maps of the mirrored
/// photographs. These are flipped, their x is negated, and right and left are exchanged.
fn mean_with_mirrored(maps: &[(View, PointMap)]) -> Vec<(View, PointMap)> {
    let mirrored = |view: View| match view {
        View::Right => View::Left,
        View::Left => View::Right,
        other => other,
    };
    let mean = |&(view, ref map): &(View, PointMap)| {
        let other = maps.iter().find(|(other, _)| *other == mirrored(view));
        let (_, other) = other.expect("there are both sides or neither");
        let [b, h, w] = [map.conf.dims()[0] / 2, map.conf.dims()[1], map.conf.dims()[2]];
        let seen = other.points.clone().narrow(0, b, b).flip([2]);
        let x = -seen.clone().narrow(3, 0, 1);
        let seen = seen.slice_assign([0..b, 0..h, 0..w, 0..1], x);
        let points = (map.points.clone().narrow(0, 0, b) + seen) * 0.5;
        let conf = (map.conf.clone().narrow(0, 0, b) + other.conf.clone().narrow(0, b, b).flip([2])) * 0.5;
        (view, PointMap { points, conf })
    };
    maps.iter().map(mean).collect()
}

/// A map that is `factor` times larger. `weights` `[B, 1, H, W]` ≥ 0 are the person's share of each pixel, for
/// `mask-aware` interpolation; without them points are interpolated across silhouettes.
pub(super) fn enlarged(map: PointMap, factor: usize, weights: Option<Tensor<4>>) -> PointMap {
    if factor == 1 {
        return map;
    }
    let [b, h, w, _] = map.points.dims();
    let size = [h * factor, w * factor];
    let up = |x: Tensor<4>| bilinear(x, size, false);
    let points = map.points.permute([0, 3, 1, 2]);
    let plain = up(points.clone());
    let points = match weights {
        Some(weights) => {
            /// Canvas pixels with a smaller interpolated weight keep the plain interpolation.
            const MIN_WEIGHT: f64 = 1e-4;
            let total = up(weights.clone());
            // Points of the background may be anything, an overflow included.
            let background = weights.clone().lower_equal_elem(0.0).expand(points.dims());
            let weighted = (points * weights).mask_fill(background, 0.0);
            let inside = up(weighted) / total.clone().clamp_min(MIN_WEIGHT);
            let outside = total.lower_elem(MIN_WEIGHT).expand(plain.dims());
            inside.mask_where(outside, plain)
        }
        None => plain,
    };
    let conf = up(map.conf.reshape([b, 1, h, w])).reshape([b, size[0], size[1]]);
    PointMap { points: points.permute([0, 2, 3, 1]), conf }
}

/// Output of the encoder.
#[derive(Debug, Clone)]
pub enum Encoded {
    /// Tokens `[2·B, N, enc_dim]` of all fronts, then all backs, and their rows and columns.
    Tokens(Tensor<3>, [usize; 2]),
    /// Feature images of the convolutional body, which receives both photographs at once.
    Levels(Levels),
}

/// Input of the heads.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "there is one at a time")]
pub enum Decoded {
    /// Token maps of the front and of the back, and the rows and columns of the tokens.
    Tokens([TokenMaps; 2], [usize; 2]),
    /// Feature images of the convolutional body, and the features of the photographs' pixels `[B, last_dim, h, w]`.
    Levels(Levels, Tensor<4>),
}

/// The network between photographs and raw points.
#[derive(Module, Debug)]
#[allow(clippy::large_enum_variant, reason = "there is one at a time")]
pub(super) enum Body {
    Transformer(Dust3r),
    Convolution(PointUNet),
}

/// The network that receives both photographs, and the learned global scale δ.
#[derive(Module, Debug)]
pub struct PointPredictor {
    /// δ `[1]`: metres per network unit.
    scale: Param<Tensor<1>>,
    pub(super) body: Body,
    pub(super) details: Option<UNet>,
    #[module(skip)]
    pub(super) config: NetworkConfig,
}

impl PointPredictor {
    /// A predictor with δ from the config. Its other parameters have no values yet.
    pub fn new(config: &NetworkConfig, device: &Device) -> Self {
        let scale = Param::from_tensor(Tensor::full([1], config.delta, device));
        let body = match config.body {
            config::Body::Transformer => Body::Transformer(Dust3r::new(config, device)),
            config::Body::Convolution => Body::Convolution(PointUNet::new(config, device)),
        };
        let details = config.details.as_ref().map(|details| details::network(details, device));
        Self { scale, body, details, config: config.clone() }
    }

    /// The same network without the layers of the unseen sides.
    pub fn without_sides(mut self) -> Self {
        self.config.side_heads = false;
        self.body = match self.body {
            Body::Transformer(net) => Body::Transformer(net.without_sides()),
            Body::Convolution(net) => Body::Convolution(net.without_sides()),
        };
        self
    }

    /// Views of the maps.
    pub fn views(&self) -> &'static [View] {
        match (self.config.side_heads, self.config.second_layer) {
            (true, true) => &View::WITH_SECOND,
            (true, false) => &View::ALL,
            (false, _) => &View::ALL[..2],
        }
    }

    /// Whether the layer of this name in a checkpoint outputs raw points.
    pub(crate) fn is_last_layer(name: &str) -> bool {
        Dust3r::is_last_layer(name) || name.ends_with("decoder.conv_out")
    }

    /// δ `[1]`.
    pub fn delta(&self) -> Tensor<1> {
        self.scale.val()
    }

    /// `x` times δ. δ is expanded, so that its gradient is summed over one dimension after the other.
    fn times_delta(&self, x: Tensor<4>) -> Tensor<4> {
        x.clone() * self.delta().reshape([1; 4]).expand(x.dims())
    }

    /// Enlarges a map from network pixels to canvas pixels, and multiplies its points by δ (docs/method.md,
    /// "Enlargement and delta"). `weights` `[B, 1, H, W]` ≥ 0 are the person's share of each
    /// pixel, for `mask-aware` interpolation.
    pub fn enlarged(&self, map: PointMap, factor: usize, weights: Option<Tensor<4>>) -> PointMap {
        let PointMap { points, conf } = enlarged(map, factor, weights);
        PointMap { points: self.times_delta(points), conf }
    }

    /// Enlarges a map to the canvas pixels of the `window` that the network received, and adds the anchors. Points are
    /// then metres in the front camera's frame. `mask` `[B, 1, S, S]` is the photograph's mask. Sides have no mask:
    /// their person is where the predicted confidence exceeds the threshold, without a gradient.
    pub fn finished(
        &self,
        config: &Config,
        view: View,
        map: PointMap,
        window: &Window,
        mask: Option<&Tensor<4>>,
    ) -> PointMap {
        let factor = window.rows.len() / map.conf.dims()[1];
        let is_weighted = config.upsample() == Upsample::MaskAware && factor > 1;
        let weights = is_weighted.then(|| match mask {
            Some(mask) => shrink(window.cut(mask.clone()), factor, Downsample::Area),
            None => {
                let person = map.conf.clone().detach().greater_elem(config.network.conf_threshold);
                person.float().unsqueeze_dim(1)
            }
        });
        let map = self.enlarged(map, factor, weights);
        let NetworkConfig { anchor: Anchor::Ray, pair_degrees, resolution, .. } = self.config else {
            return map;
        };
        let anchors = anchors(view, pair_degrees, resolution, window, &map.points.device());
        PointMap { points: map.points + anchors, ..map }
    }

    /// The encoder: a transformer reads each photograph alone, a convolution both together.
    pub fn encode(&self, Input { images, grid }: Input) -> Encoded {
        match &self.body {
            Body::Transformer(net) => Encoded::Tokens(net.encode(images, grid), grid),
            Body::Convolution(net) => {
                let b = images.dims()[0] / 2;
                let (front, back) = (images.clone().narrow(0, 0, b), images.narrow(0, b, b));
                Encoded::Levels(net.body.encode(Tensor::cat(vec![front, back], 1), None))
            }
        }
    }

    /// The decoder, which joins both photographs.
    pub fn decode(&self, encoded: Encoded) -> Decoded {
        match (&self.body, encoded) {
            (Body::Transformer(net), Encoded::Tokens(tokens, grid)) => {
                let b = tokens.dims()[0] / 2;
                let (front, back) = (tokens.clone().narrow(0, 0, b), tokens.narrow(0, b, b));
                Decoded::Tokens(net.decode(front, back, grid), grid)
            }
            (Body::Convolution(net), Encoded::Levels(levels)) => {
                let features = net.body.features(&levels);
                Decoded::Levels(levels, features)
            }
            _ => panic!("encoded by another network"),
        }
    }

    /// Raw x, y, z, confidence `[B, 4, h, w]` of [`Self::views`] before activation, without completed sides.
    pub fn raw(&self, decoded: &Decoded) -> Vec<Tensor<4>> {
        match (&self.body, decoded) {
            (Body::Transformer(net), Decoded::Tokens(maps, grid)) => {
                self.views().iter().map(|view| net.raw_points(*view, maps, *grid)).collect()
            }
            (Body::Convolution(net), Decoded::Levels(levels, features)) => net
                .photographed(features.clone())
                .into_iter()
                .chain(net.sides(levels).into_iter().flatten())
                .collect(),
            _ => panic!("decoded by another network"),
        }
    }

    /// Activated maps at the network's resolution, in network units, without anchors and without completed sides
    /// ([`Self::complete`]). With `network.both_ways`, the batch of `decoded` is twice the batch of the result.
    pub fn heads(&self, decoded: &Decoded) -> Vec<(View, PointMap)> {
        let raw = self.raw(decoded);
        let map = |(&view, raw): (&View, Tensor<4>)| {
            // The map of a mirrored photograph is mirrored.
            let raw = if self.config.mirror && view == View::Back { raw.flip([3]) } else { raw };
            (view, activate(raw, &self.config))
        };
        let maps: Vec<_> = View::ALL.iter().zip(raw).map(map).collect();
        if self.config.both_ways { mean_with_mirrored(&maps) } else { maps }
    }

    /// Appends the maps of completed sides to the maps of front and back, in network units and without anchors.
    /// `images` are the input's images of the `window`. Without completed sides, the maps stay as they are.
    pub fn complete(
        &self,
        mut maps: Vec<(View, PointMap)>,
        decoded: &Decoded,
        images: &Tensor<4>,
        window: &Window,
    ) -> Vec<(View, PointMap)> {
        let (Body::Convolution(net), Decoded::Levels(levels, features)) = (&self.body, decoded) else {
            return maps;
        };
        let Some(completion) = &net.completion else { return maps };
        let config = &self.config;
        let window = window.shrunk(config.resolution / config.net_resolution);
        let b = maps[0].1.conf.dims()[0];
        // With `both_ways`, mirror images follow. The back is mirrored in the input, but not in its map.
        let of_person = |x: &Tensor<4>| x.clone().narrow(0, 0, b);
        let [front, back] = [0, images.dims()[0] / 2].map(|from| images.clone().narrow(0, from, b));
        let seen = Tensor::stack::<5>(vec![front, back.flip([3])], 1);
        let points = maps.iter().map(|(view, map)| {
            let anchors =
                anchors(*view, config.pair_degrees, config.net_resolution, &window, &map.points.device());
            self.times_delta(map.points.clone()) + anchors
        });
        let photographed = Photographed {
            points: Tensor::stack(points.collect(), 1),
            colors: seen.clone().narrow(2, 0, 3),
            masks: seen.narrow(2, 3, 1),
            features: of_person(features),
            levels: &levels.images.iter().map(of_person).collect::<Vec<_>>(),
            window: &window,
        };
        let sides = completion.forward(&photographed, &self.delta());
        maps.extend(
            View::WITH_SECOND[2..].iter().zip(sides).map(|(view, raw)| (*view, activate(raw, config))),
        );
        maps
    }

    /// All maps of a `window` of the canvas: `encode`, `decode`, `heads` and `complete` in turn.
    pub fn forward(&self, input: Input, window: &Window) -> Vec<(View, PointMap)> {
        let images = input.images.clone();
        let decoded = self.decode(self.encode(input));
        self.complete(self.heads(&decoded), &decoded, &images, window)
    }
}
