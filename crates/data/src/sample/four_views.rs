//! Photographs of a training sample, and their points. Photographs may be placed on their canvas like a user's
//! photographs (docs/method.md, "Photographs placed as a user's"). The person then always has the same height and
//! place: a network does not have to predict size and distance, which no picture shows.
//!
//! Rectified points are the points of an upright person that the nominal cameras would see in the same pixels
//! (docs/method.md, "Upright targets"). A photograph does not show its camera's elevation and distance. It does show,
//! to a network that knows people, how far the surface lies in front of the body's axis. Each point therefore keeps its
//! distance in front of the axis, and moves onto the nominal camera's ray through its pixel.

use glam::{DVec2, DVec3};
use rand::Rng;
use snapsnap_base::FileError;
use snapsnap_net::Photograph;
use snapsnap_photo::{AXIS, Mapping, PlaneMap, Restoration, nominal, turn_to_front, turned};
use snapsnap_splat::{Camera, RigidTransform};

use super::{INSIDE, Source};
use crate::dataset::{DepthMap, Person, centres};

/// Depth that the published code gives the background: 1/(0 + 10⁻⁸).
const COMPAT_FAR: f32 = 1e8;
/// Iterations of the search for a side pixel's depth.
const LOOKUPS: usize = 3;

/// Two photographs and the points of four views, or of two without sides.
pub(super) struct FourViews {
    /// Front and back on canvases of H and W pixels; masks are 1 or 0 with `compat`.
    pub photographs: [Photograph; 2],
    /// Cameras of front, back, right and left.
    pub cameras: [Camera; 4],
    /// Points `[V,H,W,3]` in metres in the front camera's frame, and their validity `[V,H,W]`: V is 4, 2 without sides,
    /// or 6 with the second surfaces of right and left. Empty without `points` of the config.
    pub points: Points,
    /// Moves upright points back to the photographed person.
    pub restoration: Option<Restoration>,
}

impl Source {
    /// Reads front, back, and, with sides, right and left of a person; `order` has their views.
    pub(super) fn four_views(
        &self,
        person: Person<'_>,
        order: [usize; 4],
        random: &mut impl Rng,
    ) -> Result<FourViews, FileError> {
        let compat = self.config.compat;
        let count = match (self.config.points, self.config.sides) {
            (false, _) => 0,
            (true, false) => 2,
            (true, true) => 4,
        };
        let camera = |view: usize| person.camera(view).map(|stored| self.camera(&stored));
        let [front, back, right, left] = order;
        let cameras = [camera(front)?, camera(back)?, camera(right)?, camera(left)?];
        // The published code takes the validity of all points from the masks.
        let shown = &order[..if compat { count.max(2) } else { 2 }];
        let pictures = shown.iter().map(|view| person.picture(*view, false));
        let pictures = pictures.collect::<Result<Vec<_>, _>>()?;
        let photographs = self.photographs(person, [front, back], &pictures, random)?;
        let mappings = [0, 1].map(|i| &photographs.frames[i].mapping);
        let rectify = || Rectification::new([&cameras[0], &cameras[1]], mappings);
        let (rectification, restoration) = self.config.upright.then(rectify).unzip();

        let add_map = |to: &mut Points, kind: &str, i: usize| {
            let mut depth = person.depths(kind, order[i])?;
            if compat {
                depth.iter_mut().filter(|z| **z <= 0.0).for_each(|z| *z = COMPAT_FAR);
            }
            let map = DepthMap { depth, camera: cameras[i] };
            match &rectification {
                Some(rectification) if i < 2 => add(to, rectification.photographed(&map, i)),
                Some(rectification) => add(to, rectification.of_side(&map, [90.0, 270.0][i - 2])),
                None => add(to, map.points(&cameras[0].world_to_camera)),
            }
            Ok::<_, FileError>(())
        };
        let mut points = Points::default();
        for i in 0..count {
            add_map(&mut points, "depth", i)?;
        }
        if compat {
            let masks = pictures[..count].iter().flat_map(|(_, mask)| mask.as_raw());
            points.1 = masks.map(|share| f32::from(u8::from(*share >= INSIDE))).collect();
        }
        if self.config.second_depth && count == 4 {
            add_map(&mut points, "depth2", 2)?;
            add_map(&mut points, "depth2", 3)?;
        }
        let photographs: [Photograph; 2] = photographs.canvases.try_into().expect("two photographs");
        Ok(FourViews { photographs, cameras, points, restoration })
    }
}

/// Points of several maps, and their validity.
pub(super) type Points = (Vec<f32>, Vec<f32>);

/// Adds a map, row by row. Pixels without a point are 0 and not valid.
pub(super) fn add(to: &mut Points, map: impl IntoIterator<Item = Option<DVec3>>) {
    for point in map {
        to.0.extend(point.unwrap_or_default().as_vec3().to_array());
        to.1.push(f32::from(u8::from(point.is_some())));
    }
}

/// Points of a canvas's pixels, row by row, in the front's frame; `None` for pixels without a point.
type Seen = Vec<Option<DVec3>>;

/// Moves points between the turned world and the nominal cameras' world. Both have the subject at the origin and y up.
struct Rectification {
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
    fn new(cameras: [&Camera; 2], mappings: [&Mapping; 2]) -> (Self, Restoration) {
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
    fn photographed(&self, view: &DepthMap, photograph: usize) -> Seen {
        let to_world = self.cameras[photograph].world_to_camera.inverse();
        let seen = |place: DVec2| {
            let point = to_world.apply(view.point(self.mappings[photograph].source(place))?);
            self.rectify[photograph].apply(point).map(|p| self.to_front(p))
        };
        centres(self.cameras[photograph].width).map(seen).collect()
    }

    /// Rectified points of a side, in the nominal front camera's frame. The side's nominal camera stands `degrees`
    /// around the body's axis from the front camera; `view` is the data set's view of the side.
    fn of_side(&self, view: &DepthMap, degrees: f64) -> Seen {
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
