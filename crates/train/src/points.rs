//! Stage 1: distances of predicted points from the true ones, and the entropy of the confidences
//! (docs/method.md, "Losses of stage 1").

use burn::tensor::Tensor;
use snapsnap_net::Window;
use snapsnap_net::config::{Config, NetworkConfig};
use snapsnap_net::network::{Input, PointMap, PointPredictor, View};
use snapsnap_ops::{host, mean};

use crate::config::Stage1Config;
use crate::task::Part;

/// Least square of a distance with a gradient. The direction of a smaller error is noise.
const MIN_SQUARE: f64 = 1e-24;
/// Distances in pixels between which the relief is compared.
const SPACINGS: [usize; 4] = [1, 2, 4, 8];
/// Lower limit of probabilities: the smallest normal f32. (PyTorch's binary cross-entropy has e⁻¹⁰⁰.) Smaller
/// probabilities have no gradient, since the gradient of log 0 is not finite.
const MIN_PROBABILITY: f64 = 1.2e-38;

/// The losses of stage 1.
#[derive(Debug, Clone)]
pub struct Losses {
    /// Mean distance in metres per view, summed over the views: `[1]`.
    pub regression: Tensor<1>,
    /// Mean binary cross-entropy of the confidences per view, summed: `[1]`.
    pub confidence: Tensor<1>,
    /// Mean error in metres of the differences between pixels that are 1, 2, 4 and 8 apart, per view, summed: `[1]`; if it
    /// was asked for.
    pub relief: Option<Tensor<1>>,
}

impl Losses {
    /// The losses with their weights.
    pub fn parts(self, config: &Stage1Config) -> Vec<Part> {
        let Stage1Config { confidence_weight, relief_weight } = *config;
        let mut parts = vec![
            Part { name: "points", weight: 1.0, value: self.regression },
            Part { name: "confidence", weight: confidence_weight, value: self.confidence },
        ];
        parts.extend(self.relief.map(|value| Part { name: "relief", weight: relief_weight, value }));
        parts
    }
}

/// Point maps of all views on the predictor's window of the canvas.
#[derive(Debug, Clone)]
pub struct Prediction {
    /// The window.
    pub window: Window,
    /// `[B,h,w,3]` and `[B,h,w]` of every view.
    pub maps: Vec<(View, PointMap)>,
}

impl Prediction {
    /// The maps on the whole canvas, as in inference. They are 0 outside the window. `masks` `[B,2,S,S]` are those of
    /// the photographs.
    pub fn pasted(self, config: &NetworkConfig, masks: &Tensor<4>) -> Vec<(View, PointMap)> {
        let placed = |(view, map): (View, PointMap)| {
            let mask = mask_of(view, masks);
            (view, map.pasted(config, view, &self.window, mask.as_ref()))
        };
        self.maps.into_iter().map(placed).collect()
    }
}

/// The mask `[B,1,S,S]` of a photograph; `None` for the sides.
fn mask_of(view: View, masks: &Tensor<4>) -> Option<Tensor<4>> {
    ((view as usize) < 2).then(|| masks.clone().narrow(1, view as usize, 1))
}

/// The predictor's window for photographs with these masks `[.., S, S]`.
pub(crate) fn window(config: &Config, masks: &[f32], side: usize) -> Window {
    Window::of_predictor(config, person(masks, side))
}

/// The box around the person in photographs with these masks `[.., S, S]`.
pub(crate) fn person(masks: &[f32], side: usize) -> Option<Window> {
    let masks: Vec<bool> = masks.iter().map(|mask| *mask > 0.0).collect();
    Window::around(masks.chunks_exact(side * side), side)
}

/// Predicted point maps of front and back `[B,2,3,S,S]` in [−1, 1]. Their masks `[B,2,S,S]` decide the window and
/// `mask-aware` interpolation.
pub fn predict(
    predictor: &PointPredictor,
    config: &Config,
    images: Tensor<5>,
    masks: &Tensor<4>,
) -> Prediction {
    let side = images.dims()[3];
    let window =
        if config.network.window { window(config, &host(masks.clone()), side) } else { Window::whole(side) };
    predict_in(window, predictor, config, images, masks)
}

/// [`predict`] in the window of a larger batch.
pub(crate) fn predict_in(
    window: Window,
    predictor: &PointPredictor,
    config: &Config,
    images: Tensor<5>,
    masks: &Tensor<4>,
) -> Prediction {
    let [b, _, channels, side, _] = images.dims();
    // All fronts, then all backs.
    let photographs = images.swap_dims(0, 1).reshape([2 * b, channels, side, side]);
    let of_input = masks.clone().swap_dims(0, 1).reshape([2 * b, 1, side, side]);
    let finished = |(view, map): (View, PointMap)| {
        (view, predictor.finished(config, view, map, &window, mask_of(view, masks).as_ref()))
    };
    let maps = predictor.forward(Input::new(config, photographs, of_input, &window), &window);
    let maps = maps.into_iter().map(finished).collect();
    Prediction { window, maps }
}

/// The losses of predicted maps of the first V views. `points` `[B,V,S,S,3]` are the true points in metres in the front
/// camera's frame, and `valid` `[B,V,S,S]`, 0 or 1, marks the pixels that have one. Confidences must be probabilities. The means are over
/// the pixels of a sample, and then over the samples. `relief` asks for that loss.
pub fn losses(prediction: &Prediction, points: &Tensor<5>, valid: &Tensor<4>, relief: bool) -> Losses {
    let Prediction { window, maps } = prediction;
    let (b, h, w) = (points.dims()[0], window.rows.len(), window.columns.len());
    let mut regression = Vec::new();
    let mut confidence = Vec::new();
    let mut reliefs = Vec::new();
    for (view, map) in maps.iter().filter(|(view, _)| (*view as usize) < points.dims()[1]) {
        let row = *view as usize;
        let inside = window.cut(valid.clone().narrow(1, row, 1)).reshape([b, h, w]);
        let there = inside.clone().greater_elem(0.5);
        let truth = points.clone().narrow(1, row, 1).narrow(2, window.rows.start, h);
        let truth = truth.narrow(3, window.columns.start, w).reshape([b, h, w, 3]);
        // Invalid points may be 10⁸ metres or NaN. They must not reach the gradient.
        let nowhere = there.clone().bool_not().unsqueeze_dim::<4>(3).expand([b, h, w, 3]);
        let off = (map.points.clone() - truth).mask_fill(nowhere, 0.0);
        if relief {
            reliefs.push(relief_error(&off, &inside));
        }
        regression.push(mean_length(off, inside.clone()));

        let log = |p: Tensor<3>| p.clamp_min(MIN_PROBABILITY).log();
        let (sure, unsure) = (log(map.conf.clone()), log(1.0 - map.conf.clone()));
        let outside: Tensor<3> = 1.0 - inside.clone();
        let entropy = inside * sure + outside * unsure;
        confidence.push(-mean(entropy));
    }
    let sum = |parts: Vec<Tensor<1>>| Tensor::cat(parts, 0).sum();
    Losses { regression: sum(regression), confidence: sum(confidence), relief: relief.then(|| sum(reliefs)) }
}

/// Mean length of vectors `[B,h,w,3]` where `weight` `[B,h,w]` is 1, 0 for samples where it is 1 nowhere; the mean over the samples.
fn mean_length(vectors: Tensor<4>, weight: Tensor<3>) -> Tensor<1> {
    let length = vectors.square().sum_dim(3).clamp_min(MIN_SQUARE).sqrt().squeeze_dim::<3>(3);
    // Not all at once: on GPUs one thread adds up what a step joins.
    let sum = |values: Tensor<3>| values.sum_dim(2).sum_dim(1);
    (sum(length * weight.clone()) / sum(weight).clamp_min(1.0)).mean()
}

/// Mean error of differences between pixels: of the differences of errors `off` `[B,h,w,3]` between two pixels that are `inside`
/// `[B,h,w]`, [`SPACINGS`] apart in a row or a column, each spacing and direction alike.
fn relief_error(off: &Tensor<4>, inside: &Tensor<3>) -> Tensor<1> {
    let mut errors = Vec::new();
    for spacing in SPACINGS {
        for axis in [1, 2] {
            let Some(rest) = off.dims()[axis].checked_sub(spacing).filter(|rest| *rest > 0) else { continue };
            let between = off.clone().narrow(axis, spacing, rest) - off.clone().narrow(axis, 0, rest);
            let both = inside.clone().narrow(axis, spacing, rest) * inside.clone().narrow(axis, 0, rest);
            errors.push(mean_length(between, both));
        }
    }
    Tensor::cat(errors, 0).mean()
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    #[test]
    fn relief_is_free_of_the_place_and_measures_slopes() {
        let (h, w) = (9, 12);
        let error = |of: &dyn Fn(usize, usize) -> [f32; 3], is_inside: &dyn Fn(usize, usize) -> bool| {
            let places = || (0..h).flat_map(|row| (0..w).map(move |column| (row, column)));
            let off: Vec<f32> = places().flat_map(|(row, column)| of(row, column)).collect();
            let inside: Vec<f32> =
                places().map(|(row, column)| f32::from(u8::from(is_inside(row, column)))).collect();
            let off = Tensor::<4>::from_data(TensorData::new(off, [1, h, w, 3]), &Device::flex());
            let inside = Tensor::<3>::from_data(TensorData::new(inside, [1, h, w]), &Device::flex());
            f64::from(relief_error(&off, &inside).into_scalar::<f32>())
        };
        // The least length of a difference is 1e-12.
        assert!(error(&|_, _| [0.3, -0.2, 0.7], &|_, _| true) < 1e-11);
        // 5 mm a column: the mean of 1, 2, 4 and 8 columns, and nothing along the columns.
        let slope = |_: usize, column: usize| [0.003 * column as f32, 0.0, 0.004 * column as f32];
        let expected = 0.005 * (1.0 + 2.0 + 4.0 + 8.0) / 8.0;
        assert!((error(&slope, &|_, _| true) - expected).abs() < 1e-8);
        // Pairs with a pixel outside do not count.
        let spike =
            |row: usize, column: usize| if (row, column) == (4, 5) { [9.0; 3] } else { slope(row, column) };
        assert!((error(&spike, &|row, column| (row, column) != (4, 5)) - expected).abs() < 1e-8);
        assert!(error(&spike, &|_, _| true) > 2.0 * expected);
        assert_eq!(error(&slope, &|_, _| false), 0.0);
    }
}
