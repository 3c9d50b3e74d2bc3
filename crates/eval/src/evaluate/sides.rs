//! Ground-truth points of the two unseen sides.

use glam::{DVec2, DVec3};
use snapsnap_data::sample::{Test, TestItem};
use snapsnap_splat::Camera;

use super::person::{Points, off};
use crate::Result;
use crate::geometry::double;

/// Number of views whose points are joined to a side.
const SOURCES: usize = 4;
/// Largest angle in degrees between a side and a view that is joined to it. Views farther away show less of the side.
const FARTHEST: f64 = 30.0;
/// A view at most this many degrees from a side is the side itself.
const SAME: f64 = 0.1;
/// Points more than this many metres behind the nearest point of their pixel belong to another surface.
const LAYER: f64 = 0.02;
/// Largest distance of a point from its pixel's centre in pixels.
const REACH: f64 = 0.5;

/// Points seen by a camera that stands `azimuth` degrees around the world's y axis from view `first`, on a canvas of
/// `side` pixels: points `[S,S,3]` (metres, the frame of view `first`) and their mask `[S,S]`. The points come from
/// the view at this angle, or else from the nearest views. The mask is empty if no view is near.
///
/// # Errors
/// [`EvalError::File`](crate::EvalError::File).
pub fn side_points(
    test: &Test,
    row: usize,
    item: &TestItem,
    first: usize,
    azimuth: f64,
    side: usize,
) -> Result<Points> {
    let front = &item.cameras[first];
    let away = |view: &usize| off(&item.cameras[*view], front, azimuth);
    let mut near: Vec<usize> = (0..item.cameras.len()).filter(|view| away(view) <= FARTHEST + SAME).collect();
    near.sort_by(|a, b| away(a).total_cmp(&away(b)));
    let is_there = near.first().is_some_and(|view| away(view) <= SAME);
    near.truncate(if is_there { 1 } else { SOURCES });
    let mut seen = Vec::new();
    for view in near {
        let (points, valid) = test.points(row, &[view])?;
        let to_world = item.cameras[view].world_to_camera.inverse();
        let there = points.as_chunks().0.iter().zip(valid).filter(|(_, valid)| *valid > 0.5);
        seen.extend(there.map(|(point, _)| to_world.apply(double(*point))));
    }
    let nearest = visible(&seen, &front.turned(azimuth).resized(side as u32, side as u32));
    let valid = nearest.iter().map(|point| f32::from(u8::from(point.is_some()))).collect();
    let in_front = |i: usize| front.world_to_camera.apply(seen[i]).as_vec3().to_array();
    Ok((nearest.into_iter().flat_map(|point| point.map_or([0.0; 3], in_front)).collect(), valid))
}

/// For each pixel `[H,W]`, the index of the point (world frame) of the front surface nearest to the pixel's centre.
fn visible(points: &[DVec3], camera: &Camera) -> Vec<Option<usize>> {
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    // Pixel, depth, and distance from the pixel's centre.
    let place = |point: &DVec3| -> Option<(usize, f64, f64)> {
        let (at, depth) = camera.project(*point)?;
        let is_inside = at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height;
        let distance = (at - at.floor() - DVec2::splat(0.5)).length();
        let cell = || at.y as usize * camera.width as usize + at.x as usize;
        (is_inside && distance <= REACH).then(|| (cell(), depth, distance))
    };
    let mut front = vec![f64::INFINITY; camera.width as usize * camera.height as usize];
    for (cell, depth, _) in points.iter().filter_map(place) {
        front[cell] = depth.min(front[cell]);
    }
    let mut nearest = vec![None; front.len()];
    let mut distances = vec![f64::INFINITY; front.len()];
    for (i, point) in points.iter().enumerate() {
        let Some((cell, depth, distance)) = place(point) else { continue };
        if depth <= front[cell] + LAYER && distance < distances[cell] {
            (nearest[cell], distances[cell]) = (Some(i), distance);
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball of 30 cm with a small ball in front, seen by cameras 12° to either side of the side's camera.
    #[test]
    fn points_of_neighbouring_views_are_those_of_the_side() {
        const BALLS: [(DVec3, f64); 2] =
            [(DVec3::new(0.0, 0.85, 0.0), 0.3), (DVec3::new(0.5, 0.9, 0.05), 0.08)];
        // Point at which the ray through a pixel's centre meets the nearer ball.
        let cast = |camera: &Camera, cell: u32| -> Option<DVec3> {
            let pixel = DVec2::new((cell % camera.width).into(), (cell / camera.width).into()) + 0.5;
            let along = ((pixel - camera.principal_point) / camera.focal).extend(1.0);
            let along = (camera.world_to_camera.rotation.transpose() * along).normalize();
            let hit = |(centre, radius): &(DVec3, f64)| {
                let from = camera.centre() - *centre;
                let (b, c) = (from.dot(along), from.length_squared() - radius * radius);
                (b * b > c).then(|| -b - (b * b - c).sqrt())
            };
            let at = BALLS.iter().filter_map(hit).min_by(f64::total_cmp)?;
            Some(camera.centre() + at * along)
        };
        let all = |camera: Camera| (0..camera.width * camera.height).map(move |cell| cast(&camera, cell));
        let canvas = Camera::orbit_at_yaw_degrees(20.0, 128).turned(90.0);
        let exact: Vec<Option<DVec3>> = all(canvas).collect();
        let own: Vec<DVec3> = exact.iter().copied().flatten().collect();
        let found = visible(&own, &canvas).into_iter().map(|i| i.map(|i| own[i]));
        assert!(found.eq(exact.iter().copied()), "its own points");

        let stored = |yaw: f64| Camera::orbit_at_yaw_degrees(20.0, 256).turned(yaw);
        let seen: Vec<DVec3> = [78.0, 102.0].iter().flat_map(|yaw| all(stored(*yaw)).flatten()).collect();
        let found = visible(&seen, &canvas);
        let pairs = || found.iter().zip(&exact).map(|(i, exact)| (i.map(|i| seen[i]), *exact));
        let off: Vec<f64> = pairs().filter_map(|(i, exact)| Some((i? - exact?).length())).collect();
        // Pixels are 2 cm wide at this distance, and have about eight points. Few pixels are seen only by the side or
        // only by its neighbours.
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        assert!(mean < 0.4 * 0.02, "{mean} m");
        let only_one = pairs().filter(|(i, exact)| i.is_some() != exact.is_some()).count();
        assert!(off.len() > 700 && only_one * 10 < off.len(), "{only_one} beside {}", off.len());
    }
}
