//! A stored view, and the points of its depth map.

use glam::DVec3;
use image::{GrayImage, RgbImage};
use snapsnap_splat::Camera;

/// One stored view.
#[derive(Debug, Clone)]
pub struct StoredView {
    /// `[H,W]` colours, undefined where the mask is 0.
    pub color: RgbImage,
    /// `[H,W]` coverage.
    pub mask: GrayImage,
    /// `[H,W]` metres along the optical axis; 0 for the background.
    pub depth: Vec<f32>,
    /// The stored camera, in the pixel coordinates of [`super::Description::pixel_centre`].
    pub camera: Camera,
}

/// Points `[H,W,3]` of a depth map in the frame of `to`, in metres. A pixel's ray passes through its centre, at +½ in
/// the coordinates of `camera`. The background has the depth `far`.
pub fn unproject(view: &StoredView, camera: &Camera, to: &Camera, far: f32) -> Vec<f32> {
    let width = camera.width as usize;
    let there = camera.world_to_camera.inverse().then(&to.world_to_camera);
    let (f, c) = (camera.focal, camera.principal_point);
    let mut points = Vec::with_capacity(3 * view.depth.len());
    for (pixel, z) in view.depth.iter().enumerate() {
        let z = f64::from(if *z > 0.0 { *z } else { far });
        let (x, y) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let point = there.apply(z * DVec3::new((x - c.x) / f.x, (y - c.y) / f.y, 1.0));
        points.extend(point.as_vec3().to_array());
    }
    points
}
