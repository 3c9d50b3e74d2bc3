//! Rectified points: those of an upright person whom the nominal cameras would photograph alike (docs/method.md, "Upright targets"). A photograph does not show its camera's elevation and distance. What it shows, together with
//! knowledge about people, is how far in front of the body's axis a pixel's surface is. Each point therefore keeps its distance ahead
//! of the axis, and moves to the nominal camera's ray of its pixel.

use glam::{DMat3, DVec2, DVec3};
use snapsnap_splat::{Camera, Orbit, RigidTransform};

use super::place::{LOOKUPS, Seen, centres, scale_of};
use crate::dataset::StoredView;
use crate::photo::{Mapping, on_plane};

/// A photograph's camera and the nominal one.
struct Seat {
    camera: Camera,
    /// From the photograph's pixels to the nominal camera's.
    mapping: Mapping,
    nominal: Camera,
}

/// Moves points between the world and the nominal cameras'. Both have the origin of the subject, y up, and the front camera above +z.
pub(super) struct Rectification {
    /// Front and back.
    seats: [Seat; 2],
    /// Distances ahead of the axis in metres per rectified metre.
    scale: f64,
    /// From the data set's world to one whose front camera is above +z.
    turn: RigidTransform,
}

impl Rectification {
    /// Of the photographs of front and back.
    pub(super) fn new(cameras: [&Camera; 2], mappings: [Mapping; 2]) -> Self {
        let backward = -cameras[0].world_to_camera.rotation.row(2);
        let rotation = DMat3::from_rotation_y(-backward.x.atan2(backward.z));
        let turn = RigidTransform { rotation, translation: DVec3::ZERO };
        let scale = scale_of(&mappings[0], cameras[0]);
        let seats = [0, 1].map(|i| Seat {
            camera: turned(cameras[i], &turn),
            mapping: mappings[i],
            nominal: Camera::orbit_at_yaw_degrees([0.0, 180.0][i], cameras[i].width),
        });
        Self { seats, scale, turn }
    }

    /// The photograph whose pixels a point belongs to: 0 is the front.
    fn nearer(point: DVec3) -> usize {
        usize::from(point.z < Orbit::default().centre.z)
    }

    /// The rectified place of a point of the turned world.
    fn rectify(&self, photograph: usize, point: DVec3) -> Option<DVec3> {
        let Seat { camera, mapping, nominal } = &self.seats[photograph];
        on_plane(nominal, mapping.canvas(camera.project(point)?.0), point.z / self.scale)
    }

    /// The place in the turned world of a rectified point.
    fn restore(&self, photograph: usize, point: DVec3) -> Option<DVec3> {
        let Seat { camera, mapping, nominal } = &self.seats[photograph];
        on_plane(camera, mapping.source(nominal.project(point)?.0), point.z * self.scale)
    }

    /// Rectified points of a photograph's canvas, in the nominal front camera's frame.
    pub(super) fn photographed(&self, view: &StoredView, photograph: usize) -> Seen {
        let Seat { camera, mapping, nominal } = &self.seats[photograph];
        let to_world = camera.world_to_camera.inverse();
        let seen = |place: DVec2| {
            let point = to_world.apply(view.point(mapping.source(place))?);
            self.rectify(photograph, point).map(|p| self.to_front(p))
        };
        centres(nominal.width).map(seen).collect()
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
            self.rectify(Self::nearer(point), point).map(|p| to_side.apply(p))
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
                let there = self.restore(Self::nearer(there), there)?;
                found = rectified(camera.project(there)?.0)?;
            }
            Some(self.to_front(from_side.apply(found)))
        };
        centres(view.camera.width).map(seen).collect()
    }

    fn to_front(&self, point: DVec3) -> DVec3 {
        self.seats[0].nominal.world_to_camera.apply(point)
    }
}

/// The camera in the turned world.
fn turned(camera: &Camera, turn: &RigidTransform) -> Camera {
    Camera { world_to_camera: turn.inverse().then(&camera.world_to_camera), ..*camera }
}
