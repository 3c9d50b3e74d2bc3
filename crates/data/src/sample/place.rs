//! Photographs of a training sample, and their points. Photographs may be placed on their canvas like a user's
//! photographs (docs/method.md, "Photographs placed as a user's"). The person then always has the same height and
//! place: a network does not have to predict size and distance, which no picture shows.

use glam::{DVec2, DVec3};
use rand::Rng;
use snapsnap_base::FileError;
use snapsnap_net::Photograph;
use snapsnap_photo::Restoration;

use super::rectified::Rectification;
use super::{INSIDE, Source, pair};
use crate::dataset::{StoredView, unproject};

/// Depth that the published code gives the background: 1/(0 + 10⁻⁸).
const COMPAT_FAR: f32 = 1e8;
/// Iterations of the search for a side pixel's depth.
pub(super) const LOOKUPS: usize = 3;

/// Two photographs and the points of four views, or of two without sides.
pub(super) struct Four {
    /// Front and back on canvases of H and W pixels; masks are 1 or 0 with `compat`.
    pub photographs: [Photograph; 2],
    /// Points `[4,H,W,3]` in metres in the front camera's frame, and their validity `[4,H,W]`; 2 without sides.
    pub points: Vec<f32>,
    pub valid: Vec<f32>,
    /// Points `[2,H,W,3]` and validity `[2,H,W]` of the second surfaces of right and left. Empty without sides or
    /// without `samples.second_depth`.
    pub second: Points,
    /// Moves upright points back to the photographed person.
    pub restoration: Option<Restoration>,
}

impl Source {
    /// Reads front, back, and, with sides, right and left of a subject; `order` has their views.
    pub(super) fn four(
        &self,
        subject: &str,
        order: &[usize; 4],
        is_placed: bool,
        random: &mut impl Rng,
    ) -> Result<Four, FileError> {
        let compat = self.config.compat;
        let view = |(i, view): (usize, &usize)| {
            let stored = match i < 2 || compat {
                true => self.folder.view(self.split, subject, *view),
                false => self.folder.depth(self.split, subject, *view),
            }?;
            Ok(StoredView { camera: self.camera(&stored.camera), ..stored })
        };
        let has_sides = self.config.sides;
        let order = &order[..if has_sides { 4 } else { 2 }];
        let views: Vec<_> = order.iter().enumerate().map(view).collect::<Result<_, FileError>>()?;
        let second = |i: usize| {
            let depth = self.folder.second_depth(self.split, subject, order[i])?;
            Ok(StoredView {
                color: Default::default(),
                mask: Default::default(),
                depth,
                camera: views[i].camera,
            })
        };
        let seconds =
            if has_sides && self.config.second_depth { vec![second(2)?, second(3)?] } else { Vec::new() };
        let pictures = [0, 1].map(|i| (&views[i].color, &views[i].mask));
        let photographs = self.photographs(subject, [order[0], order[1]], pictures, is_placed, random)?;
        let mut restoration = None;
        let [mut first, mut second] = <[Points; 2]>::default();
        let add_seen = |to: &mut Points, map: Seen| {
            for seen in map {
                to.0.extend(seen.unwrap_or_default().as_vec3().to_array());
                to.1.push(f32::from(u8::from(seen.is_some())));
            }
        };
        if self.config.upright {
            let (rectification, back) = Rectification::new(
                [0, 1].map(|i| &views[i].camera),
                [0, 1].map(|i| &photographs.frames[i].mapping),
            );
            restoration = Some(back);
            (0..2).for_each(|i| add_seen(&mut first, rectification.photographed(&views[i], i)));
            for (to, sides) in [(&mut first, &views[2..]), (&mut second, &seconds)] {
                let side = |(view, degrees)| rectification.of_side(view, degrees);
                sides.iter().zip([90.0, 270.0]).map(side).for_each(|map| add_seen(to, map));
            }
        } else {
            let far = if compat { COMPAT_FAR } else { 0.0 };
            let add = |to: &mut Points, view: &StoredView| {
                to.0.extend(unproject(&view.depth, &view.camera, &views[0].camera.world_to_camera, far));
                let there = |pixel: usize| match compat {
                    true => view.mask.as_raw()[pixel] >= INSIDE,
                    false => view.depth[pixel] > 0.0,
                };
                to.1.extend((0..view.depth.len()).map(|pixel| f32::from(u8::from(there(pixel)))));
            };
            views.iter().for_each(|view| add(&mut first, view));
            seconds.iter().for_each(|view| add(&mut second, view));
        }
        let (points, valid) = first;
        let photographs = pair(photographs.canvases);
        Ok(Four { photographs, points, valid, second, restoration })
    }
}

/// Points of several maps, and their validity.
pub(super) type Points = (Vec<f32>, Vec<f32>);

/// Points of a canvas's pixels, row by row, in the front's frame; `None` for pixels without a point.
pub(super) type Seen = Vec<Option<DVec3>>;

impl StoredView {
    /// The point at `place` (pixels), in metres in the camera's frame, with the depth of the pixel there.
    pub(super) fn point(&self, place: DVec2) -> Option<DVec3> {
        let side = self.camera.width as usize;
        let (column, row) = (place.x.floor(), place.y.floor());
        if column < 0.0 || row < 0.0 || column as usize >= side || row as usize >= side {
            return None;
        }
        let z = self.depth[row as usize * side + column as usize];
        let ray = (place - self.camera.principal_point) / self.camera.focal;
        (z > 0.0).then(|| f64::from(z) * ray.extend(1.0))
    }
}

/// Centres of a square picture's pixels, row by row.
pub(super) fn centres(side: u32) -> impl Iterator<Item = DVec2> {
    (0..side).flat_map(move |row| (0..side).map(move |column| DVec2::new(column.into(), row.into()) + 0.5))
}
