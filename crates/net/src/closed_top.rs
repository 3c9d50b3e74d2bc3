//! The top of head and shoulders, which no level camera sees (docs/method.md, "Closed top").

use glam::{DVec3, Vec3};
use snapsnap_splat::Camera;

use crate::config::OPPOSITE;
use crate::network::{View, nominal_camera, pixel_width};
use crate::valid_pixels::{STEEPEST, without_steep};

/// Largest distance between both edges, metres: a head with hair is not longer.
const LONGEST: f32 = 0.35;
/// Largest difference in height of two edges that belong to one surface, metres.
const STEP: f32 = 0.05;

/// The surface between the upper edges of front and back, stored like the map of a view. It is a parabola that touches
/// both edges' lines of sight: the silhouettes tell no more. Columns are the columns of
/// the front's canvas. Rows lead from the front's edge backwards.
pub struct Top {
    /// `[3, S, S]` colours in [−1, 1].
    pub image: Vec<f32>,
    /// `[S, S, 3]` metres, front camera's frame.
    pub points: Vec<f32>,
    /// `[S, S]`: whether there is a point.
    pub valid: Vec<bool>,
}

/// Uppermost pixel of a column.
#[derive(Clone, Copy)]
struct Edge {
    point: Vec3,
    /// Mean over the uppermost pixels, since the first one often shows the background as well.
    color: Vec3,
}

impl Top {
    /// The surface between a front and a back with colours `[3, S, S]`, points `[S, S, 3]` and valid pixels `[S, S]`.
    /// `None` if there is no pixel to add.
    pub fn new(colors: [&[f32]; 2], points: [&[f32]; 2], valid: [&[bool]; 2], side: usize) -> Option<Self> {
        let pixel = pixel_width(side);
        let nominal = Camera::orbit_at_yaw_degrees(0.0, side as u32);
        let up = (nominal.world_to_camera.rotation * DVec3::Y).as_vec3();
        let eyes =
            [View::Front, View::Back].map(|view| nominal_camera(view, OPPOSITE, side).centre().as_vec3());
        let [front, mut back] = [0, 1].map(|view| edges(colors[view], points[view], valid[view], side));
        back.sort_by(|(_, a), (_, b)| a.point.x.total_cmp(&b.point.x));

        let area = side * side;
        let mut top =
            Self { image: vec![0.0; 3 * area], points: vec![0.0; 3 * area], valid: vec![false; area] };
        for (column, near) in front {
            let Some(far) = at(&back, near.point.x, STEEPEST * pixel) else { continue };
            let way = far.point - near.point;
            let (length, rise) = (way.length(), way.dot(up));
            if way.z <= 0.0 || length > LONGEST || rise.abs() > STEP {
                continue;
            }
            let middle = crossing(eyes, [near.point, far.point]);
            let steps = (length / pixel).round() as usize;
            for step in 1..steps.min(side + 1) {
                let (i, share) = ((step - 1) * side + column, step as f32 / steps as f32);
                top.valid[i] = true;
                let point = near.point.lerp(middle, share).lerp(middle.lerp(far.point, share), share);
                top.points[3 * i..3 * i + 3].copy_from_slice(&point.to_array());
                let color = near.color.lerp(far.color, share).to_array();
                (0..3).for_each(|c| top.image[c * area + i] = color[c]);
            }
        }
        without_steep(&mut top.valid, &top.points, side, STEEPEST);
        top.valid.contains(&true).then_some(top)
    }
}

/// Where the lines of sight from these eyes through these points come closest, behind the points. The middle of the
/// points if they part there.
fn crossing(eyes: [Vec3; 2], points: [Vec3; 2]) -> Vec3 {
    let [a, b] = [0, 1].map(|i| (points[i] - eyes[i]).normalize_or_zero());
    let (apart, cosine) = (points[0] - points[1], a.dot(b));
    let sine_squared = 1.0 - cosine * cosine;
    let behind = [cosine * b.dot(apart) - a.dot(apart), b.dot(apart) - cosine * a.dot(apart)];
    let [first, second] = behind.map(|distance| distance / sine_squared);
    let is_crossed = [first, second].iter().all(|distance| (0.0..apart.length()).contains(distance));
    let (first, second) = if is_crossed { (first * a, second * b) } else { (Vec3::ZERO, Vec3::ZERO) };
    (points[0] + first).midpoint(points[1] + second)
}

/// Upper edges of a view, each with its column.
fn edges(colors: &[f32], points: &[f32], valid: &[bool], side: usize) -> Vec<(usize, Edge)> {
    let area = side * side;
    let deep = (side / 256).max(1);
    let edge = |column: usize| -> Option<(usize, Edge)> {
        let mut pixels = (0..side).map(|row| row * side + column).skip_while(|&i| !valid[i]);
        let first = pixels.next()?;
        let seen: Vec<usize> =
            [first].into_iter().chain(pixels.take(deep).take_while(|&i| valid[i])).collect();
        let sum: Vec3 =
            seen.iter().map(|&i| Vec3::new(colors[i], colors[area + i], colors[2 * area + i])).sum();
        let point = Vec3::from_slice(&points[3 * first..3 * first + 3]);
        Some((column, Edge { point, color: sum / seen.len() as f32 }))
    };
    (0..side).filter_map(edge).collect()
}

/// The edge interpolated at `x` between two neighbours at most `gap` metres apart. `edges` are sorted by x.
fn at(edges: &[(usize, Edge)], x: f32, gap: f32) -> Option<Edge> {
    let after = edges.partition_point(|(_, edge)| edge.point.x < x);
    let (a, b) = (edges.get(after.checked_sub(1)?)?.1, edges.get(after)?.1);
    let width = b.point.x - a.point.x;
    let share = if width > 0.0 { (x - a.point.x) / width } else { 0.0 };
    (a.point.distance(b.point) <= gap)
        .then(|| Edge { point: a.point.lerp(b.point, share), color: a.color.lerp(b.color, share) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Front and back of a box 12 pixels wide. In metres, its upper edges are `depth` apart, the back's `rise` higher.
    fn boxed(depth: f32, rise: f32) -> Option<Top> {
        let side = 64;
        let nominal = Camera::orbit_at_yaw_degrees(0.0, side as u32);
        let mut valid = vec![false; side * side];
        let mut maps = [vec![0.0; 3 * side * side], vec![0.0; 3 * side * side]];
        for (view, map) in maps.iter_mut().enumerate() {
            for (row, column) in (10..40).flat_map(|row| (20..32).map(move |column| (row, column))) {
                let i = row * side + column;
                valid[i] = true;
                // The back is seen mirrored.
                let x = if view == 0 { column as f64 - 26.0 } else { 26.0 - column as f64 - 0.3 };
                let y = 1.7 - 0.03 * (row - 10) as f64 + f64::from(rise) * view as f64;
                let z = if view == 0 { f64::from(depth) / 2.0 } else { -f64::from(depth) / 2.0 };
                let point = nominal.world_to_camera.apply(DVec3::new(0.03 * x, y, z)).as_vec3();
                map[3 * i..3 * i + 3].copy_from_slice(&point.to_array());
            }
        }
        let colors = [0.5, -0.5].map(|value| vec![value; 3 * side * side]);
        Top::new([&colors[0], &colors[1]], [&maps[0], &maps[1]], [&valid, &valid], side)
    }

    #[test]
    fn a_box_is_closed_by_a_dome_in_the_colours_of_both_edges() {
        let top = boxed(0.3, 0.0).expect("points");
        let nominal = Camera::orbit_at_yaw_degrees(0.0, 64);
        let world = nominal.world_to_camera.inverse();
        let at = |i: usize| Vec3::from_slice(&top.points[3 * i..3 * i + 3]).as_dvec3();
        let inside: Vec<usize> = (0..64 * 64).filter(|i| top.valid[*i]).collect();
        // A pixel is 3.9 cm wide: 30 cm have seven inner points. The back has no neighbour beyond the last column.
        assert_eq!(inside.len(), 7 * 11);
        // Lines of sight from below rise to above the middle of the box. The dome is half as high.
        let eye = nominal.centre();
        let slope = (1.7 - eye.y) / (eye.z - 0.15);
        for i in inside {
            let (point, row) = (world.apply(at(i)), i / 64 + 1);
            let share = row as f64 / 8.0;
            let height = 1.7 + slope * 0.15 * 2.0 * share * (1.0 - share);
            assert!((point.y - height).abs() < 2e-3, "{point}, not {height}");
            assert!((point.z - (0.15 - 0.3 * share)).abs() < 2e-3, "{point}");
            assert!((top.image[i] - (0.5 - share as f32)).abs() < 1e-5);
        }
    }

    #[test]
    fn lines_of_sight_cross_behind_their_points_or_not_at_all() {
        let eyes = [Vec3::ZERO, Vec3::new(0.0, 0.0, 4.0)];
        let points = |y: f32| [Vec3::new(0.0, y, 1.9), Vec3::new(0.0, y, 2.1)];
        let middle = crossing(eyes, points(0.95));
        assert!(middle.distance(Vec3::new(0.0, 1.0, 2.0)) < 1e-5, "{middle}");
        // Level lines do not cross at one place, lines that part cross before their points.
        for (eyes, points) in [(eyes, points(0.0)), (eyes.map(|eye| -eye), points(0.95))] {
            assert_eq!(crossing(eyes, points), points[0].midpoint(points[1]));
        }
    }

    #[test]
    fn edges_of_two_surfaces_are_not_joined() {
        assert!(boxed(0.3, 0.04).is_some());
        // One edge is higher, both are too far apart, or the back's edge stands before the front's.
        for (depth, rise) in [(0.3, 0.06), (0.3, -0.06), (0.36, 0.0), (-0.3, 0.0), (0.03, 0.0)] {
            assert!(boxed(depth, rise).is_none(), "{depth} {rise}");
        }
    }
}
