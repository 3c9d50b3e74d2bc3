//! The person where the photographs' own cameras saw it (docs/method.md, "Upright targets" and "Cameras of a user"). The networks see an
//! upright person in the nominal cameras' canvases. A pixel, with what is known about people, shows how far in front of the body's axis
//! its surface lies. Each point therefore keeps its distance ahead of the axis, and moves from the ray of its canvas's camera to the ray
//! of the real camera.

use burn::tensor::{Tensor, TensorData};
use glam::{DMat3, DVec3};
use snapsnap_net::gaussians::Origin;
use snapsnap_net::network::View;
use snapsnap_splat::{Camera, Gaussians, Orbit, RigidTransform, affine};

use crate::placing::Mapping;
use crate::planes::PlaneMap;
use crate::shot::Viewpoint;

/// z of the body's axis, in metres.
pub const AXIS: f64 = 0.0;

/// The nominal camera of the front (0) or the back (1) on a canvas of `side` pixels. World: y up, the front camera above +z.
pub fn nominal(photograph: usize, side: u32) -> Camera {
    Camera::orbit_at_yaw_degrees([0.0, 180.0][photograph], side)
}

/// Scale of a camera's points relative to a nominal camera's, if `mapping` maps its photograph to the canvas of `side` pixels. It is the
/// ratio of the distances from the body's axis times the ratio of the pixel sizes.
fn scale_of(mapping: &Mapping, camera: &Camera, side: u32) -> f64 {
    let nominal = Orbit::default();
    let distance = camera.world_to_camera.apply(nominal.centre).z / nominal.radius;
    distance * nominal.focal * f64::from(side) / camera.focal.y / mapping.scale.y
}

/// Moves people from the rays of their canvases' cameras to those of the cameras that photographed them.
#[derive(Debug, Clone)]
pub struct Restoration {
    /// Of front and back, in the turned world.
    pub maps: [PlaneMap; 2],
    /// The photographed person's size over the size of the points.
    pub scale: f64,
    /// The camera in whose frame the restored person is, in the cameras' world. It has the nominal elevation.
    pub front: Camera,
}

impl Restoration {
    /// For known cameras of front and back, whose pixels `mappings` map to canvases of `side` pixels.
    pub fn to_cameras(cameras: [&Camera; 2], mappings: [&Mapping; 2], side: u32) -> Self {
        let turn = turn_to_front(cameras[0]);
        let scale = scale_of(mappings[0], cameras[0], side);
        let map = |i: usize| {
            PlaneMap::new(&nominal(i, side), &turned(cameras[i], &turn), &mappings[i].inverse(), scale)
        };
        let mut front = turned(&nominal(0, side), &turn.inverse());
        front.world_to_camera.translation *= scale;
        Self { maps: [0, 1].map(map), scale, front }
    }

    /// For cameras that stand at these viewpoints, with a lens that shows the person at the same size.
    pub fn to_viewpoints(viewpoints: [Viewpoint; 2]) -> Self {
        // Its number does not matter.
        const SIDE: u32 = 1024;
        let map = |i: usize| {
            let real = viewpoints[i].camera([0.0, 180.0][i], SIDE);
            PlaneMap::new(&nominal(i, SIDE), &real, &Mapping::AS_IT_IS, 1.0)
        };
        Self { maps: [0, 1].map(map), scale: 1.0, front: nominal(0, SIDE) }
    }

    /// The person where the cameras saw it, from the nominal front camera's frame to the frame of [`Self::front`], metres. Gaussians of photographed pixels belong to their photograph, the others
    /// to the photograph that shows their half of the body. Gaussians that a camera does not see stay.
    pub fn person(&self, gaussians: Gaussians, origins: &[Origin]) -> Gaussians {
        let to_camera = nominal(0, self.front.width).world_to_camera;
        let to_world = to_camera.inverse();
        let world = affine(gaussians.means, &to_world.rotation, to_world.translation);
        // Farther from the axis than any point, so that a point's own z decides for the others alone.
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

/// From a world to one whose front camera is above +z.
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

    use super::*;

    /// Means of people whose cameras stand at `viewpoints`, world. `origins` are those of the points.
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
        // A level camera far away sees heights as they are: the nominal one's picture of a point is a lower one there.
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

    /// A pixel of the back belongs to the back's camera, also in front of the axis, where a pixel of a side belongs to the front's.
    #[test]
    fn pixels_belong_to_the_cameras_that_saw_them() {
        let low = Viewpoint { elevation: -5.0, distance: 2.0 };
        let point = [DVec3::new(0.1, 1.5, 0.05)];
        let [front, back, side] =
            [View::Front, View::Back, View::Right].map(|view| restored(low, &point, Some(view))[0]);
        assert!(side.abs_diff_eq(front, 1e-9) && back.distance(front) > 5e-3, "{front} {back} {side}");
    }
}
