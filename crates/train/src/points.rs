//! Stage 1: how far predicted points lie from the true ones, and how sure the network may be of them (SNAPSNAP §6).

use burn::tensor::Tensor;
use snapsnap_net::config::{Config, Downsample, Upsample};
use snapsnap_net::network::{PointMap, PointPredictor, View, activate};
use snapsnap_net::resample::shrink;

/// Squares of distances below this have no gradient: the direction of so small an error is noise.
const MIN_SQUARE: f64 = 1e-24;
/// Probabilities are no less than this, the least that f32 has in full: PyTorch's binary cross-entropy takes e⁻¹⁰⁰. Below it
/// there is no gradient; that of log 0 would not be a number.
const MIN_PROBABILITY: f64 = 1.2e-38;

/// What stage 1 is trained on.
#[derive(Debug, Clone)]
pub struct Losses {
    /// Mean distance in metres per view, summed over the views: `[1]`.
    pub regression: Tensor<1>,
    /// Mean binary cross-entropy of the confidences per view, summed: `[1]`.
    pub confidence: Tensor<1>,
}

/// Point maps of all views on the canvas, one view after the other, as training sees them: front and back `[B,2,3,S,S]` in
/// [−1, 1] and their masks `[B,2,S,S]`, for `mask-aware` interpolation.
pub fn predict(
    predictor: &PointPredictor,
    config: &Config,
    images: Tensor<5>,
    masks: &Tensor<4>,
) -> Vec<(View, PointMap)> {
    let [b, _, channels, h, w] = images.dims();
    let factor = config.upsample_factor();
    let side = |i: usize| {
        let image = images.clone().narrow(1, i, 1).reshape([b, channels, h, w]);
        shrink(image, factor, config.downsample())
    };
    let net = &predictor.dust3r;
    let grid = net.grid([h / factor, w / factor]);
    let tokens = net.encode(Tensor::cat(vec![side(0), side(1)], 0));
    let maps = net.decode(tokens.clone().narrow(0, 0, b), tokens.narrow(0, b, b), grid);
    let map = |&view: &View| {
        let map = activate(net.raw_points(view, &maps, grid), config.network.conf_mode);
        // As in inference: photographs have masks, sides the network's own opinion, which gets no gradient from this.
        let weights = (config.upsample() == Upsample::MaskAware && factor > 1).then(|| match view as usize {
            photo @ 0..2 => shrink(masks.clone().narrow(1, photo, 1), factor, Downsample::Area),
            _ => {
                let body = map.conf.clone().detach().greater_elem(config.network.conf_threshold);
                body.float().unsqueeze_dim(1)
            }
        });
        (view, predictor.to_canvas(map, factor, config.upsample(), weights))
    };
    net.views().iter().map(map).collect()
}

/// The losses of predicted maps: true points `[B,V,S,S,3]` in the front camera's frame, metres, and where there are any
/// `[B,V,S,S]`, 0 or 1. Confidences must be probabilities. All samples' pixels are pooled.
pub fn losses(maps: &[(View, PointMap)], points: &Tensor<5>, valid: &Tensor<4>) -> Losses {
    let [b, _, h, w, _] = points.dims();
    let mut regression = Vec::new();
    let mut confidence = Vec::new();
    for (view, map) in maps {
        let row = *view as usize;
        let inside = valid.clone().narrow(1, row, 1).reshape([b, h, w]);
        let there = inside.clone().greater_elem(0.5);
        let truth = points.clone().narrow(1, row, 1).reshape([b, h, w, 3]);
        // What is not there may be anything, 10⁸ metres or NaN, and must not reach the gradient.
        let nowhere = there.clone().bool_not().unsqueeze_dim::<4>(3).expand([b, h, w, 3]);
        let off = (map.points.clone() - truth).mask_fill(nowhere, 0.0);
        let distance = off.square().sum_dim(3).clamp_min(MIN_SQUARE).sqrt().reshape([b, h, w]);
        let count = inside.clone().sum().clamp_min(1.0);
        regression.push((distance * inside.clone()).sum() / count);

        let log = |p: Tensor<3>| p.clamp_min(MIN_PROBABILITY).log();
        let (sure, unsure) = (log(map.conf.clone()), log(1.0 - map.conf.clone()));
        let outside: Tensor<3> = 1.0 - inside.clone();
        let entropy = inside * sure + outside * unsure;
        confidence.push(-entropy.mean());
    }
    let sum = |parts: Vec<Tensor<1>>| Tensor::cat(parts, 0).sum();
    Losses { regression: sum(regression), confidence: sum(confidence) }
}
