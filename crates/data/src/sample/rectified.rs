//! Rectified points: those of an upright person whom the nominal cameras would photograph alike (docs/method.md, "Upright targets"). A
//! photograph does not show its camera's elevation and distance. A pixel, with knowledge about people, shows how far in front of the
//! body's axis its surface lies. Each point therefore keeps its distance ahead of the axis, and moves to the nominal camera's ray of
//! its pixel.

use burn::tensor::Tensor;
use glam::{DMat3, DVec2, DVec3};
use snapsnap_splat::{Camera, Gaussians, RigidTransform, affine};

use super::place::{LOOKUPS, Seen, centres, scale_of};
use crate::dataset::StoredView;
use crate::photo::{Mapping, PlaneMap};

/// Moves people from the nominal cameras' rays to those of the cameras that photographed them. Both must be known.
#[derive(Debug, Clone)]
pub struct Restoration {
    /// Of front and back, from the nominal camera to the photograph's own in the turned world.
    maps: [PlaneMap; 2],
    /// The photographed person's size over the size of the points.
    pub scale: f64,
    /// The camera in whose frame the restored person is, in the data set's world. It has the nominal elevation.
    pub front: Camera,
}

impl Restoration {
    /// Of the photographs of front and back, whose pixels `mappings` map to their canvases.
    pub fn new(cameras: [&Camera; 2], mappings: [&Mapping; 2]) -> Self {
        let turn = turn(cameras[0]);
        let scale = scale_of(mappings[0], cameras[0]);
        let map = |i: usize| {
            let nominal = nominal(i, cameras[i].width);
            PlaneMap::new(&nominal, &turned(cameras[i], &turn), &mappings[i].inverse(), scale)
        };
        let mut front = turned(&nominal(0, cameras[0].width), &turn.inverse());
        front.world_to_camera.translation *= scale;
        Self { maps: [0, 1].map(map), scale, front }
    }

    /// The person where the cameras saw it. Means are in metres in the nominal front camera's frame, before and after. Times
    /// [`Self::scale`] they are in the frame of [`Self::front`]. The first Gaussians, `photographed`, are pixels of front and back. The
    /// others belong to the photograph that shows their half of the body. Gaussians that a camera does not see stay.
    pub fn person(&self, gaussians: Gaussians, photographed: [usize; 2]) -> Gaussians {
        let to_camera = nominal(0, self.front.width).world_to_camera;
        let to_world = to_camera.inverse();
        let world = affine(gaussians.means, &to_world.rotation, to_world.translation);
        let [front, back] = photographed;
        let rest = world.dims()[0] - front - back;
        let rows = |from, count| (count > 0).then(|| world.clone().narrow(0, from, count));
        let parts = [
            rows(0, front).map(|points| self.maps[0].apply_all(&points)),
            rows(front, back).map(|points| self.maps[1].apply_all(&points)),
            rows(front + back, rest).map(|points| {
                let is_back = points.clone().narrow(1, 2, 1).lower_elem(AXIS).repeat_dim(1, 3);
                self.maps[0].apply_all(&points).mask_where(is_back, self.maps[1].apply_all(&points))
            }),
        ];
        let restored = Tensor::cat(parts.into_iter().flatten().collect(), 0) / self.scale;
        let means = affine(restored, &to_camera.rotation, to_camera.translation);
        Gaussians { means, ..gaussians }
    }
}

/// Moves points between the world and the nominal cameras'. Both have the origin of the subject, y up, and the front camera above +z.
pub(super) struct Rectification {
    /// Of front and back: from the photograph's pixels to the nominal camera's.
    mappings: [Mapping; 2],
    /// Both photographs' cameras in the turned world.
    cameras: [Camera; 2],
    rectify: [PlaneMap; 2],
    restore: [PlaneMap; 2],
    /// From the data set's world to one whose front camera is above +z.
    turn: RigidTransform,
}

impl Rectification {
    /// Of the photographs of front and back, and the way back.
    pub(super) fn new(cameras: [&Camera; 2], mappings: [&Mapping; 2]) -> (Self, Restoration) {
        let restoration = Restoration::new(cameras, mappings);
        let turn = turn(cameras[0]);
        let cameras = cameras.map(|camera| turned(camera, &turn));
        let rectify = |i: usize| {
            PlaneMap::new(&cameras[i], &nominal(i, cameras[i].width), mappings[i], 1.0 / restoration.scale)
        };
        let rectification = Self {
            mappings: mappings.map(|mapping| *mapping),
            cameras,
            rectify: [0, 1].map(rectify),
            restore: restoration.maps,
            turn,
        };
        (rectification, restoration)
    }

    /// The photograph whose pixels a point belongs to: 0 is the front.
    fn nearer(point: DVec3) -> usize {
        usize::from(point.z < AXIS)
    }

    /// Rectified points of a photograph's canvas, in the nominal front camera's frame.
    pub(super) fn photographed(&self, view: &StoredView, photograph: usize) -> Seen {
        let to_world = self.cameras[photograph].world_to_camera.inverse();
        let seen = |place: DVec2| {
            let point = to_world.apply(view.point(self.mappings[photograph].source(place))?);
            self.rectify[photograph].apply(point).map(|p| self.to_front(p))
        };
        centres(self.cameras[photograph].width).map(seen).collect()
    }

    /// Rectified points of the nominal camera that stands `degrees` around the body's axis from the front's, in the nominal front
    /// camera's frame. `view` is the data set's view of that side.
    pub(super) fn of_side(&self, view: &StoredView, degrees: f64) -> Seen {
        let nominal = Camera::orbit_at_yaw_degrees(degrees, view.camera.width);
        let (to_side, from_side) = (nominal.world_to_camera, nominal.world_to_camera.inverse());
        let camera = turned(&view.camera, &self.turn);
        let to_world = camera.world_to_camera.inverse();
        let rectified = |pixel: DVec2| {
            let point = to_world.apply(view.point(pixel)?);
            self.rectify[Self::nearer(point)].apply(point).map(|p| to_side.apply(p))
        };
        let all = centres(view.camera.width).filter_map(rectified);
        let (sum, count) = all.fold((0.0, 0.0), |(sum, count), p| (sum + p.z, count + 1.0));
        if count == 0.0 {
            return vec![None; view.depth.len()];
        }
        let seen = |place: DVec2| {
            let ray = ((place - nominal.principal_point) / nominal.focal).extend(1.0);
            let mut found = DVec3::new(0.0, 0.0, sum / count);
            for _ in 0..LOOKUPS {
                let there = from_side.apply(found.z * ray);
                let there = self.restore[Self::nearer(there)].apply(there)?;
                found = rectified(camera.project(there)?.0)?;
            }
            Some(self.to_front(from_side.apply(found)))
        };
        centres(view.camera.width).map(seen).collect()
    }

    fn to_front(&self, point: DVec3) -> DVec3 {
        nominal(0, self.cameras[0].width).world_to_camera.apply(point)
    }
}

/// z of the body's axis.
const AXIS: f64 = 0.0;

/// The nominal camera of the front (0) or the back (1).
fn nominal(photograph: usize, side: u32) -> Camera {
    Camera::orbit_at_yaw_degrees([0.0, 180.0][photograph], side)
}

/// From the data set's world to one whose front camera is above +z.
fn turn(front: &Camera) -> RigidTransform {
    let backward = -front.world_to_camera.rotation.row(2);
    let rotation = DMat3::from_rotation_y(-backward.x.atan2(backward.z));
    RigidTransform { rotation, translation: DVec3::ZERO }
}

/// The camera in the turned world.
fn turned(camera: &Camera, turn: &RigidTransform) -> Camera {
    Camera { world_to_camera: turn.inverse().then(&camera.world_to_camera), ..*camera }
}
