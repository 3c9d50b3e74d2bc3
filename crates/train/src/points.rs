//! Stage 1: distances of predicted points from the true ones, and the cross-entropy of the confidences
//! (docs/method.md, "Losses of stage 1").

use burn::tensor::Tensor;
use snapsnap_net::Prediction;
use snapsnap_ops::{mean, mean_lengths};

use crate::task::Part;

/// λ: the weight of the confidences' cross-entropy, as in the published code. The paper has 1.
const CONFIDENCE_WEIGHT: f64 = 0.5;
/// Distances in pixels between which the relief is compared.
const SPACINGS: [usize; 4] = [1, 2, 4, 8];
/// Lower limit of probabilities: the smallest normal f32. (PyTorch's binary cross-entropy has e⁻¹⁰⁰.) Smaller
/// probabilities have no gradient, since the gradient of log 0 is not finite.
const MIN_PROBABILITY: f64 = 1.2e-38;

/// The losses of predicted maps of the first V views. `points` `[B,V,S,S,3]` are the true points in metres in the front
/// camera's frame, and `valid` `[B,V,S,S]`, 0 or 1, marks the pixels that have one. Confidences must be probabilities.
/// The means are over the pixels of a sample, and then over the samples, summed over the views: the distance in metres,
/// the binary cross-entropy of the confidences, and, unless `relief_weight` is 0, the error in metres of the differences
/// between pixels that are 1, 2, 4 and 8 apart.
pub fn losses(
    prediction: &Prediction,
    points: &Tensor<5>,
    valid: &Tensor<4>,
    relief_weight: f64,
) -> Vec<Part> {
    let Prediction { window, maps } = prediction;
    let ([b, ..], h, w) = (points.dims(), window.rows.len(), window.columns.len());
    let mut regression = Vec::new();
    let mut confidence = Vec::new();
    let mut reliefs = Vec::new();
    for (view, map) in maps.iter().filter(|(view, _)| (*view as usize) < points.dims()[1]) {
        let row = *view as usize;
        let inside = window.cut(valid.clone().narrow(1, row, 1)).reshape([b, h, w]);
        let truth = points.clone().narrow(1, row, 1).narrow(2, window.rows.start, h);
        let truth = truth.narrow(3, window.columns.start, w).reshape([b, h, w, 3]);
        // Invalid points may be 10⁸ metres or NaN. They do not reach the gradient, since they are not inside.
        let off = map.points.clone() - truth;
        let offsets = if relief_weight > 0.0 { offsets(h, w) } else { vec![[0, 0]] };
        let lengths = mean_lengths(off, inside.clone(), &offsets);
        if offsets.len() > 1 {
            reliefs.push(lengths.clone().narrow(1, 1, offsets.len() - 1).mean());
        }
        regression.push(lengths.narrow(1, 0, 1).mean());

        let log = |p: Tensor<3>| p.clamp_min(MIN_PROBABILITY).log();
        let (sure, unsure) = (log(map.conf.clone()), log(1.0 - map.conf.clone()));
        let outside: Tensor<3> = 1.0 - inside.clone();
        let entropy = inside * sure + outside * unsure;
        confidence.push(-mean(entropy));
    }
    let parts = [
        ("points", 1.0, regression),
        ("confidence", CONFIDENCE_WEIGHT, confidence),
        ("relief", relief_weight, reliefs),
    ];
    let parts = parts.into_iter().filter(|(.., values)| !values.is_empty());
    parts.map(|(name, weight, values)| Part { name, weight, value: Tensor::cat(values, 0).sum() }).collect()
}

/// Pixel offsets: `0, 0` for the errors themselves, [`SPACINGS`] down and across for their differences.
pub(crate) fn offsets(h: usize, w: usize) -> Vec<[usize; 2]> {
    let apart = SPACINGS.into_iter().flat_map(|spacing| [[spacing, 0], [0, spacing]]);
    [[0, 0]].into_iter().chain(apart.filter(|[down, across]| *down < h && *across < w)).collect()
}
