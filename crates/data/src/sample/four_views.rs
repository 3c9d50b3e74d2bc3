//! Photographs of a training sample, and their points. Photographs may be placed on their canvas like a user's
//! photographs (docs/method.md, "Photographs placed as a user's"). The person then always has the same height and
//! place: a network does not have to predict size and distance, which no picture shows.

use glam::DVec3;
use rand::Rng;
use snapsnap_base::FileError;
use snapsnap_net::Photograph;
use snapsnap_photo::Restoration;
use snapsnap_splat::Camera;

use super::rectified::Rectification;
use super::{INSIDE, Source};
use crate::dataset::{DepthMap, Person};

/// Depth that the published code gives the background: 1/(0 + 10⁻⁸).
const COMPAT_FAR: f32 = 1e8;

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
