//! Points of photographs on the rays of their pixels. Across the line of sight, rays are more accurate than predictions.

use burn::tensor::Tensor;

use super::View;
use super::anchor::Rays;
use crate::crop::Window;

/// Points `[B, h, w, 3]` of a photograph's `window` of a canvas of `side`² pixels, metres in the front camera's frame, moved onto their
/// pixels' rays; their depths stay. The camera of the second photograph stands `pair_degrees` around the person from the front's:
/// upright people are seen by exactly these cameras (docs/method.md, "Upright targets").
pub fn on_rays(view: View, pair_degrees: f64, side: usize, window: &Window, points: Tensor<4>) -> Tensor<4> {
    let Rays { directions, centre, forward, .. } =
        Rays::new(view, pair_degrees, side, window, &points.device());
    if view == View::Front {
        return directions * points.narrow(3, 2, 1);
    }
    let depth = ((points - centre.clone()) * forward).sum_dim(3);
    centre + directions * depth
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};
    use glam::{DVec2, DVec3};
    use snapsnap_ops::host;
    use snapsnap_splat::Camera;

    use super::*;
    use crate::config::OPPOSITE;

    const SIDE: usize = 64;

    /// Depths stay, and points project to their pixels.
    #[test]
    fn points_are_moved_onto_the_rays_of_their_pixels() {
        let window = Window { rows: 8..56, columns: 16..40 };
        let front = Camera::orbit_at_yaw_degrees(0.0, SIDE as u32);
        for (view, degrees) in [(View::Front, OPPOSITE), (View::Back, OPPOSITE), (View::Back, 72.0)] {
            let yaw = if view == View::Front { 0.0 } else { degrees };
            let camera = Camera::orbit_at_yaw_degrees(yaw, SIDE as u32);
            let pose = front.world_to_camera.inverse().then(&camera.world_to_camera);
            let depth = |i: usize| 1.5 + 0.001 * i as f64;
            let point = |i: usize| pose.inverse().apply(DVec3::new(0.3, -0.2, depth(i))).as_vec3().to_array();
            let points: Vec<f32> = (0..48 * 24).flat_map(point).collect();
            let points = Tensor::<4>::from_data(TensorData::new(points, [1, 48, 24, 3]), &Device::flex());
            let moved = host(on_rays(view, degrees, SIDE, &window, points));
            for (i, p) in moved.as_chunks::<3>().0.iter().enumerate() {
                let p = pose.apply(DVec3::from(p.map(f64::from)));
                assert!((p.z - depth(i)).abs() < 1e-6, "{view:?} {i}: {p}");
                let pixel = camera.focal * p.truncate() / p.z + camera.principal_point;
                let expected = DVec2::new(16.5 + (i % 24) as f64, 8.5 + (i / 24) as f64);
                assert!((pixel - expected).length() < 1e-4, "{view:?} {i}: {pixel}");
            }
        }
    }
}
