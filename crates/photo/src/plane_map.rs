//! Moves points from the rays of one camera to the rays of another, at the same distance in front of the body's axis.

use burn::tensor::Tensor;
use glam::{DMat3, DVec3};
use snapsnap_splat::{Camera, RigidTransform, affine};

use crate::placing::Mapping;

/// Least distance in metres in front of the first camera and, along z, from the second. Nearer points do not move.
const NEAREST: f64 = 1e-3;

/// Moves a point from its ray of one camera to the ray of the corresponding pixel of another camera, and multiplies
/// its z by `scale`. Both cameras are on the same side of the plane z = 0 and look towards it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneMap {
    /// The second camera's ray of a point p is `matrix`·p + `offset`, as long as p is far from the first camera.
    matrix: DMat3,
    offset: DVec3,
    /// The second camera's centre, and where it looks.
    eye: DVec3,
    forward: DVec3,
    scale: f64,
}

impl PlaneMap {
    /// `pixels` maps pixels of `from` to pixels of `to`.
    pub fn new(from: &Camera, to: &Camera, pixels: &Mapping, scale: f64) -> Self {
        // Homogeneous pixels of `from`, then of `to`, then rays of `to`.
        let offset = (pixels.origin + pixels.scale * from.principal_point - to.principal_point) / to.focal;
        let focal = pixels.scale * from.focal / to.focal;
        let lens = DMat3::from_cols(DVec3::X * focal.x, DVec3::Y * focal.y, offset.extend(1.0));
        let turn = to.world_to_camera.rotation.transpose() * lens;
        let RigidTransform { rotation, translation } = from.world_to_camera;
        let forward = to.world_to_camera.rotation.row(2);
        Self { matrix: turn * rotation, offset: turn * translation, eye: to.centre(), forward, scale }
    }

    /// The moved point; `None` if it is not in front of both cameras.
    pub fn apply(&self, point: DVec3) -> Option<DVec3> {
        let ray = self.matrix * point + self.offset;
        let towards = -self.eye.z.signum() * ray.z;
        let along = (self.scale * point.z - self.eye.z) / ray.z;
        let is_seen = self.forward.dot(ray) > NEAREST && towards > NEAREST && along > 0.0;
        is_seen.then(|| self.eye + along * ray)
    }

    /// [`Self::apply`] of `points` `[N,3]`. Points without a result stay.
    pub fn apply_all(&self, points: &Tensor<2>) -> Tensor<2> {
        let row = |v: DVec3| Tensor::<2>::from_floats([v.as_vec3().to_array()], &points.device());
        let ray = affine(points.clone(), &self.matrix, self.offset);
        let (z, ray_z) = (points.clone().narrow(1, 2, 1), ray.clone().narrow(1, 2, 1));
        let is_seen = (ray.clone() * row(self.forward)).sum_dim(1).greater_elem(NEAREST);
        let is_seen = is_seen.bool_and((ray_z.clone() * -self.eye.z.signum()).greater_elem(NEAREST));
        // A division by zero would spoil the gradients.
        let along = (z * self.scale - self.eye.z) / ray_z.mask_fill(is_seen.clone().bool_not(), 1.0);
        let is_seen = is_seen.bool_and(along.clone().greater_elem(0.0)).repeat_dim(1, 3);
        points.clone().mask_where(is_seen, along * ray + row(self.eye))
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use glam::DVec2;

    use super::*;

    #[test]
    fn moved_points_are_seen_at_the_other_cameras_pixel() {
        let from = Camera::orbit_at_yaw_degrees(0.0, 64);
        let to = snapsnap_splat::Orbit { pitch_degrees: -5.0, radius: 3.0, focal: 1.1, ..Default::default() }
            .camera(96);
        let pixels = Mapping { scale: DVec2::new(1.5, 1.4), origin: DVec2::new(3.0, -2.0) };
        let (point, behind) = (DVec3::new(0.2, 1.4, 0.1), DVec3::new(0.0, 1.0, 5.0));
        let map = PlaneMap::new(&from, &to, &pixels, 1.2);
        let moved = map.apply(point).expect("in front");
        let [before, after] =
            [(&from, point), (&to, moved)].map(|(camera, p)| camera.project(p).expect("in front").0);
        assert!(pixels.canvas(before).abs_diff_eq(after, 1e-9), "{before} {after}");
        assert!((moved.z - 1.2 * point.z).abs() < 1e-12);
        let all = Tensor::from_floats([point, behind].map(|p| p.as_vec3().to_array()), &Device::flex());
        let all = map.apply_all(&all).into_data().try_to_vec::<f32>().expect("f32");
        let expected = [moved, behind].map(|p| p.as_vec3().to_array());
        all.iter().zip(expected.as_flattened()).for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "{all:?}"));
        let back = PlaneMap::new(&to, &from, &pixels.inverse(), 1.0 / 1.2).apply(moved);
        assert!(back.expect("in front").abs_diff_eq(point, 1e-12));
        for lost in [behind, DVec3::splat(f64::NAN)] {
            assert_eq!(map.apply(lost), None);
        }
    }
}
