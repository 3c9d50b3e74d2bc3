//! Training photographs placed on their canvas as a user's are, and the points that belong to them
//! (docs/method.md, "Targets placed as a user's photographs"). A person then always has the same height and place.
//! Size and distance, which no picture shows, are no part of the task. Points are scaled as if the body's axis were at
//! the nominal camera's distance. One shift per sample then aligns the front's points with the rays of its pixels.

use glam::{DMat3, DVec2, DVec3};
use rand::Rng;
use snapsnap_base::FileError;
use snapsnap_net::Photograph;
use snapsnap_photo::{Mapping, Restoration, scale_of};
use snapsnap_splat::Camera;

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
    /// `[4,H,W,3]` in metres in the front's frame, and their validity `[4,H,W]`. Without sides there are two instead of four.
    pub points: Vec<f32>,
    pub valid: Vec<f32>,
    /// `[2,H,W,3]` and `[2,H,W]`: the same of the second surfaces of right and left. Empty without sides or without
    /// `samples.second_depth`.
    pub second: Points,
    /// The front camera. The points times `scale` are in its frame: it moves with placed points.
    pub front: Camera,
    pub scale: f64,
    /// What moves upright points back to the photographed person.
    pub restoration: Option<Restoration>,
}

impl Four {
    /// Photographs alone. `front` is the front photograph's camera.
    pub(super) fn without_points(
        photographs: [Photograph; 2],
        front: Camera,
        restoration: Option<Restoration>,
    ) -> Self {
        let (front, scale) = restoration.as_ref().map_or((front, 1.0), |back| (back.front, back.scale));
        let (points, valid, second) = Default::default();
        Self { photographs, points, valid, second, front, scale, restoration }
    }
}

impl Source {
    /// Front, back, and, with sides, right and left of a subject.
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
        let photographs =
            self.photographs([0, 1].map(|i| (&views[i].color, &views[i].mask)), is_placed, random)?;
        let (mut front, mut scale, mut restoration) = (views[0].camera, 1.0, None);
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
            (front, scale, restoration) = (back.front, back.scale, Some(back));
            (0..2).for_each(|i| add_seen(&mut first, rectification.photographed(&views[i], i)));
            for (to, sides) in [(&mut first, &views[2..]), (&mut second, &seconds)] {
                let side = |(view, degrees)| rectification.of_side(view, degrees);
                sides.iter().zip([90.0, 270.0]).map(side).for_each(|map| add_seen(to, map));
            }
        } else if !is_placed {
            let far = if compat { COMPAT_FAR } else { 0.0 };
            let add = |to: &mut Points, view: &StoredView| {
                to.0.extend(unproject(&view.depth, &view.camera, &front.world_to_camera, far));
                let there = |pixel: usize| match compat {
                    true => view.mask.as_raw()[pixel] >= INSIDE,
                    false => view.depth[pixel] > 0.0,
                };
                to.1.extend((0..view.depth.len()).map(|pixel| f32::from(u8::from(there(pixel)))));
            };
            views.iter().for_each(|view| add(&mut first, view));
            seconds.iter().for_each(|view| add(&mut second, view));
        } else {
            let nominal = Camera::orbit_at_yaw_degrees(0.0, front.width);
            scale = scale_of(&photographs.frames[0].mapping, &front, front.width);
            let seen = views[0].through(&photographs.frames[0].mapping, &front, scale);
            let rays = centres(front.width).map(|place| (place - nominal.principal_point) / nominal.focal);
            front.world_to_camera.translation +=
                scale * shift(rays.zip(seen).filter_map(|(ray, point)| Some((ray, point?))));
            let photographed =
                [0, 1].map(|i| views[i].through(&photographs.frames[i].mapping, &front, scale));
            let side = |(view, degrees): (&StoredView, f64)| view.as_nominal(&front, scale, degrees);
            let sides = |views: &[StoredView]| views.iter().zip([90.0, 270.0]).map(side).collect::<Vec<_>>();
            photographed.into_iter().chain(sides(&views[2..])).for_each(|map| add_seen(&mut first, map));
            sides(&seconds).into_iter().for_each(|map| add_seen(&mut second, map));
        }
        let (points, valid) = first;
        let photographs = pair(photographs.canvases);
        Ok(Four { photographs, points, valid, second, front, scale, restoration })
    }
}

/// Points of several maps, and their validity.
pub(super) type Points = (Vec<f32>, Vec<f32>);

/// Points of a canvas's pixels, row by row, in the front's frame; `None` for pixels without a point.
pub(super) type Seen = Vec<Option<DVec3>>;

impl StoredView {
    /// The point at a place of the view, from its pixel's depth, in the camera's frame.
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

    /// The view's points at the pixels of its canvas.
    fn through(&self, mapping: &Mapping, front: &Camera, scale: f64) -> Seen {
        let to_front = self.camera.world_to_camera.inverse().then(&front.world_to_camera);
        let seen = |place| self.point(mapping.source(place)).map(|p| to_front.apply(p) / scale);
        centres(self.camera.width).map(seen).collect()
    }

    /// The view's points at the pixels of the nominal camera that stands `degrees` around the body's axis from the
    /// front's, in the frame of `front`.
    fn as_nominal(&self, front: &Camera, scale: f64, degrees: f64) -> Seen {
        let [nominal, nominal_front] =
            [degrees, 0.0].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, self.camera.width));
        let to_front = nominal.world_to_camera.inverse().then(&nominal_front.world_to_camera);
        let onwards = front.world_to_camera.inverse().then(&self.camera.world_to_camera);
        let to_view = |p: DVec3| onwards.apply(scale * to_front.apply(p));
        let (back, from_front) = (onwards.inverse(), to_front.inverse());
        let from_view = |p: DVec3| from_front.apply(back.apply(p) / scale);
        let all = centres(self.camera.width).filter_map(|place| self.point(place));
        let (sum, count) = all.fold((0.0, 0.0), |(sum, count), p| (sum + from_view(p).z, count + 1.0));
        if count == 0.0 {
            return vec![None; self.depth.len()];
        }
        let seen = |place: DVec2| {
            let ray = ((place - nominal.principal_point) / nominal.focal).extend(1.0);
            let mut found = DVec3::new(0.0, 0.0, sum / count);
            for _ in 0..LOOKUPS {
                let there = to_view(found.z * ray);
                if there.z <= 0.0 {
                    return None;
                }
                let pixel = self.camera.focal * there.truncate() / there.z + self.camera.principal_point;
                found = from_view(self.point(pixel)?);
            }
            Some(to_front.apply(found))
        };
        centres(self.camera.width).map(seen).collect()
    }
}

/// Centres of a square picture's pixels, row by row.
pub(super) fn centres(side: u32) -> impl Iterator<Item = DVec2> {
    (0..side).flat_map(move |row| (0..side).map(move |column| DVec2::new(column.into(), row.into()) + 0.5))
}

/// The shift t, in metres, that moves points p onto their rays r = `(x/z, y/z)`: the least-squares solution of
/// t_x − r_x·t_z = r_x·z − x, and of the same equation for y.
pub(super) fn shift(seen: impl Iterator<Item = (DVec2, DVec3)>) -> DVec3 {
    let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (ray, point) in seen {
        for (row, value) in [
            (DVec3::new(1.0, 0.0, -ray.x), ray.x * point.z - point.x),
            (DVec3::new(0.0, 1.0, -ray.y), ray.y * point.z - point.y),
        ] {
            matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
            right += row * value;
        }
    }
    // One point is not enough for a distance.
    if matrix.determinant().abs() < 1e-9 { DVec3::ZERO } else { matrix.inverse() * right }
}
