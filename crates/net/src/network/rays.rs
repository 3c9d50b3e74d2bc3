//! Rays of the pixels of nominal cameras. Anchors, the points that the network corrects, lie on them
//! (docs/method.md, "Ray anchors"), and so do the points of photographs: across the line of sight, rays are more
//! accurate than predictions.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DVec2, DVec3};
use snapsnap_splat::Camera;

use super::View;
use crate::window::Window;

/// Yaw of a view's nominal camera in degrees; `pair_degrees` for the second photograph.
fn yaw(view: View, pair_degrees: f64) -> f64 {
    match view {
        View::Front => 0.0,
        View::Right | View::RightSecond => 90.0,
        View::Back => pair_degrees,
        View::Left | View::LeftSecond => 270.0,
    }
}

/// A view's nominal camera of a canvas of `side`² pixels. Its world is the front camera's frame.
pub(crate) fn nominal_camera(view: View, pair_degrees: f64, side: usize) -> Camera {
    let [front, camera] =
        [0.0, yaw(view, pair_degrees)].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, side as u32));
    let world_to_camera = front.world_to_camera.inverse().then(&camera.world_to_camera);
    Camera { world_to_camera, ..camera }
}

/// Width in metres of a pixel of the nominal cameras at the person's distance, on a canvas of `side`² pixels.
pub fn pixel_width(side: usize) -> f32 {
    let nominal = Camera::orbit_at_yaw_degrees(0.0, side as u32);
    ((nominal.centre() * DVec3::new(1.0, 0.0, 1.0)).length() / nominal.focal.x) as f32
}

/// The rays of a view's pixels in a window of a canvas of `side`² pixels.
pub(super) struct Rays {
    /// Directions in the front camera's frame `[1, h, w, 3]`, scaled to a depth of 1 in the view's camera.
    pub directions: Tensor<4>,
    /// Depths of the anchors `[1, h, w, 1]`, metres.
    pub depths: Tensor<4>,
    /// Centre of the camera in the front camera's frame `[1, 1, 1, 3]`, metres.
    pub centre: Tensor<4>,
    /// Viewing direction of the camera in the front camera's frame `[1, 1, 1, 3]`.
    pub forward: Tensor<4>,
}

impl Rays {
    pub(super) fn new(view: View, pair_degrees: f64, side: usize, window: &Window, device: &Device) -> Self {
        let camera = Camera::orbit_at_yaw_degrees(yaw(view, pair_degrees), side as u32);
        let to_front = nominal_camera(view, pair_degrees, side).world_to_camera.inverse();
        let centre = camera.centre();
        // The plane's normal: horizontal (the world's y is up), towards the camera.
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

    /// Where the rays meet the plane through the body's axis: `[1, h, w, 3]` metres, front camera's frame.
    pub(super) fn anchors(&self) -> Tensor<4> {
        self.directions.clone() * self.depths.clone() + self.centre.clone()
    }
}

/// The anchors of a view's pixels in a window of a canvas of `side`² pixels, `[1, h, w, 3]` metres, front camera's
/// frame. The second photograph was taken `pair_degrees` around the person from the first.
pub fn anchors(view: View, pair_degrees: f64, side: usize, window: &Window, device: &Device) -> Tensor<4> {
    Rays::new(view, pair_degrees, side, window, device).anchors()
}

/// Moves points `[B, h, w, 3]` of a photograph's `window` of a canvas of `side`² pixels, metres in the front camera's
/// frame, onto their pixels' rays and keeps their depths. The second camera stands `pair_degrees` around the person
/// from the front camera. Exactly these cameras see upright people (docs/method.md, "Upright targets").
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
    use snapsnap_ops::host;

    use super::*;

    /// Anchors and moved points project to their pixels. Anchors lie on the planes through the axis. Moved points
    /// keep their depths.
    #[test]
    fn anchors_and_moved_points_lie_on_the_rays_of_their_pixels() {
        let (side, device) = (64, Device::flex());
        let window = Window { rows: 8..56, columns: 16..40 };
        let to_world = Camera::orbit_at_yaw_degrees(0.0, side as u32).world_to_camera.inverse();
        let slanted = DVec3::new(72_f64.to_radians().sin(), 0.0, 72_f64.to_radians().cos());
        for (view, yaw, normal) in [
            (View::Front, 0.0, DVec3::Z),
            (View::Back, 180.0, DVec3::Z),
            (View::Back, 72.0, slanted),
            (View::Right, 90.0, DVec3::X),
            (View::Left, 270.0, DVec3::X),
        ] {
            let camera = Camera::orbit_at_yaw_degrees(yaw, side as u32);
            let to_view = to_world.then(&camera.world_to_camera);
            let depth = |i: usize| 1.5 + 0.001 * i as f64;
            let beside =
                |i: usize| to_view.inverse().apply(DVec3::new(0.3, -0.2, depth(i))).as_vec3().to_array();
            let given: Vec<f32> = (0..48 * 24).flat_map(beside).collect();
            let given = Tensor::<4>::from_data(TensorData::new(given, [1, 48, 24, 3]), &device);
            let moved = host(on_rays(view, yaw, side, &window, given));
            let anchors = host(anchors(view, yaw, side, &window, &device));
            let both = moved.as_chunks::<3>().0.iter().zip(anchors.as_chunks::<3>().0);
            for (i, (moved, anchor)) in both.enumerate() {
                let [moved, anchor] = [moved, anchor].map(|p| DVec3::from(p.map(f64::from)));
                assert!((to_view.apply(moved).z - depth(i)).abs() < 2e-6, "{view:?} {i}: {moved}");
                assert!(to_world.apply(anchor).dot(normal).abs() < 1e-5, "{view:?} {i}: {anchor}");
                let expected = DVec2::new(16.5 + (i % 24) as f64, 8.5 + (i / 24) as f64);
                for point in [moved, anchor] {
                    let (pixel, _) = camera.project(to_world.apply(point)).expect("in front");
                    assert!((pixel - expected).length() < 1e-4, "{view:?} {i}: {pixel}");
                }
            }
        }
    }
}
