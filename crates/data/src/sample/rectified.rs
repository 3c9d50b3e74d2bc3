//! Rectified points: the points of an upright person that the nominal cameras would see in the same pixels
//! (docs/method.md, "Upright targets"). A photograph does not show its camera's elevation and distance. It does show,
//! to a network that knows people, how far the surface lies in front of the body's axis. Each point therefore keeps its
//! distance in front of the axis, and moves onto the nominal camera's ray through its pixel.

use glam::{DVec2, DVec3};
use snapsnap_photo::{AXIS, Mapping, PlaneMap, Restoration, nominal, turn_to_front, turned};
use snapsnap_splat::{Camera, RigidTransform};

use crate::dataset::{DepthMap, centres};

/// Iterations of the search for a side pixel's depth.
const LOOKUPS: usize = 3;

/// Points of a canvas's pixels, row by row, in the front's frame; `None` for pixels without a point.
type Seen = Vec<Option<DVec3>>;

/// Moves points between the turned world and the nominal cameras' world. Both have the subject at the origin and y up.
pub(super) struct Rectification {
    /// From the pixels of front and back to the pixels of their nominal cameras.
    mappings: [Mapping; 2],
    /// Both photographs' cameras in the turned world.
    cameras: [Camera; 2],
    rectify: [PlaneMap; 2],
    restore: [PlaneMap; 2],
    /// From the data set's world to one whose front camera is above +z.
    turn: RigidTransform,
}

impl Rectification {
    /// The rectification of the photographs of front and back, and the restoration that undoes it.
    pub(super) fn new(cameras: [&Camera; 2], mappings: [&Mapping; 2]) -> (Self, Restoration) {
        let restoration = Restoration::to_cameras(cameras, mappings, cameras[0].width);
        let turn = turn_to_front(cameras[0]);
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
    pub(super) fn photographed(&self, view: &DepthMap, photograph: usize) -> Seen {
        let to_world = self.cameras[photograph].world_to_camera.inverse();
        let seen = |place: DVec2| {
            let point = to_world.apply(view.point(self.mappings[photograph].source(place))?);
            self.rectify[photograph].apply(point).map(|p| self.to_front(p))
        };
        centres(self.cameras[photograph].width).map(seen).collect()
    }

    /// Rectified points of a side, in the nominal front camera's frame. The side's nominal camera stands `degrees`
    /// around the body's axis from the front camera; `view` is the data set's view of the side.
    pub(super) fn of_side(&self, view: &DepthMap, degrees: f64) -> Seen {
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
