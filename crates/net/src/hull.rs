//! The visual hull of the two photographs. Points outside of a silhouette are not on the person.

use glam::DVec3;
use rayon::prelude::*;
use snapsnap_splat::Camera;

use crate::config::{NetworkConfig, OPPOSITE};
use crate::network::{View, nominal_camera, pixel_width};

/// Largest number of steps of a point towards the silhouettes, which bounds the time on large canvases.
const MOST_STEPS: f64 = 100.0;

/// Depth in metres by which a point may lie before the surface that a photograph shows.
const BEFORE: f32 = 0.005;

/// The space inside the masks of the two photographs, and behind the surfaces that they show.
pub struct Hull {
    side: usize,
    /// Dilated masks.
    masks: [Vec<bool>; 2],
    cameras: [Camera; 2],
    /// Depth of the surface in each pixel, 0 without one. Empty if surfaces do not count.
    surfaces: [Vec<f32>; 2],
}

impl Hull {
    /// The hull of masks `[S, S]` of front and back, dilated by `margin` pixels for small errors of predicted points.
    /// The nominal cameras are the cameras that see upright people (docs/method.md, "Upright targets").
    pub fn new(masks: [&[bool]; 2], side: usize, margin: usize) -> Self {
        let cameras = [View::Front, View::Back].map(|view| nominal_camera(view, OPPOSITE, side));
        let surfaces = [Vec::new(), Vec::new()];
        Self { side, masks: masks.map(|mask| dilated(mask, side, margin)), cameras, surfaces }
    }

    /// The same with the surfaces of front and back: points `[2, S, S, 3]`, metres in the front camera's frame, with a
    /// confidence `[2, S, S]` above `least`.
    fn behind(mut self, points: &[f32], conf: &[f32], least: f32) -> Self {
        let area = self.side * self.side;
        for view in [0, 1] {
            let depth = |pixel: usize| {
                let at = view * area + pixel;
                let is_surface = self.masks[view][pixel] && conf[at] > least;
                let point = is_surface.then(|| DVec3::from([0, 1, 2].map(|c| f64::from(points[3 * at + c]))));
                point
                    .and_then(|point| self.cameras[view].project(point))
                    .map_or(0.0, |(_, depth)| depth as f32)
            };
            self.surfaces[view] = (0..area).into_par_iter().map(depth).collect();
        }
        self
    }

    /// Whether a point `[x, y, z]`, metres in the front camera's frame, is within the masks of both cameras and not
    /// before their surfaces.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        let point = DVec3::from(point.map(f64::from));
        [0, 1].into_iter().all(|view| {
            let Some((place, depth)) = self.cameras[view].project(point) else { return false };
            let inside = 0.0..self.side as f64;
            let at = place.y as usize * self.side + place.x as usize;
            inside.contains(&place.x)
                && inside.contains(&place.y)
                && self.masks[view][at]
                && self.surfaces[view].get(at).is_none_or(|surface| depth as f32 >= surface - BEFORE)
        })
    }

    /// The first place inside the hull when a point moves straight away from `centre`, by at most `reach`; all in
    /// metres in the front camera's frame. `None` for a point inside, and if no place in reach is inside.
    fn entered(&self, point: [f32; 3], centre: DVec3, reach: f64) -> Option<[f32; 3]> {
        if self.contains(point) {
            return None;
        }
        let point = DVec3::from(point.map(f64::from));
        let way = (point - centre).try_normalize()?;
        let step = (0.5 * f64::from(pixel_width(self.side))).max(reach / MOST_STEPS);
        (1..=(reach / step) as usize)
            .map(|steps| (point + steps as f64 * step * way).as_vec3().to_array())
            .find(|place| self.contains(*place))
    }
}

/// Moves the sides' points that lie outside of the photographs' silhouettes, or before the surfaces of front and back,
/// along their lines of sight until they do not (docs/method.md, "Points inside the silhouettes"). `masks` `[S, S]`
/// belong to the photographs. `points` `[V, S, S, 3]` are metres in the front camera's frame. Points with a confidence
/// `conf` `[V, S, S]` too low for a Gaussian stay. Returns the number of points that moved.
pub(crate) fn carve(config: &NetworkConfig, masks: [&[bool]; 2], points: &mut [f32], conf: &[f32]) -> usize {
    let (side, area) = (config.resolution, config.resolution * config.resolution);
    let reach = config.hull_reach();
    if reach == 0.0 || conf.len() <= 2 * area {
        return 0;
    }
    let hull = Hull::new(masks, side, 0).behind(points, conf, config.conf_threshold);
    let views = points.chunks_exact_mut(3 * area).zip(conf.chunks_exact(area)).zip(View::WITH_SECOND);
    views
        .skip(2)
        .map(|((points, conf), view)| {
            let centre = nominal_camera(view, OPPOSITE, side).centre();
            let moved = points.par_chunks_exact_mut(3).zip(conf).map(|(point, conf)| {
                let place = (*conf > config.conf_threshold)
                    .then(|| hull.entered([point[0], point[1], point[2]], centre, reach))
                    .flatten();
                if let Some(place) = place {
                    point.copy_from_slice(&place);
                }
                usize::from(place.is_some())
            });
            moved.sum::<usize>()
        })
        .sum()
}

/// A mask `[H, W]` of `width` columns, dilated by a square of 2·`margin` + 1 pixels.
pub fn dilated(mask: &[bool], width: usize, margin: usize) -> Vec<bool> {
    let rows = mask.len() / width.max(1);
    let across = spread(mask, [rows, width], [width, 1], margin);
    spread(&across, [width, rows], [1, width], margin)
}

/// Dilates by `margin` along lines of `length` pixels. Lines and pixels lie `strides` apart.
fn spread(inside: &[bool], [lines, length]: [usize; 2], strides: [usize; 2], margin: usize) -> Vec<bool> {
    let mut out = vec![false; inside.len()];
    for line in 0..lines {
        let at = |i: usize| line * strides[0] + i * strides[1];
        // One past the last pixel that the set pixels before reach.
        let mut reach = 0;
        for i in (0..length).filter(|i| inside[at(*i)]) {
            let end = i.saturating_add(margin).min(length - 1) + 1;
            (i.saturating_sub(margin).max(reach)..end).for_each(|near| out[at(near)] = true);
            reach = end;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    /// The person is the left half of the front photograph (x < 0). The camera of both right surfaces is at x = +2.
    #[test]
    fn points_of_sides_move_along_their_lines_of_sight_into_the_silhouettes() {
        let (side, area) = (64, 64 * 64);
        let left_half: Vec<bool> = (0..area).map(|i| i % side < side / 2).collect();
        let all = vec![true; area];
        let masks = [&left_half[..], &all];
        let mut config = NetworkConfig { resolution: side, ..NetworkConfig::default() };
        let outside = [0.1, 0.2, 2.1];
        let far = [0.5, 0.2, 2.1];
        let inside = [-0.1, 0.2, 2.1];
        // Points of each view: outside, inside, too far outside, not finite, and outside with low confidence.
        let mut given = vec![0.0; 6 * 3 * area];
        let mut conf = vec![0.0; 6 * area];
        for view in 0..6 {
            let rows = [outside, inside, far, [f32::NAN, 0.2, 2.1], outside];
            given[3 * area * view..][..15].copy_from_slice(rows.as_flattened());
            conf[area * view..][..4].fill(1.0);
        }
        let carved = |config: &NetworkConfig| {
            let mut points = given.clone();
            let count = carve(config, masks, &mut points, &conf);
            (points, count)
        };
        let bits = |points: &[f32]| points.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(carved(&config).1, 0, "without hull_margin");
        config.hull_margin = Some(8);
        config.hull_reach = 0.0;
        assert_eq!(carved(&config).1, 0);
        config.hull_reach = 0.2;
        let (points, count) = carved(&config);
        // The left's camera looks towards +x: its points only move further outside.
        assert_eq!(count, 2);
        let [at, second] = [View::Right, View::RightSecond].map(|view| 3 * area * view as usize);
        let moved = [points[at], points[at + 1], points[at + 2]];
        let step = 0.5 * pixel_width(side);
        assert!(moved[0] <= 0.0 && moved[0] > -1.1 * step, "{moved:?}");
        let centre = nominal_camera(View::Right, OPPOSITE, side).centre();
        let [from, to] = [outside, moved].map(|p| DVec3::from(p.map(f64::from)) - centre);
        assert!(from.normalize().distance(to.normalize()) < 1e-6, "{centre} {moved:?}");
        let mut expected = given.clone();
        expected[at..at + 3].copy_from_slice(&moved);
        expected[second..second + 3].copy_from_slice(&moved);
        assert_eq!(bits(&points), bits(&expected), "nothing else moves");
        config.hull_reach = 0.05;
        let (points, count) = carved(&config);
        assert!(count == 0 && bits(&points) == bits(&given), "the way into the half is longer than 0.05 m");
    }

    /// The front shows a step: a surface 1.8 m away on the left half, 2.1 m on the right.
    #[test]
    fn points_of_sides_move_behind_the_surfaces_of_the_photographs() {
        let (side, area) = (64, 64 * 64);
        let config = NetworkConfig { resolution: side, hull_margin: Some(8), ..NetworkConfig::default() };
        let camera = nominal_camera(View::Front, OPPOSITE, side);
        let (mut points, mut conf) = (vec![0.0; 6 * 3 * area], vec![0.0; 6 * area]);
        for pixel in 0..area {
            let place = DVec2::new((pixel % side) as f64, (pixel / side) as f64) + 0.5;
            let ray = (place - camera.principal_point) / camera.focal;
            let depth = if ray.x < 0.0 { 1.8 } else { 2.1 };
            points[3 * pixel..][..3].copy_from_slice(&(depth * ray.extend(1.0)).as_vec3().to_array());
        }
        conf[..area].fill(1.0);
        // Before the right half, and before it by less than the tolerance.
        let at = 3 * area * View::Right as usize;
        points[at..at + 6].copy_from_slice(&[0.03, 0.2, 1.95, 0.03, 0.2, 2.096]);
        conf[area * View::Right as usize..][..2].fill(1.0);
        let all = vec![true; area];
        let before = points.clone();
        assert_eq!(carve(&config, [&all, &all], &mut points, &conf), 1);
        assert!(points[at] <= 0.0 && points[at] > -0.05, "{}", points[at]);
        points[at..at + 3].copy_from_slice(&before[at..at + 3]);
        assert!(points == before, "nothing else moves");
    }

    /// Against the definition, pixel by pixel.
    #[test]
    fn masks_grow_by_their_margin_in_all_directions() {
        let (height, width) = (13, 17);
        for (seed, margin) in [(1_u32, 0), (2, 1), (3, 2), (4, 5), (5, 40), (6, usize::MAX)] {
            let lit = |i: usize| (i as u32).wrapping_mul(2_654_435_761).rotate_left(seed) % 23 == 0;
            let mask: Vec<bool> = (0..height * width).map(lit).collect();
            let near = |i: usize| {
                let (x, y) = (i % width, i / width);
                let lines = y.saturating_sub(margin)..=y.saturating_add(margin).min(height - 1);
                lines.into_iter().any(|row| {
                    (x.saturating_sub(margin)..=x.saturating_add(margin).min(width - 1))
                        .any(|c| lit(row * width + c))
                })
            };
            let expected: Vec<bool> = (0..height * width).map(near).collect();
            assert_eq!(dilated(&mask, width, margin), expected, "margin {margin}");
        }
    }

    /// The nominal cameras look at the axis from two metres, front and back.
    #[test]
    fn only_what_both_cameras_see_in_their_masks_is_inside() {
        let side = 64;
        let left_half: Vec<bool> = (0..side * side).map(|i| i % side < side / 2).collect();
        let all = vec![true; side * side];
        let point = |x: f32, z: f32| [x, 0.0, z];
        let front_only = Hull::new([&left_half, &all], side, 0);
        assert!(front_only.contains(point(-0.1, 2.0)) && !front_only.contains(point(0.1, 2.0)));
        // The front's left is the back's right.
        let back_only = Hull::new([&all, &left_half], side, 0);
        assert!(!back_only.contains(point(-0.1, 2.0)) && back_only.contains(point(0.1, 2.0)));
        let both = Hull::new([&left_half, &left_half], side, 0);
        assert!(!both.contains(point(-0.1, 2.0)) && !both.contains(point(0.1, 2.0)));
        // A pixel at two metres is 4 cm here.
        let grown = Hull::new([&left_half, &left_half], side, 3);
        assert!(grown.contains(point(-0.1, 2.0)) && grown.contains(point(0.1, 2.0)));
        let everything = Hull::new([&all, &all], side, 0);
        assert!(everything.contains(point(0.0, 2.0)));
        // Behind either camera, or beside the canvas.
        assert!(!everything.contains(point(0.0, -1.0)) && !everything.contains(point(0.0, 5.0)));
        assert!(!everything.contains(point(3.0, 2.0)) && !everything.contains([f32::NAN; 3]));
    }
}
