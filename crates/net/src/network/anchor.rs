//! Points before the network's correction (docs/method.md, "Ray anchors"): the ray of a pixel, by its view's nominal
//! camera, meets the upright plane through the body's axis that faces this camera.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DVec2, DVec3};
use snapsnap_splat::Camera;

use super::View;
use crate::crop::Window;

/// The anchors of a view's pixels in a window of a canvas of `side`² pixels, `[1, h, w, 3]` metres, front camera's frame.
pub fn anchors(view: View, side: usize, window: &Window, device: &Device) -> Tensor<4> {
    let yaw = match view {
        View::Front => 0.0,
        View::Right => 90.0,
        View::Back => 180.0,
        View::Left => 270.0,
    };
    let [front, camera] = [0.0, yaw].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, side as u32));
    let (centre, to_world) = (camera.centre(), camera.world_to_camera.rotation.inverse());
    // The axis is the world's y; towards the camera, level.
    let normal = DVec3::new(centre.x, 0.0, centre.z).normalize();
    let mut values = Vec::with_capacity(3 * window.rows.len() * window.columns.len());
    for row in window.rows.clone() {
        for column in window.columns.clone() {
            let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            let ray = (pixel - camera.principal_point) / camera.focal;
            let ray = to_world * DVec3::new(ray.x, ray.y, 1.0);
            let there = centre - ray * (centre.dot(normal) / ray.dot(normal));
            let there = front.world_to_camera.rotation * there + front.world_to_camera.translation;
            values.extend(there.to_array().map(|v| v as f32));
        }
    }
    Tensor::from_data(TensorData::new(values, [1, window.rows.len(), window.columns.len(), 3]), device)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A point on the axis is its own anchor in every view, and anchors project where their pixels are.
    #[test]
    fn anchors_lie_on_their_rays_and_on_the_planes_through_the_axis() {
        let (side, device) = (64, Device::flex());
        let front = Camera::orbit_at_yaw_degrees(0.0, side as u32);
        for (view, yaw, normal) in [
            (View::Front, 0.0, DVec3::Z),
            (View::Back, 180.0, DVec3::Z),
            (View::Right, 90.0, DVec3::X),
            (View::Left, 270.0, DVec3::X),
        ] {
            let window = Window { rows: 8..56, columns: 16..40 };
            let values: Vec<f32> =
                anchors(view, side, &window, &device).into_data().try_into_vec().expect("f32");
            let camera = Camera::orbit_at_yaw_degrees(yaw, side as u32);
            let inverse = front.world_to_camera.inverse();
            for (i, p) in values.chunks_exact(3).enumerate() {
                let p = DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
                let world = inverse.rotation * p + inverse.translation;
                assert!(world.dot(normal).abs() < 1e-5, "{view:?} {i}: {world}");
                let (pixel, _) = camera.project(world).expect("in front");
                let expected = DVec2::new(16.5 + (i % 24) as f64, 8.5 + (i / 24) as f64);
                assert!((pixel - expected).length() < 1e-4, "{view:?} {i}: {pixel}");
            }
        }
    }
}
