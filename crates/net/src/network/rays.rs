//! Points of photographs on the rays of their pixels. Across the line of sight, rays are more accurate than predictions.

use burn::tensor::{Tensor, TensorData};
use glam::{DMat3, DQuat, DVec2, DVec3};
use snapsnap_ops::host;
use snapsnap_splat::{Camera, RigidTransform};

use super::View;
use super::anchor::nominal;
use crate::config::OPPOSITE;
use crate::crop::Window;

/// Points `[B, h, w, 3]` of a photograph's `window` of a canvas of `side`² pixels, metres in the front camera's frame, moved
/// onto their pixels' rays; their depths stay. The front's rays are those of the frame. The back's camera is nearly
/// opposite; its pose is fitted to the points inside the `mask` `[B, 1, S, S]`, without a gradient. The camera of a neighbour,
/// `pair_degrees` around the person, is known.
pub fn on_rays(
    view: View,
    pair_degrees: f64,
    side: usize,
    window: &Window,
    points: Tensor<4>,
    mask: &Tensor<4>,
) -> Tensor<4> {
    let ([b, h, w, _], device) = (points.dims(), points.device());
    let camera = Camera::orbit_at_yaw_degrees(0.0, side as u32);
    let rays: Vec<DVec2> = window
        .rows
        .clone()
        .flat_map(|row| {
            window.columns.clone().map(move |column| DVec2::new(column as f64 + 0.5, row as f64 + 0.5))
        })
        .map(|pixel| (pixel - camera.principal_point) / camera.focal)
        .collect();
    let values: Vec<f32> = rays.iter().flat_map(|ray| [ray.x as f32, ray.y as f32, 1.0]).collect();
    let directions = Tensor::<4>::from_data(TensorData::new(values, [1, h, w, 3]), &device);
    if view == View::Front {
        return directions * points.narrow(3, 2, 1);
    }
    let (there, seen) = (host(points.clone().detach()), host(window.cut(mask.clone())));
    let poses = there.chunks_exact(3 * h * w).zip(seen.chunks_exact(h * w)).map(|(points, mask)| {
        if pair_degrees != OPPOSITE {
            return nominal(View::Back, pair_degrees, side).1;
        }
        let step = (side / FITTED_SIDE).max(1);
        let grid = (0..h).step_by(step).flat_map(|row| (0..w).step_by(step).map(move |c| row * w + c));
        let pairs = grid
            .filter(|&i| mask[i] >= 0.5)
            .map(|i| (DVec3::from([0, 1, 2].map(|axis| f64::from(points[3 * i + axis]))), rays[i]));
        opposite_camera(&pairs.collect::<Vec<_>>())
    });
    let moved = poses.enumerate().map(|(i, pose)| {
        let constant = |v: DVec3, dims: [usize; 4]| {
            Tensor::<4>::from_data(TensorData::new(v.as_vec3().to_array().to_vec(), dims), &device)
        };
        let back = pose.inverse();
        let centre = constant(back.translation, [1, 1, 1, 3]);
        let axis = |axis: DVec3| constant(back.rotation * axis, [1, 1, 1, 3]);
        let depth = ((points.clone().narrow(0, i, 1) - centre.clone()) * axis(DVec3::Z)).sum_dim(3);
        let [x, y] = [0, 1].map(|c| directions.clone().narrow(3, c, 1));
        centre + (x * axis(DVec3::X) + y * axis(DVec3::Y) + axis(DVec3::Z)) * depth
    });
    let moved: Vec<_> = moved.collect();
    debug_assert_eq!(moved.len(), b);
    Tensor::cat(moved, 0)
}

/// Side of the canvas whose pixels are all used for the fit of the camera; larger canvases use as many.
const FITTED_SIDE: usize = 256;

/// From the front camera's frame to that of the camera behind the person. The pose minimises the distance of the rays
/// (x/z, y/z) to their points (metres, front camera's frame), with the nominal pose as the prior.
fn opposite_camera(pairs: &[(DVec3, DVec2)]) -> RigidTransform {
    /// Gauss-Newton steps. Such small deviations are nearly linear.
    const STEPS: usize = 3;
    /// Standard deviations of the prior: rad around the person's middle, and metres.
    const PRIOR: [f64; 6] = [0.07, 0.07, 0.04, 0.05, 0.05, 0.1];
    /// Number of independent points that all points together count as, since errors of neighbours are alike.
    const COUNT: f64 = 100.0;
    /// Error of each, relative to its distance.
    const ERROR: f64 = 2e-3;
    /// Largest deviation in standard deviations. Points of an untrained network may ask for more.
    const MOST: f64 = 3.0;
    /// Range of distances of points that count, metres.
    const NEAREST: f64 = 0.1;
    const FARTHEST: f64 = 1e3;
    let [front, back] = [0.0, 180.0].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, 1024));
    let nominal = front.world_to_camera.inverse().then(&back.world_to_camera);
    let middle = back.world_to_camera.apply(DVec3::new(0.0, 0.85, 0.0));
    let is_in_front = |point: DVec3| point.is_finite() && point.z > NEAREST && point.length() < FARTHEST;
    let pairs: Vec<(DVec3, DVec2)> = pairs
        .iter()
        .map(|&(point, ray)| (nominal.apply(point), ray))
        .filter(|&(point, _)| is_in_front(point))
        .collect();
    let mut strayed = [0.0; 6];
    let motion = |s: &[f64; 6]| {
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(s[0], s[1], s[2])));
        let shift = DVec3::new(s[3], s[4], s[5]);
        RigidTransform { rotation, translation: middle - rotation * middle + shift }
    };
    let weight = COUNT / (pairs.len().max(1) as f64 * ERROR * ERROR);
    for _ in 0..STEPS {
        let mut normal = [[0.0; 6]; 6];
        let mut right = [0.0; 6];
        for (i, stray) in PRIOR.iter().enumerate() {
            normal[i][i] = 1.0 / (stray * stray);
            right[i] = -strayed[i] / (stray * stray);
        }
        let now = motion(&strayed);
        for (point, ray) in &pairs {
            let p = now.apply(*point);
            if !is_in_front(p) {
                continue;
            }
            let arm = p - now.apply(middle);
            let off = *ray - p.truncate() / p.z;
            // Derivatives of x and y of the picture by the three rotations and the three shifts.
            for (axis, off) in [(DVec3::X, off.x), (DVec3::Y, off.y)] {
                let gradient = (axis - DVec3::Z * (p.dot(axis) / p.z)) / p.z;
                let turn = arm.cross(gradient);
                let row = [turn.x, turn.y, turn.z, gradient.x, gradient.y, gradient.z];
                for i in 0..6 {
                    right[i] += weight * row[i] * off;
                    for j in 0..6 {
                        normal[i][j] += weight * row[i] * row[j];
                    }
                }
            }
        }
        for ((value, step), stray) in strayed.iter_mut().zip(solved(normal, right)).zip(PRIOR) {
            *value = (*value + step).clamp(-MOST * stray, MOST * stray);
        }
    }
    nominal.then(&motion(&strayed))
}

/// x of A x = b, A symmetric and positive definite, by Gauss's elimination.
fn solved(mut a: [[f64; 6]; 6], mut b: [f64; 6]) -> [f64; 6] {
    for i in 0..6 {
        let (pivot, known) = (a[i], b[i]);
        for (row, value) in a.iter_mut().zip(&mut b).skip(i + 1) {
            let factor = row[i] / pivot[i];
            row.iter_mut().zip(pivot).skip(i).for_each(|(entry, above)| *entry -= factor * above);
            *value -= factor * known;
        }
    }
    for i in (0..6).rev() {
        let known: f64 = (i + 1..6).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    const SIDE: usize = 64;

    /// A person's back in a window of a camera that differs by `motion` from the nominal one: points `[h, w, 3]` in the front
    /// camera's frame, metres.
    fn back(window: &Window, motion: &RigidTransform) -> (Vec<f32>, RigidTransform) {
        second(OPPOSITE, window, motion)
    }

    /// The same for the camera `degrees` around the person.
    fn second(degrees: f64, window: &Window, motion: &RigidTransform) -> (Vec<f32>, RigidTransform) {
        let [front, back] = [0.0, degrees].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, SIDE as u32));
        let pose = front.world_to_camera.inverse().then(&back.world_to_camera).then(motion);
        let mut points = Vec::new();
        for row in window.rows.clone() {
            for column in window.columns.clone() {
                let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                let ray = (pixel - back.principal_point) / back.focal;
                // Rounded like a body, and deeper at the hips.
                let depth = 1.9 + 0.8 * ray.x * ray.x - 0.2 * (ray.y - 0.1) * (ray.y - 0.1);
                let point = pose.inverse().apply(depth * DVec3::new(ray.x, ray.y, 1.0));
                points.extend(point.as_vec3().to_array());
            }
        }
        (points, pose)
    }

    fn strayed() -> RigidTransform {
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(0.03, -0.05, 0.02)));
        let middle = DVec3::new(0.0, 0.0, 2.0);
        RigidTransform { rotation, translation: middle - rotation * middle + DVec3::new(0.01, -0.02, 0.03) }
    }

    fn moved(view: View, pair_degrees: f64, window: &Window, points: Vec<f32>) -> Vec<f32> {
        let device = Device::flex();
        let dims = [1, window.rows.len(), window.columns.len(), 3];
        let points = Tensor::<4>::from_data(TensorData::new(points, dims), &device);
        host(on_rays(view, pair_degrees, SIDE, window, points, &Tensor::ones([1, 1, SIDE, SIDE], &device)))
    }

    fn farthest(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn points_of_the_front_are_moved_onto_the_rays_of_their_pixels() {
        let window = Window { rows: 8..56, columns: 16..40 };
        let camera = Camera::orbit_at_yaw_degrees(0.0, SIDE as u32);
        let points: Vec<f32> = (0..48 * 24).flat_map(|i| [0.3, -0.2, 1.5 + 0.001 * i as f32]).collect();
        for (i, p) in moved(View::Front, OPPOSITE, &window, points).chunks_exact(3).enumerate() {
            assert_eq!(p[2], 1.5 + 0.001 * i as f32);
            let p = DVec3::from([p[0], p[1], p[2]].map(f64::from));
            let pixel = camera.focal * p.truncate() / p.z + camera.principal_point;
            let expected = DVec2::new(16.5 + (i % 24) as f64, 8.5 + (i / 24) as f64);
            assert!((pixel - expected).length() < 1e-4, "{i}: {pixel}");
        }
    }

    /// Exact points stay, for any pose of the camera behind the person; errors across the line of sight vanish.
    #[test]
    fn points_of_the_back_are_moved_onto_the_rays_of_the_fitted_camera() {
        let window = Window { rows: 8..56, columns: 16..48 };
        for (motion, tolerance) in [(RigidTransform::IDENTITY, 1e-6), (strayed(), 4e-4)] {
            let (points, pose) = back(&window, &motion);
            assert!(farthest(&moved(View::Back, OPPOSITE, &window, points.clone()), &points) < tolerance);
            let mut random = 1_u32;
            let mut noise = || {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(random >> 8) / f64::from(1 << 24) * 0.04 - 0.02
            };
            let to_front = pose.inverse().rotation;
            let across = points.chunks_exact(3).flat_map(|p| {
                let error = to_front * DVec3::new(noise(), noise(), 0.0);
                [0, 1, 2].map(|axis| p[axis] + error[axis] as f32)
            });
            let across: Vec<f32> = across.collect();
            assert!(farthest(&across, &points) > 0.018);
            let mended = farthest(&moved(View::Back, OPPOSITE, &window, across), &points);
            assert!(mended < 2e-3, "{mended} m");
        }
    }

    /// Its camera is not fitted: points stay on the rays of the nominal one.
    #[test]
    fn points_of_a_neighbour_are_moved_onto_the_rays_of_its_known_camera() {
        let (window, degrees) = (Window { rows: 8..56, columns: 16..48 }, 72.0);
        let (points, pose) = second(degrees, &window, &RigidTransform::IDENTITY);
        assert!(farthest(&moved(View::Back, degrees, &window, points.clone()), &points) < 1e-6);
        let across = pose.inverse().rotation * DVec3::new(0.02, -0.01, 0.0);
        let shifted: Vec<f32> = points
            .chunks_exact(3)
            .flat_map(|p| [0, 1, 2].map(|axis| p[axis] + across[axis] as f32))
            .collect();
        assert!(farthest(&moved(View::Back, degrees, &window, shifted), &points) < 1e-6);
    }

    #[test]
    fn a_camera_without_points_is_the_nominal_one() {
        let [front, back] = [0.0, 180.0].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, 1024));
        let nominal = front.world_to_camera.inverse().then(&back.world_to_camera);
        let hostile = [DVec3::NAN, DVec3::splat(1e30), DVec3::new(0.0, 0.0, 9.0), DVec3::INFINITY];
        let hostile = hostile.map(|point| (point, DVec2::ZERO));
        for pairs in [&[][..], &hostile] {
            assert_eq!(opposite_camera(pairs), nominal);
        }
        // Points of an untrained network, anywhere.
        let anywhere: Vec<_> = (0..500)
            .map(|i| {
                let [a, b, c] = [1.3, 2.7, 0.9].map(|f| (f * f64::from(i)).sin());
                (DVec3::new(a, b, 2.0 + 1.9 * c), DVec2::new(c, a))
            })
            .collect();
        let turned = opposite_camera(&anywhere).rotation * nominal.rotation.transpose();
        let cosine = (turned.x_axis.x + turned.y_axis.y + turned.z_axis.z - 1.0) * 0.5;
        assert!(cosine > 0.9, "{cosine}");
        let one = opposite_camera(&[(DVec3::new(0.1, 0.0, 2.0), DVec2::ZERO)]);
        assert!(one.translation.is_finite() && one.rotation.is_finite());
        let off = (one.apply(DVec3::new(0.1, 0.0, 2.0)) - nominal.apply(DVec3::new(0.1, 0.0, 2.0))).length();
        assert!(off < 0.2, "{off} m");
    }
}
