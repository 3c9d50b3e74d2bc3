//! Colours of the unseen sides: every side point takes the colour of the nearest front or back point
//! (docs/method.md, "Side colours").

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;

use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// Value of a side pixel without a point, or far from every photographed one.
pub const EMPTY: f32 = -1.0;
/// Distance in metres beyond which a point takes no colour: it is no part of the photographed person.
pub const FARTHEST: f32 = 0.5;
/// Distance in metres up to which the neighbour is the nearest of all. Farther from all points, a k-d tree visits most of them, and the
/// points of a cube of [`CUBE`] metres share the neighbour of its middle.
const NEAR: f32 = 0.05;
const CUBE: f32 = 0.005;

/// Coloured points among which the nearest of each side point is found.
pub struct Cloud {
    tree: ImmutableKdTree<f32, 3>,
    colors: Vec<[f32; 3]>,
}

impl Cloud {
    /// A cloud of points (metres) with colours. Points that are not finite are left out.
    ///
    /// `None` if no finite point is left.
    pub fn new(points: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Option<Self> {
        let (points, colors): (Vec<[f32; 3]>, Vec<_>) = points.filter(|(p, _)| is_finite(p)).unzip();
        if points.is_empty() {
            return None;
        }
        let tree = ImmutableKdTree::new_from_slice(&points).expect("fewer points than u32 can number");
        Some(Self { tree, colors })
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.colors.len()
    }

    /// Whether there is no point; never true.
    pub fn is_empty(&self) -> bool {
        self.colors.is_empty()
    }

    /// Colour of the nearest neighbour of each point (metres), on all cores; [`EMPTY`] for points that are not finite or farther than
    /// [`FARTHEST`] from all.
    pub fn nearest_colors(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        // What is not finite is far from everything.
        let safe = points.iter().map(|p| if is_finite(p) { *p } else { [f32::MAX; 3] }).collect::<Vec<_>>();
        let mut found = self.within(&safe, NEAR);
        let cube = |p: &[f32; 3]| p.map(|v| (v / CUBE).floor() as i32);
        let far = || (0..safe.len()).filter(|i| found[*i].is_none());
        let cubes: BTreeSet<[i32; 3]> = far().map(|i| cube(&safe[i])).collect();
        let middles = cubes.iter().map(|cube| cube.map(|v| CUBE * (v as f32 + 0.5))).collect::<Vec<_>>();
        let of_cubes: BTreeMap<_, _> = cubes.iter().zip(self.within(&middles, FARTHEST)).collect();
        for i in far().collect::<Vec<_>>() {
            found[i] = of_cubes[&cube(&safe[i])];
        }
        found.into_iter().map(|row| row.map_or([EMPTY; 3], |row| self.colors[row as usize])).collect()
    }

    /// The rows of the nearest neighbours of points that have one within a distance in metres.
    fn within(&self, points: &[[f32; 3]], distance: f32) -> Vec<Option<u32>> {
        let found = self.tree.query_batch(points).nearest_n::<SquaredEuclidean<f32>>(NonZeroUsize::MIN);
        let found = found.within(distance * distance).execute();
        found.iter().map(|found| found.first().map(|found| found.item)).collect()
    }
}

/// Whether all three coordinates are finite.
pub fn is_finite(p: &[f32; 3]) -> bool {
    p.iter().all(|v| v.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_come_from_the_nearest_point_within_half_a_metre() {
        let points = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 3.0, 0.0]];
        let cloud = Cloud::new(points.into_iter().zip([[0.1; 3], [0.2; 3], [0.3; 3]])).expect("points");
        let queries =
            [[0.0, 2.9, 0.0], [0.0, 0.0, 5.0], [-0.6, 0.2, 0.0], [1.49, 0.0, 0.0], [1.51, 0.0, 0.0]];
        assert_eq!(cloud.nearest_colors(&queries), [[0.3; 3], [EMPTY; 3], [0.2; 3], [0.1; 3], [EMPTY; 3]]);
    }

    #[test]
    fn identical_and_non_finite_points_do_no_harm() {
        let same = std::iter::repeat_n(([1.0, 2.0, 3.0], [0.5; 3]), 5000);
        let bad = [([f32::NAN, 0.0, 0.0], [0.0; 3]), ([f32::INFINITY; 3], [0.0; 3])];
        let cloud = Cloud::new(bad.into_iter().chain(same)).expect("points");
        assert_eq!(cloud.len(), 5000);
        let queries = [[1.0, 2.0, 3.1], [1e30; 3], [f32::NAN; 3], [f32::NEG_INFINITY; 3]];
        assert_eq!(cloud.nearest_colors(&queries), [[0.5; 3], [EMPTY; 3], [EMPTY; 3], [EMPTY; 3]]);
        assert!(Cloud::new(bad.into_iter()).is_none());
    }
}
