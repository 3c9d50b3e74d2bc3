//! Stage 1: distances of predicted points from the true ones, and the cross-entropy of the confidences
//! (docs/method.md, "Losses of stage 1").

use burn::tensor::Tensor;
use snapsnap_eval::points::longest_side;
use snapsnap_net::Prediction;
use snapsnap_ops::{bilinear, mean, mean_lengths};

use crate::config::Stage1Config;
use crate::task::Part;

/// Least square of an edge's or a normal's length.
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
    /// Mean length of the normals' errors per photograph, summed: `[1]`; with `network.normals`.
    pub normals: Option<Tensor<1>>,
}

impl Losses {
    /// The losses with their weights.
    pub fn parts(self, config: &Stage1Config) -> Vec<Part> {
        let Stage1Config { confidence_weight, relief_weight, normals_weight } = *config;
        let mut parts = vec![
            Part { name: "points", weight: 1.0, value: self.regression },
            Part { name: "confidence", weight: confidence_weight, value: self.confidence },
        ];
        parts.extend(self.relief.map(|value| Part { name: "relief", weight: relief_weight, value }));
        parts.extend(self.normals.map(|value| Part { name: "normals", weight: normals_weight, value }));
        parts
    }
}

/// The losses of predicted maps of the first V views. `points` `[B,V,S,S,3]` are the true points in metres in the front
/// camera's frame, and `valid` `[B,V,S,S]`, 0 or 1, marks the pixels that have one. Confidences must be probabilities. The means are over
/// the pixels of a sample, and then over the samples. `relief` asks for that loss.
pub fn losses(prediction: &Prediction, points: &Tensor<5>, valid: &Tensor<4>, relief: bool) -> Losses {
    let Prediction { window, maps, normals } = prediction;
    let ([b, _, side, ..], h, w) = (points.dims(), window.rows.len(), window.columns.len());
    let mut regression = Vec::new();
    let mut confidence = Vec::new();
    let mut reliefs = Vec::new();
    let mut of_normals = Vec::new();
    for (view, map) in maps.iter().filter(|(view, _)| (*view as usize) < points.dims()[1]) {
        let row = *view as usize;
        let inside = window.cut(valid.clone().narrow(1, row, 1)).reshape([b, h, w]);
        let truth = points.clone().narrow(1, row, 1).narrow(2, window.rows.start, h);
        let truth = truth.narrow(3, window.columns.start, w).reshape([b, h, w, 3]);
        if let Some(normals) = normals.as_ref().and_then(|normals| normals.get(row)) {
            of_normals.push(normals_error(normals, &truth, &inside, side));
        }
        // Invalid points may be 10⁸ metres or NaN. They do not reach the gradient, since they are not inside.
        let off = map.points.clone() - truth;
        let offsets = if relief { offsets(h, w) } else { vec![[0, 0]] };
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
    let sum = |parts: Vec<Tensor<1>>| Tensor::cat(parts, 0).sum();
    Losses {
        regression: sum(regression),
        confidence: sum(confidence),
        relief: relief.then(|| sum(reliefs)),
        normals: normals.is_some().then(|| sum(of_normals)),
    }
}

/// Mean length of the difference between predicted `normals` `[B,3,h',w']`, enlarged, and those of the true points `[B,h,w,3]` that are
/// `inside` `[B,h,w]`, on a canvas of `side` pixels. A true normal is that of the triangle of a pixel and its
/// neighbours on the right and below.
fn normals_error(normals: &Tensor<4>, truth: &Tensor<4>, inside: &Tensor<3>, side: usize) -> Tensor<1> {
    let [_, h, w, _] = truth.dims();
    let at = |row, column| truth.clone().narrow(1, row, h - 1).narrow(2, column, w - 1);
    let (right, below) = (at(0, 1) - at(0, 0), at(1, 0) - at(0, 0));
    // Right and below, as the camera sees them, cross to a vector away from it.
    let normal = below.clone().cross(right.clone(), 3);
    let length = |x: Tensor<4>| x.square().sum_dim(3).clamp_min(MIN_SQUARE).sqrt();
    let inside = |row, column| inside.clone().narrow(1, row, h - 1).narrow(2, column, w - 1);
    let weight =
        [right, below].into_iter().fold(inside(0, 0) * inside(0, 1) * inside(1, 0), |weight, side_of| {
            weight.mask_fill(length(side_of).greater_elem(longest_side(side)).squeeze_dim::<3>(3), 0.0)
        });
    let is_enlarged = normals.dims()[2..] == [h, w];
    let predicted = if is_enlarged { normals.clone() } else { bilinear(normals.clone(), [h, w], false) };
    let predicted = predicted.permute([0, 2, 3, 1]).narrow(1, 0, h - 1).narrow(2, 0, w - 1);
    mean_lengths(predicted - normal.clone() / length(normal), weight, &[[0, 0]]).mean()
}

/// What the losses measure: the errors themselves, and their differences between two pixels that are [`SPACINGS`] apart in a row or a column.
fn offsets(h: usize, w: usize) -> Vec<[usize; 2]> {
    let apart = SPACINGS.into_iter().flat_map(|spacing| [[spacing, 0], [0, spacing]]);
    [[0, 0]].into_iter().chain(apart.filter(|[down, across]| *down < h && *across < w)).collect()
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
            let offsets = offsets(h, w);
            assert_eq!(offsets.len(), 9);
            let lengths = mean_lengths(off, inside, &offsets);
            f64::from(lengths.narrow(1, 1, 8).mean().into_scalar::<f32>())
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

    #[test]
    fn normals_point_outward_and_steps_between_surfaces_have_none() {
        let (h, w) = (4, 6);
        // 5 mm a pixel of a wall that is turned by 30°, and as seen from behind.
        let wall = |sign: f32, step: f32| -> Tensor<4> {
            let slope = 30.0_f32.to_radians().tan();
            let place = |i: usize| (0.005 * (i % w) as f32, 0.005 * (i / w) as f32);
            let point = |i: usize| {
                let (x, y) = place(i);
                [sign * x, y, 2.0 + slope * x + if i % w >= 3 { step } else { 0.0 }]
            };
            let points: Vec<f32> = (0..h * w).flat_map(point).collect();
            Tensor::from_data(TensorData::new(points, [1, h, w, 3]), &Device::flex())
        };
        let inside = Tensor::<3>::ones([1, h, w], &Device::flex());
        let error = |normal: [f32; 3], truth: Tensor<4>, inside: &Tensor<3>| {
            let normals = Tensor::<1>::from_floats(normal, &Device::flex()).reshape([1, 3, 1, 1]);
            let normals = normals.expand([1, 3, h / 2, w / 2]);
            f64::from(normals_error(&normals, &truth, inside, 1024).into_scalar::<f32>())
        };
        let (sin, cos) = 30.0_f32.to_radians().sin_cos();
        assert!(error([sin, 0.0, -cos], wall(1.0, 0.0), &inside) < 1e-5);
        assert!((error([-sin, 0.0, cos], wall(1.0, 0.0), &inside) - 2.0).abs() < 1e-5);
        assert!(error([sin, 0.0, cos], wall(-1.0, 0.0), &inside) < 1e-5);
        // Steps of half a metre are left out.
        assert!(error([sin, 0.0, -cos], wall(1.0, 0.5), &inside) < 1e-5);
        assert_eq!(error([0.0; 3], wall(1.0, 0.0), &inside.zeros_like()), 0.0);
    }
}
