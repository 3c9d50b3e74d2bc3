//! Baselines of an evaluation: flat cut-outs and ground-truth points (docs/method.md, "Evaluation").

use burn::tensor::Device;
use glam::{DVec2, DVec3};
use snapsnap_net::config::Config;
use snapsnap_net::network::View;
use snapsnap_net::painter::{CanvasView, geometric, side_images};
use snapsnap_net::placed;
use snapsnap_splat::{Camera, Gaussians};

/// Gaussians (world frame) of photographs `[3,S,S]` in [−1, 1] as flat cut-outs. Each cut-out stands in the upright
/// plane through the body's axis that faces its camera. `valid` `[S,S]` are the person's masks.
pub fn billboard(
    photographs: &[Vec<f32>],
    valid: &[Vec<bool>],
    side: usize,
    cameras: &[Camera],
    device: &Device,
) -> Gaussians {
    let part = |((image, valid), camera): ((&Vec<f32>, &Vec<bool>), &Camera)| {
        let points = &upright(camera, side);
        in_world(geometric(&[CanvasView { view: View::Front, image, points, valid }], side, device), camera)
    };
    Gaussians::joined(&photographs.iter().zip(valid).zip(cameras).map(part).collect::<Vec<_>>())
}

/// Points at which the pixel rays of a camera meet the upright plane through the world's y axis that faces the camera:
/// `[S,S,3]` metres in the camera's frame.
fn upright(camera: &Camera, side: usize) -> Vec<f32> {
    let camera = camera.resized(side as u32, side as u32);
    let centre = camera.centre();
    let facing = camera.world_to_camera.rotation * DVec3::new(centre.x, 0.0, centre.z).normalize_or(DVec3::Z);
    let from_axis = facing.dot(camera.world_to_camera.translation);
    let point = |pixel: usize| {
        let at = DVec2::new((pixel % side) as f64, (pixel / side) as f64) + 0.5;
        let ray = ((at - camera.principal_point) / camera.focal).extend(1.0);
        (from_axis / facing.dot(ray) * ray).as_vec3().to_array()
    };
    (0..side * side).flat_map(point).collect()
}

/// Gaussians (world frame) at ground-truth points `[V,S,S,3]` (metres, first camera's frame) with the masks `valid`
/// `[S,S]`. The first views have the colours of their photographs `[3,S,S]` in [−1, 1]. Further views are sides with
/// the colours of the nearest points.
pub fn true_points(
    photographs: &[Vec<f32>],
    points: &[f32],
    valid: &[Vec<bool>],
    side: usize,
    camera: &Camera,
    device: &Device,
) -> Gaussians {
    let sides = match (photographs, valid.len()) {
        ([front, back], 4) => side_images([front, back], points, valid, false),
        _ => Vec::new(),
    };
    // The points of all views are in the first camera's frame.
    let seen = |((image, valid), points)| CanvasView { view: View::Front, image, points, valid };
    let images = photographs.iter().chain(&sides).map(Vec::as_slice);
    let with_masks = images.zip(valid.iter().map(Vec::as_slice));
    let views: Vec<CanvasView> = with_masks.zip(points.chunks_exact(3 * side * side)).map(seen).collect();
    in_world(geometric(&views, side, device), camera)
}

fn in_world(gaussians: Gaussians, camera: &Camera) -> Gaussians {
    placed(&Config::default(), gaussians, &camera.world_to_camera.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use snapsnap_splat::Orbit;

    /// Points of a cut-out lie in a plane through the body's axis and project to the centres of their pixels.
    #[test]
    fn a_cut_out_is_upright_for_any_camera() {
        let orbit =
            Orbit { radius: 2.7, yaw_degrees: 70.0, pitch_degrees: -4.0, focal: 0.9, ..Orbit::default() };
        let camera = orbit.camera(64);
        let points = upright(&camera, 32);
        let (small, to_world) = (camera.resized(32, 32), camera.world_to_camera.inverse());
        let facing = camera.centre() * DVec3::new(1.0, 0.0, 1.0);
        for (pixel, point) in points.as_chunks::<3>().0.iter().enumerate() {
            let world = to_world.apply(DVec3::from(point.map(f64::from)));
            assert!(world.dot(facing).abs() < 1e-5, "pixel {pixel}: {world}");
            let (at, depth) = small.project(world).expect("in front");
            let expected = DVec2::new((pixel % 32) as f64, (pixel / 32) as f64) + 0.5;
            assert!((at - expected).length() < 1e-4 && depth > 2.0, "pixel {pixel}: {at}, {depth} m");
        }
    }
}
