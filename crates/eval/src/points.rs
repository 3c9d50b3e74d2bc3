//! Distances of predicted points from the ground truth for each view.

use glam::DVec3;

use crate::geometry::double;

/// Names of the views in reports, in the order of their indices.
pub const VIEWS: [&str; 4] = ["front", "back", "right", "left"];

/// Predicted and ground-truth points of a view.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// Its index in [`VIEWS`].
    pub view: usize,
    /// `[H,W,3]` metres.
    pub points: &'a [f32],
    /// `[H,W,3]` metres, same frame.
    pub truth: &'a [f32],
    /// `[H,W]`, above ½ at pixels with ground truth.
    pub valid: &'a [f32],
}

/// Mean distances of one person's points in a view, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointError {
    /// Its index in [`VIEWS`].
    pub view: usize,
    /// Mean distance.
    pub mean: f64,
    /// Mean distance after the common mean shift of the photographed views is removed.
    pub centred: f64,
    /// Share of the ground-truth points for which there is no finite prediction, for example outside the predictor's
    /// window. The means do not include these points.
    pub missed: f64,
}

/// Errors of one person in every view with ground truth and predictions.
pub fn point_errors(pairs: &[Pair]) -> Vec<PointError> {
    let differences = |pair: &Pair| -> Vec<DVec3> {
        let points = pair.points.as_chunks().0.iter().zip(pair.truth.as_chunks().0).zip(pair.valid);
        let there = points.filter(|((point, _), valid)| **valid > 0.5 && is_predicted(point));
        there.map(|((point, truth), _)| double(*point) - double(*truth)).collect()
    };
    let photographed: Vec<DVec3> = pairs.iter().filter(|pair| pair.view < 2).flat_map(differences).collect();
    let shift = photographed.iter().sum::<DVec3>() / photographed.len().max(1) as f64;
    let error = |pair: &Pair| {
        let differences = differences(pair);
        let n = differences.len() as f64;
        (n > 0.0).then(|| PointError {
            view: pair.view,
            mean: differences.iter().map(|d| d.length()).sum::<f64>() / n,
            centred: differences.iter().map(|d| (d - shift).length()).sum::<f64>() / n,
            missed: 1.0 - n / pair.valid.iter().filter(|v| **v > 0.5).count() as f64,
        })
    };
    pairs.iter().filter_map(error).collect()
}

/// Mean angle in degrees between normals of predicted and true points, on a canvas whose rows have `side` pixels. Each
/// normal is of the triangle of a pixel, its right and its lower neighbour. `None` without a triangle on one surface.
pub fn normal_error(pair: &Pair, side: usize) -> Option<f64> {
    // Six pixel widths: longer sides are depth steps. The nominal cameras' focal length is 0.8 of the canvas, and the
    // person is two metres away.
    let longest = 6.0 * 2.0 / (0.8 * side as f64);
    let (points, truth) = (pair.points.as_chunks().0, pair.truth.as_chunks().0);
    let is_there = |i: usize| {
        pair.valid.get(i).is_some_and(|valid| *valid > 0.5) && points.get(i).is_some_and(is_predicted)
    };
    let (mut sum, mut count) = (0.0, 0_u32);
    for i in (0..points.len()).filter(|i| i % side + 1 < side) {
        if ![i, i + 1, i + side].into_iter().all(is_there) {
            continue;
        }
        let sides = |map: &[[f32; 3]]| [i + 1, i + side].map(|to| double(map[to]) - double(map[i]));
        let ([a, b], [c, d]) = (sides(points), sides(truth));
        let (predicted, true_normal) = (a.cross(b), c.cross(d));
        if c.length().max(d.length()) <= longest && true_normal.length() > 0.0 {
            // The angle between vectors of any length; 90° if the predicted normal has length 0.
            let (across, along) = (predicted.cross(true_normal).length(), predicted.dot(true_normal));
            sum += if predicted.length() > 0.0 { across.atan2(along).to_degrees() } else { 90.0 };
            count += 1;
        }
    }
    (count > 0).then(|| sum / f64::from(count))
}

/// Whether a pixel has a prediction. Pixels outside the predictor's window have the point 0, where the camera stands.
pub(crate) fn is_predicted(point: &[f32; 3]) -> bool {
    point.iter().all(|v| v.is_finite()) && point.iter().any(|v| *v != 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_differ_by_the_angle_between_the_surfaces() {
        // A wall, and the same wall turned about the vertical by 30°, seen in 4 × 3 pixels of a centimetre.
        let wall = |slope: f32| -> Vec<f32> {
            let point = |i: i32| [0.01 * (i % 4) as f32, 0.01 * (i / 4) as f32, 2.0 + slope * (i % 4) as f32];
            (0..12).flat_map(point).collect()
        };
        let (flat, turned) = (wall(0.0), wall(0.01 * 30.0_f32.to_radians().tan()));
        let mut valid = [1.0; 12];
        let error = |points: &[f32], truth: &[f32], valid: &[f32]| {
            normal_error(&Pair { view: 0, points, truth, valid }, 4)
        };
        assert!(error(&turned, &turned, &valid).is_some_and(|degrees| degrees < 1e-3));
        assert!(error(&turned, &flat, &valid).is_some_and(|degrees| (degrees - 30.0).abs() < 1e-3));
        assert!(error(&[0.5; 36], &flat, &valid).is_some_and(|degrees| (degrees - 90.0).abs() < 1e-6));
        // Triangles with a point that is not finite, not predicted or not valid are left out.
        let is_30 = |degrees: Option<f64>| degrees.is_some_and(|degrees| (degrees - 30.0).abs() < 1e-3);
        for absent in [f32::NAN, 0.0] {
            let mut without = turned.clone();
            without[15..18].fill(absent);
            assert!(is_30(error(&without, &flat, &valid)), "{absent}");
        }
        let mut wrong = turned.clone();
        wrong[17] += 0.1;
        assert!(!is_30(error(&wrong, &flat, &valid)));
        valid[5] = 0.0;
        assert!(is_30(error(&wrong, &flat, &valid)));
        assert_eq!(error(&turned, &flat, &[0.0; 12]), None);
        // With four pixels a row, a pixel is 62 cm wide. Sides of more than six pixels are depth steps.
        assert_eq!(error(&flat, &wall(4.0), &[1.0; 12]), None);
    }

    #[test]
    fn errors_are_mean_distances_with_and_without_the_common_shift() {
        let truth = [1.0; 9];
        let pair = |view, points| Pair { view, points, truth: &truth, valid: &[1.0, 0.0, 1.0] };
        // Two points with errors of 5 and 1, and an invalid one.
        let front = [4.0, 5.0, 1.0, 100.0, 0.0, 0.0, 2.0, 1.0, 1.0];
        let [error] = point_errors(&[pair(0, &front)])[..] else { panic!("one view") };
        let half = (1.0_f64 + 4.0).sqrt();
        assert!((error.mean - 3.0).abs() < 1e-12 && (error.centred - half).abs() < 1e-12, "{error:?}");
        // The shift is common to front and back, and independent of the sides.
        let (near, far) = ([1.0; 9], [1.0, 1.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0]);
        let errors = point_errors(&[pair(0, &near), pair(1, &far), pair(2, &far)]);
        let found: Vec<_> = errors.iter().map(|e| (e.view, e.mean, e.centred)).collect();
        assert_eq!(found, [(0, 0.0, 1.0), (1, 2.0, 1.0), (2, 2.0, 1.0)]);
        let empty = Pair { valid: &[0.0; 3], ..pair(2, &near) };
        assert_eq!(point_errors(&[empty]), []);
    }

    #[test]
    fn points_without_a_prediction_are_missed_and_have_no_error() {
        let truth = [1.0; 12];
        let points = [1.0, 1.0, 2.0, 0.0, 0.0, 0.0, f32::NAN, 1.0, 1.0, 5.0, 5.0, 5.0];
        let pair = Pair { view: 1, points: &points, truth: &truth, valid: &[1.0, 1.0, 1.0, 0.0] };
        let [error] = point_errors(&[pair])[..] else { panic!("one view") };
        assert_eq!((error.mean, error.centred), (1.0, 0.0));
        assert!((error.missed - 2.0 / 3.0).abs() < 1e-12, "{error:?}");
    }
}
