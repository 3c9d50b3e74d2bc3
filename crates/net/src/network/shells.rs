//! The points of both photographs as the camera of an unseen side sees them (docs/method.md, "Completed sides").

use burn::tensor::Tensor;
use glam::Vec3;

use super::View;
use super::rays::nominal_camera;
use crate::config::OPPOSITE;
use crate::window::Window;
use snapsnap_ops::gather::NONE;

/// A point that lies this many metres or more behind the nearest point belongs to another limb.
const APART: f64 = 0.05;

/// For every pixel of a side: its nearest point, the nearest of the points at least [`APART`] behind it, and its
/// farthest point, as `[B·h·w]` rows of a table of N points for each sample, or [`NONE`].
pub struct Visible {
    pub nearest: Vec<i32>,
    pub second: Vec<i32>,
    pub farthest: Vec<i32>,
}

impl Visible {
    /// Projects `points` `[B, N, 3]`, metres in the front camera's frame, into the camera of `view`, in a window of a
    /// canvas of `side`² pixels. Points whose `inside` `[B, N]` is below ½ are left out.
    pub fn new(
        view: View,
        side: usize,
        window: &Window,
        [points, inside]: [&[f32]; 2],
        batch: usize,
    ) -> Self {
        let camera = nominal_camera(view, OPPOSITE, side);
        let (n, w) = (inside.len() / batch, window.columns.len());
        let area = window.rows.len() * w;
        let mut found: [Vec<i32>; 3] = Default::default();
        for (sample, (points, inside)) in points.chunks_exact(3 * n).zip(inside.chunks_exact(n)).enumerate() {
            let seen = |(i, point): (usize, &[f32])| {
                let (place, depth) = camera.project(Vec3::from_slice(point).as_dvec3())?;
                let (column, row) = (place.x as usize, place.y as usize);
                let there = place.is_finite() && place.min_element() >= 0.0;
                if !there || !window.rows.contains(&row) || !window.columns.contains(&column) {
                    return None;
                }
                let pixel = (row - window.rows.start) * w + column - window.columns.start;
                Some((pixel, depth, (sample * n + i) as i32))
            };
            let of_person = points.chunks_exact(3).enumerate().filter(|(i, _)| inside[*i] >= 0.5);
            let seen: Vec<(usize, f64, i32)> = of_person.filter_map(seen).collect();
            // By pixel, the point with the smallest `distance` of all points at a depth of `from` or more.
            let nearest = |from: &dyn Fn(usize) -> f64, distance: fn(f64) -> f64| {
                let mut best = vec![(f64::INFINITY, NONE); area];
                for &(pixel, depth, row) in &seen {
                    if depth >= from(pixel) && distance(depth) < best[pixel].0 {
                        best[pixel] = (distance(depth), row);
                    }
                }
                best
            };
            let first = nearest(&|_| 0.0, |depth| depth);
            let second = nearest(&|pixel| first[pixel].0 + APART, |depth| depth);
            let farthest = nearest(&|_| 0.0, |depth| -depth);
            for (rows, best) in found.iter_mut().zip([first, second, farthest]) {
                rows.extend(best.iter().map(|(_, row)| row));
            }
        }
        let [nearest, second, farthest] = found;
        Self { nearest, second, farthest }
    }
}

/// Depths `[B, N, 1]` of points `[B, N, 3]` (metres, front camera's frame) from the camera of `view`.
pub fn depths(view: View, points: Tensor<3>) -> Tensor<3> {
    let to_side = nominal_camera(view, OPPOSITE, 1).world_to_camera;
    let axis = to_side.rotation.row(2).as_vec3().to_array();
    let axis = Tensor::<3>::from_data([[axis]], &points.device());
    (points * axis).sum_dim(2) + to_side.translation.z
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use glam::DVec2;
    use snapsnap_ops::host;

    const SIDE: usize = 64;

    /// Points in the front camera's frame that the camera of `view` sees at these pixels and depths.
    fn seen(view: View, places: &[(f64, f64, f64)]) -> Vec<f32> {
        let camera = nominal_camera(view, OPPOSITE, SIDE);
        let back = camera.world_to_camera.inverse();
        let point = |&(column, row, depth): &(f64, f64, f64)| {
            let ray = (DVec2::new(column, row) - camera.principal_point) / camera.focal;
            back.apply(ray.extend(1.0) * depth).as_vec3().to_array()
        };
        places.iter().flat_map(point).collect()
    }

    #[test]
    fn pixels_of_a_side_show_the_nearest_a_second_and_the_farthest_point_inside() {
        let device = Device::flex();
        let window = Window { rows: 8..56, columns: 16..48 };
        for view in [View::Right, View::Left] {
            // Five points of a pixel, of which one lies outside of the person and two on one surface; a point beside
            // the window; a point behind the camera; a point that is not finite.
            let mut points = seen(
                view,
                &[
                    (20.5, 30.4, 2.0),
                    (20.1, 30.9, 1.8),
                    (20.9, 30.1, 2.3),
                    (20.5, 30.5, 1.0),
                    (60.0, 30.0, 2.0),
                    (20.5, 30.5, -2.0),
                    (20.5, 30.6, 1.84),
                ],
            );
            points.extend([f32::NAN; 3]);
            let mut inside = [1.0; 8];
            inside[3] = 0.2;
            let twice = [points.clone(), points.clone()].concat();
            let both = [inside, inside].concat();
            let visible = Visible::new(view, SIDE, &window, [&twice, &both], 2);
            let Visible { nearest, second, farthest } = visible;
            let found = nearest.iter().zip(second).zip(farthest).map(|((a, b), c)| [*a, b, c]);
            let (area, pixel) = (48 * 32, (30 - 8) * 32 + 20 - 16);
            for (i, found) in found.enumerate() {
                // The second sample's rows follow the first one's.
                let first = if i < area { 0 } else { 8 };
                let expected = if i % area == pixel { [first + 1, first, first + 2] } else { [NONE; 3] };
                assert_eq!(found, expected, "{view:?} {i}");
            }
            assert_eq!(nearest.len(), 2 * area);
            let finite = Tensor::<3>::from_data(TensorData::new(points[..21].to_vec(), [1, 7, 3]), &device);
            let depths = host(depths(view, finite));
            for (depth, expected) in depths.iter().zip([2.0, 1.8, 2.3, 1.0, 2.0, -2.0, 1.84]) {
                assert!((depth - expected).abs() < 1e-5, "{view:?}: {depths:?}");
            }
        }
    }
}
