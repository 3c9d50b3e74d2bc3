//! Points before the network's correction (docs/method.md, "Ray anchors"): the ray of a pixel, by its view's nominal
//! camera, meets the upright plane through the body's axis that faces this camera.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DVec2, DVec3};
use snapsnap_splat::{Camera, RigidTransform};

use super::View;
use crate::crop::Window;

/// Yaw of a view's nominal camera, degrees. The second photograph's is `pair_degrees`.
fn yaw(view: View, pair_degrees: f64) -> f64 {
    match view {
        View::Front => 0.0,
        View::Right | View::RightSecond => 90.0,
        View::Back => pair_degrees,
        View::Left | View::LeftSecond => 270.0,
    }
}

/// A view's nominal camera of a canvas of `side`² pixels, and the motion from the front camera's frame to its own.
pub(crate) fn nominal(view: View, pair_degrees: f64, side: usize) -> (Camera, RigidTransform) {
    let [front, camera] =
        [0.0, yaw(view, pair_degrees)].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, side as u32));
    (camera, front.world_to_camera.inverse().then(&camera.world_to_camera))
}

/// A view's nominal camera of a canvas of `side`² pixels. Its world is the front camera's frame.
pub(crate) fn nominal_camera(view: View, pair_degrees: f64, side: usize) -> Camera {
    let (camera, world_to_camera) = nominal(view, pair_degrees, side);
    Camera { world_to_camera, ..camera }
}

/// The rays of a view's pixels in a window of a canvas of `side`² pixels.
pub(super) struct Rays {
    /// Directions in the front camera's frame `[1, h, w, 3]`, scaled to a depth of 1 in the view's camera.
    pub directions: Tensor<4>,
    /// Depths of the anchors `[1, h, w, 1]`, metres.
    pub depths: Tensor<4>,
    /// Centre of the camera in the front camera's frame `[1, 1, 1, 3]`, metres.
    pub centre: Tensor<4>,
    /// Where the camera looks, likewise.
    pub forward: Tensor<4>,
}

impl Rays {
    pub(super) fn new(view: View, pair_degrees: f64, side: usize, window: &Window, device: &Device) -> Self {
        let (camera, from_front) = nominal(view, pair_degrees, side);
        let to_front = from_front.inverse();
        let centre = camera.centre();
        // The axis is the world's y; towards the camera, level.
        let normal = camera.world_to_camera.rotation * DVec3::new(centre.x, 0.0, centre.z).normalize();
        let away = normal.dot(camera.world_to_camera.translation);
        let (h, w) = (window.rows.len(), window.columns.len());
        let (mut directions, mut depths) = (Vec::with_capacity(3 * h * w), Vec::with_capacity(h * w));
        for row in window.rows.clone() {
            for column in window.columns.clone() {
                let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                let ray = ((pixel - camera.principal_point) / camera.focal).extend(1.0);
                directions.extend((to_front.rotation * ray).to_array().map(|v| v as f32));
                depths.push((away / normal.dot(ray)) as f32);
            }
        }
        let tensor =
            |values: Vec<f32>, dims: [usize; 4]| Tensor::from_data(TensorData::new(values, dims), device);
        let vector = |v: DVec3| tensor(v.to_array().map(|v| v as f32).to_vec(), [1, 1, 1, 3]);
        let (centre, forward) = (vector(to_front.translation), vector(to_front.rotation * DVec3::Z));
        Self {
            directions: tensor(directions, [1, h, w, 3]),
            depths: tensor(depths, [1, h, w, 1]),
            centre,
            forward,
        }
    }
}

/// The anchors of a view's pixels in a window of a canvas of `side`² pixels, `[1, h, w, 3]` metres, front camera's frame. The second
/// photograph was taken `pair_degrees` around the person from the first.
pub fn anchors(view: View, pair_degrees: f64, side: usize, window: &Window, device: &Device) -> Tensor<4> {
    let Rays { directions, depths, centre, .. } = Rays::new(view, pair_degrees, side, window, device);
    directions * depths + centre
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A point on the axis is its own anchor in every view, and anchors project where their pixels are.
    #[test]
    fn anchors_lie_on_their_rays_and_on_the_planes_through_the_axis() {
        let (side, device) = (64, Device::flex());
        let front = Camera::orbit_at_yaw_degrees(0.0, side as u32);
        let slanted = DVec3::new(72_f64.to_radians().sin(), 0.0, 72_f64.to_radians().cos());
        for (view, yaw, normal) in [
            (View::Front, 0.0, DVec3::Z),
            (View::Back, 180.0, DVec3::Z),
            (View::Back, 72.0, slanted),
            (View::Right, 90.0, DVec3::X),
            (View::Left, 270.0, DVec3::X),
        ] {
            let window = Window { rows: 8..56, columns: 16..40 };
            let values: Vec<f32> =
                anchors(view, yaw, side, &window, &device).into_data().try_into_vec().expect("f32");
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
