//! Restores a person to the real cameras (docs/method.md, "Upright targets" and "Cameras of a user"). The networks see
//! an upright person in the nominal cameras, and estimate from a pixel how far in front of the body's axis its surface
//! lies. Each point keeps this distance and moves from the ray of the nominal camera to the ray of the real camera: a
//! [`PlaneMap`] moves points from the rays of one camera to the rays of another.

use burn::tensor::{Tensor, TensorData};
use glam::{DMat3, DVec3};
use snapsnap_net::network::View;
use snapsnap_net::painter::Origin;
use snapsnap_splat::{Camera, Gaussians, Orbit, RigidTransform, affine};

use crate::exif_camera::Viewpoint;
use crate::placing::Mapping;

/// z of the body's axis, in metres.
pub const AXIS: f64 = 0.0;

/// The nominal camera of the front (0) or back (1) on a canvas of `side` pixels. World: y up, front camera above +z.
pub fn nominal(photograph: usize, side: u32) -> Camera {
    Camera::orbit_at_yaw_degrees([0.0, 180.0][photograph], side)
}

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

/// Moves people from the rays of the nominal cameras to the rays of the real cameras.
#[derive(Debug, Clone)]
pub struct Restoration {
    /// The maps of front and back, in the turned world ([`turn_to_front`]).
    pub maps: [PlaneMap; 2],
    /// The photographed person's size over the size of the points.
    pub scale: f64,
    /// The camera in whose frame the restored person is, in the real cameras' world. It has the nominal elevation.
    pub front: Camera,
}

impl Restoration {
    /// For known cameras of front and back, whose pixels `mappings` map to canvases of `side` pixels.
    pub fn to_cameras(cameras: [&Camera; 2], mappings: [&Mapping; 2], side: u32) -> Self {
        let turn = turn_to_front(cameras[0]);
        // The ratio of the distances from the body's axis times the ratio of the pixel sizes.
        let Orbit { centre, radius, focal, .. } = Orbit::default();
        let distance = cameras[0].world_to_camera.apply(centre).z / radius;
        let scale = distance * focal * f64::from(side) / cameras[0].focal.y / mappings[0].scale.y;
        let map = |i: usize| {
            PlaneMap::new(&nominal(i, side), &turned(cameras[i], &turn), &mappings[i].inverse(), scale)
        };
        let mut front = turned(&nominal(0, side), &turn.inverse());
        front.world_to_camera.translation *= scale;
        Self { maps: [0, 1].map(map), scale, front }
    }

    /// For cameras that stand at these viewpoints, with a lens that shows the person at the same size.
    pub fn to_viewpoints(viewpoints: [Viewpoint; 2]) -> Self {
        // Every side gives the same maps.
        const SIDE: u32 = 1024;
        let map = |i: usize| {
            let real = viewpoints[i].camera([0.0, 180.0][i], SIDE);
            PlaneMap::new(&nominal(i, SIDE), &real, &Mapping::AS_IT_IS, 1.0)
        };
        Self { maps: [0, 1].map(map), scale: 1.0, front: nominal(0, SIDE) }
    }

    /// Restores a person, from the nominal front camera's frame to the frame of [`Self::front`]. Photographed Gaussians
    /// belong to their photograph, others to the photograph of their half of the body. Unseen Gaussians stay.
    pub fn person(&self, gaussians: Gaussians, origins: &[Origin]) -> Gaussians {
        let to_camera = nominal(0, self.front.width).world_to_camera;
        let to_world = to_camera.inverse();
        let world = affine(gaussians.means, &to_world.rotation, to_world.translation);
        // Photographed pixels get a number beyond every z, so that the point's own z decides for other pixels alone.
        let sign = |origin: &Origin| match origin.view {
            Some(View::Front) => f32::MAX,
            Some(View::Back) => f32::MIN,
            _ => 0.0,
        };
        let signs = TensorData::new(origins.iter().map(sign).collect::<Vec<_>>(), [origins.len(), 1]);
        let ahead = world.clone().narrow(1, 2, 1) + Tensor::from_data(signs, &world.device());
        let is_back = ahead.lower_elem(AXIS).repeat_dim(1, 3);
        let [front, back] = self.maps.map(|map| map.apply_all(&world));
        let restored = front.mask_where(is_back, back) / self.scale;
        let means = affine(restored, &to_camera.rotation, to_camera.translation);
        Gaussians { means, ..gaussians }.scaled(self.scale)
    }
}

/// The turn about y that brings the front camera above +z.
pub fn turn_to_front(front: &Camera) -> RigidTransform {
    let backward = -front.world_to_camera.rotation.row(2);
    let rotation = DMat3::from_rotation_y(-backward.x.atan2(backward.z));
    RigidTransform { rotation, translation: DVec3::ZERO }
}

/// The camera in the turned world.
pub fn turned(camera: &Camera, turn: &RigidTransform) -> Camera {
    Camera { world_to_camera: turn.inverse().then(&camera.world_to_camera), ..*camera }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use glam::DVec2;

    use super::*;

    #[test]
    fn moved_points_are_seen_at_the_other_cameras_pixel() {
        let from = Camera::orbit_at_yaw_degrees(0.0, 64);
        let to = Orbit { pitch_degrees: -5.0, radius: 3.0, focal: 1.1, ..Default::default() }.camera(96);
        let pixels = Mapping { scale: DVec2::new(1.5, 1.4), origin: DVec2::new(3.0, -2.0) };
        let (point, behind) = (DVec3::new(0.2, 1.4, 0.1), DVec3::new(0.0, 1.0, 5.0));
        let map = PlaneMap::new(&from, &to, &pixels, 1.2);
        let moved = map.apply(point).expect("in front");
        let [before, after] =
            [(&from, point), (&to, moved)].map(|(camera, p)| camera.project(p).expect("in front").0);
        assert!(pixels.source(after).abs_diff_eq(before, 1e-9), "{before} {after}");
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

    /// World points of pixels of `view`, restored to cameras that both stand at `viewpoint`.
    fn restored(viewpoint: Viewpoint, points: &[DVec3], view: Option<View>) -> Vec<DVec3> {
        let device = Device::flex();
        let to_front = nominal(0, 1024).world_to_camera;
        let means: Vec<f32> = points.iter().flat_map(|p| to_front.apply(*p).as_vec3().to_array()).collect();
        let n = points.len();
        let means = Tensor::from_data(TensorData::new(means, [n, 3]), &device);
        let ones = |columns: usize| Tensor::<2>::ones([n, columns], &device);
        let gaussians = Gaussians::new(means, ones(4), ones(3), Tensor::ones([n], &device), ones(3));
        let restoration = Restoration::to_viewpoints([viewpoint; 2]);
        let person = restoration.person(gaussians.expect("fits"), &vec![Origin { view, pixel: 0 }; n]);
        let back = restoration.front.world_to_camera.inverse();
        let means = person.means.into_data().try_into_vec::<f32>().expect("f32");
        means.as_chunks().0.iter().map(|p: &[f32; 3]| back.apply(DVec3::from(p.map(f64::from)))).collect()
    }

    #[test]
    fn known_cameras_move_points_along_their_planes() {
        let point = DVec3::new(0.2, 1.5, 0.12);
        let opposite = DVec3::new(-point.x, point.y, -point.z);
        let same = restored(Viewpoint::default(), &[point, opposite], None);
        assert!(same[0].abs_diff_eq(point, 1e-6) && same[1].abs_diff_eq(opposite, 1e-6), "{same:?}");
        // A level camera far away sees heights as they are. The nominal camera's picture of a point is lower there.
        let level = Viewpoint { elevation: 0.0, distance: 1e3 };
        let (place, _) = nominal(0, 1024).project(point).expect("in front");
        let expected = (537.0 - place.y) * 2.0 / (0.8 * 1024.0) + 0.85;
        let moved = restored(level, &[point, opposite], None);
        // Half a unit of f32 at the camera's distance.
        const ROUNDING: f64 = 6e-5;
        assert!((moved[0].z - point.z).abs() < ROUNDING && (moved[0].y - expected).abs() < 1e-3, "{moved:?}");
        // The back's camera is the front's, turned.
        let turned = DVec3::new(-moved[0].x, moved[0].y, -moved[0].z);
        assert!(moved[1].abs_diff_eq(turned, ROUNDING), "{moved:?}");
    }

    /// A back pixel belongs to the back's camera, even in front of the axis; a side pixel there to the front's camera.
    #[test]
    fn pixels_belong_to_the_cameras_that_saw_them() {
        let low = Viewpoint { elevation: -5.0, distance: 2.0 };
        let point = [DVec3::new(0.1, 1.5, 0.05)];
        let [front, back, side] =
            [View::Front, View::Back, View::Right].map(|view| restored(low, &point, Some(view))[0]);
        assert!(side.abs_diff_eq(front, 1e-9) && back.distance(front) > 5e-3, "{front} {back} {side}");
    }
}
