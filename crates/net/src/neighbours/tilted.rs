//! Boxes along the axes of what they hold: thin around a slanted or curved sheet, where a box along the coordinate axes
//! is as deep as it is wide.
//!
//! A bound in rotated coordinates rounds differently from the distance itself, so it gives way by a margin, with
//! u = 2⁻²⁴ the unit of rounding and v = q − centre:
//!
//! * The rounded axes are orthonormal to 2u per entry of their Gram matrix, so Σ(axisₖ·w)² ≤ (1 + 6u)·|w|².
//! * axisₖ·v in f32 is off by at most 4u·Σ|axisₖᵢ·vᵢ| ≤ 4u·|v|₁; [`MARGIN`] is twice that. The same holds for the
//!   points of the box, whose |v|₁ is at most three times the width.
//! * Rounding of gaps (2u each, squared 4u), squares, sums and the last product comes to 9u at most, that of the
//!   distance as computed to 5u: with the 6u above less than [`SHRINK`], 32u.
//! * Coordinates are kept between [`NARROWEST`] and [`FARTHEST`], where nothing overflows and what underflows is far
//!   below `f32::MIN_POSITIVE`, which is taken off as well.

use glam::DVec3;
use pulp::{Simd, WithSimd};

use super::{Bounds, LANES, Lanes, Leaf, Neighbours, Node, larger};

/// Error of a coordinate along a tilted axis, as a share of the sum of the coordinates' magnitudes.
const MARGIN: f32 = 4.0 * f32::EPSILON;

/// Error of a squared distance, as a share of it.
const SHRINK: f32 = 16.0 * f32::EPSILON;

/// Largest magnitude of coordinates, in metres: differences and their squares stay far from overflow.
pub const FARTHEST: f32 = 1e15;

/// Smallest width of a box, in metres: margins stay far from underflow.
const NARROWEST: f32 = 1e-15;

/// Box along three axes of its own, about a centre.
pub struct Tilted {
    centre: [f32; 3],
    axes: [[f32; 3]; 3],
    /// Along each axis from the centre, in metres, with the margin.
    low: [f32; 3],
    high: [f32; 3],
}

impl Tilted {
    /// Box around `leaves`, whose box along the coordinate axes is `bounds`; without limits where `f32` is at its own.
    #[inline(always)]
    fn around(leaves: &[Leaf], bounds: &Bounds) -> Self {
        let centre: [f32; 3] = std::array::from_fn(|k| 0.5 * bounds.low[k] + 0.5 * bounds.high[k]);
        let width = (0..3).map(|k| bounds.high[k] - bounds.low[k]).fold(0.0, f32::max);
        let farthest = bounds.low.iter().chain(&bounds.high).fold(0.0, |m: f32, v| m.max(v.abs()));
        if width < NARROWEST || farthest > FARTHEST {
            let nothing = [0.0; 3];
            return Self { centre: nothing, axes: [nothing; 3], low: nothing, high: nothing };
        }
        let axes = axes(&sample(leaves)).map(|axis| axis.as_vec3().to_array());
        let (mut low, mut high) = ([0.0; 3], [0.0; 3]);
        for (k, axis) in axes.iter().enumerate() {
            let mut least: Lanes = [f32::INFINITY; LANES];
            let mut most: Lanes = [f32::NEG_INFINITY; LANES];
            for leaf in leaves {
                for i in 0..LANES {
                    let from_centre = std::array::from_fn(|k| leaf.at[k][i] - centre[k]);
                    let along = dot(axis, from_centre);
                    least[i] = if along < least[i] { along } else { least[i] };
                    most[i] = larger(along, most[i]);
                }
            }
            low[k] = least.into_iter().fold(f32::INFINITY, f32::min) - 2.0 * MARGIN * width;
            high[k] = most.into_iter().fold(f32::NEG_INFINITY, f32::max) + 2.0 * MARGIN * width;
        }
        Self { centre, axes, low, high }
    }

    /// No more than the squared distance, as `f32` computes it, from `q` to any point inside, for coordinates up to
    /// [`FARTHEST`].
    #[inline(always)]
    pub fn lower_bound(&self, q: [f32; 3]) -> f32 {
        let v: [f32; 3] = std::array::from_fn(|k| q[k] - self.centre[k]);
        let margin = MARGIN * (v[0].abs() + v[1].abs() + v[2].abs());
        let square = |k: usize| {
            let along = dot(&self.axes[k], v);
            let gap = larger(larger(self.low[k] - along, along - self.high[k]) - margin, 0.0);
            gap * gap
        };
        (square(0) + square(1) + square(2)) * (1.0 - SHRINK) - f32::MIN_POSITIVE
    }
}

#[inline(always)]
fn dot(a: &[f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Points spread evenly over the leaves.
fn sample(leaves: &[Leaf]) -> [DVec3; LANES] {
    std::array::from_fn(|i| {
        let at = &leaves[i * leaves.len() / LANES].at;
        DVec3::new(at[0][i].into(), at[1][i].into(), at[2][i].into())
    })
}

/// Orthonormal axes: the longest extent, the longest across it, and the normal of both.
///
/// Any axes are sound; these find a line or a sheet in three rounds over few points.
fn axes(points: &[DVec3; LANES]) -> [DVec3; 3] {
    let farthest = |key: &dyn Fn(DVec3) -> f64| {
        points.iter().copied().max_by(|&a, &b| key(a).total_cmp(&key(b))).expect("a leaf has points")
    };
    let a = farthest(&|p| p.distance_squared(points[0]));
    let b = farthest(&|p| p.distance_squared(a));
    let Some(along) = (b - a).try_normalize() else { return DVec3::AXES };
    let across = |p: DVec3| (p - a).reject_from_normalized(along);
    let c = across(farthest(&|p| across(p).length_squared()));
    // What is left of points on a line is rounding and need not be at right angles.
    let side = if c.length() > 1e-9 * (b - a).length() {
        c.reject_from_normalized(along).normalize()
    } else {
        along.any_orthonormal_vector()
    };
    [along, side, along.cross(side)]
}

/// Builds the tilted boxes of a whole tree.
pub struct Enclose<'a> {
    pub tree: &'a Neighbours,
}

impl WithSimd for Enclose<'_> {
    type Output = Vec<Tilted>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> Vec<Tilted> {
        let Neighbours { leaves, boxes, .. } = self.tree;
        let mut tilted = Vec::with_capacity(boxes.len());
        let mut stack = vec![Node { number: 0, first: 0, count: leaves.len() }];
        // Left before right, which is the order of the numbers.
        while let Some(node) = stack.pop() {
            tilted.push(Tilted::around(&leaves[node.first..node.first + node.count], &boxes[node.number]));
            if node.count > 1 {
                let [left, right] = node.children();
                stack.extend([right, left]);
            }
        }
        tilted
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{directions, distance, random};
    use super::*;

    #[test]
    fn bounds_never_exceed_distances() {
        let mut next = random(5);
        for case in 0..60 {
            // A sheet of any tilt, thickness, size and place, and queries from inside it to far away.
            let (size, away) = (10f32.powf(6.0 * next() - 3.0), 10f32.powf(8.0 * next() - 4.0));
            let thickness = if case % 2 == 0 { 0.0 } else { size * 10f32.powf(-6.0 * next()) };
            let frame = directions(3, case);
            let place: [f32; 3] = std::array::from_fn(|_| (next() - 0.5) * 10.0 * size);
            let points: Vec<[f32; 3]> = (0..4 * LANES)
                .map(|_| {
                    let along = [size * next(), size * next(), thickness * next()];
                    std::array::from_fn(|k| place[k] + (0..3).map(|i| along[i] * frame[i][k]).sum::<f32>())
                })
                .collect();
            let tree = Neighbours::new(&points).expect("points");
            let tilted = &tree.tilted()[0];
            // Straight off a side of the box, the bound comes as close to the distance as it ever does.
            let straight = tilted.axes.iter().flat_map(|axis| [*axis, axis.map(|v| -v)]);
            for direction in straight.chain(directions(10, 1000 + case)) {
                for start in &points {
                    let q: [f32; 3] = std::array::from_fn(|k| start[k] + away * direction[k]);
                    let nearest = points.iter().map(|p| distance(p, &q)).fold(f32::INFINITY, f32::min);
                    let bound = tilted.lower_bound(q);
                    assert!(bound <= nearest, "case {case}: {bound} > {nearest}");
                }
            }
        }
    }

    #[test]
    fn a_slanted_sheet_is_thin() {
        let mut next = random(6);
        let mut point = || {
            let (x, y) = (next(), next());
            [x, y, 0.5 * x - 0.7 * y]
        };
        let points: Vec<[f32; 3]> = (0..1000).map(|_| point()).collect();
        let tree = Neighbours::new(&points).expect("points");
        let normal = [-0.5, 0.7, 1.0].map(|v: f32| v / 1.74f32.sqrt());
        let q: [f32; 3] = std::array::from_fn(|k| points[0][k] + 2.0 * normal[k]);
        assert!(tree.boxes[0].lower_bound(q) < 2.5, "a box along the coordinate axes is deep");
        assert!(tree.tilted()[0].lower_bound(q) > 3.9999);
    }
}
