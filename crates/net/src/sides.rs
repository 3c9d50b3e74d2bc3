//! Colours for the unseen sides: every side point takes the colour of the nearest front or back point (SNAPSNAP §7).

use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// Value of a side pixel without a point.
pub const EMPTY: f32 = -1.0;

/// Coloured points that side points look themselves up in.
pub struct Cloud {
    tree: ImmutableKdTree<f32, 3>,
    colors: Vec<[f32; 3]>,
}

impl Cloud {
    /// Puts points (metres) and their colours together; points that are not finite are left out.
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

    /// Colour of the exact nearest neighbour (squared Euclidean distance) of each finite point, on all cores.
    pub fn nearest_colors(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let nearest = self.tree.query_batch(points).nearest_one::<SquaredEuclidean<f32>>().execute();
        nearest.iter().map(|found| self.colors[found.item as usize]).collect()
    }
}

/// Whether all three coordinates are finite.
pub fn is_finite(p: &[f32; 3]) -> bool {
    p.iter().all(|v| v.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngCore, SeedableRng};

    fn random_points(n: usize, seed: u64) -> Vec<[f32; 3]> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let mut next = || random.next_u32() as f32 / u32::MAX as f32;
        (0..n).map(|_| [next(), next(), next()]).collect()
    }

    #[test]
    fn neighbours_are_exact() {
        let (points, queries) = (random_points(3000, 1), random_points(500, 2));
        let cloud = Cloud::new(points.iter().map(|&p| (p, p))).expect("points");
        let distance =
            |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
        for (query, found) in queries.iter().zip(cloud.nearest_colors(&queries)) {
            let best = points.iter().map(|p| distance(p, query)).fold(f32::INFINITY, f32::min);
            assert!(distance(&found, query) <= best * (1.0 + 1e-6), "{query:?}");
        }
    }

    #[test]
    fn identical_and_non_finite_points_do_no_harm() {
        let same = std::iter::repeat_n(([1.0, 2.0, 3.0], [0.5; 3]), 5000);
        let bad = [([f32::NAN, 0.0, 0.0], [0.0; 3]), ([f32::INFINITY; 3], [0.0; 3])];
        let cloud = Cloud::new(same.chain(bad)).expect("points");
        assert_eq!(cloud.len(), 5000);
        assert_eq!(cloud.nearest_colors(&[[0.0; 3], [1e30; 3]]), vec![[0.5; 3]; 2]);
        assert!(Cloud::new(bad.into_iter()).is_none());
    }
}
