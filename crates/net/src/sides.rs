//! Colours of the unseen sides: every side point takes the colour of the nearest front or back point
//! (docs/method.md, "Side colours").

use crate::neighbours::Neighbours;

/// Value of a side pixel without a point.
pub const EMPTY: f32 = -1.0;

/// Coloured points among which the nearest of each side point is found.
pub struct Cloud {
    neighbours: Neighbours,
    colors: Vec<[f32; 3]>,
}

impl Cloud {
    /// A cloud of points (metres) with colours. Points that are not finite are left out.
    ///
    /// `None` if no finite point is left.
    ///
    /// # Panics
    /// With more points than `u32` can number.
    pub fn new(points: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Option<Self> {
        let (points, colors): (Vec<[f32; 3]>, Vec<_>) = points.filter(|(p, _)| is_finite(p)).unzip();
        Some(Self { neighbours: Neighbours::new(&points)?, colors })
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.colors.len()
    }

    /// Whether there is no point; never true.
    pub fn is_empty(&self) -> bool {
        self.colors.is_empty()
    }

    /// Colour of the exact nearest neighbour of each point (metres), on all cores.
    ///
    /// Among neighbours at the same squared distance in f32, `(dx² + dy²) + dz²`, the first one wins, also for points that
    /// are not finite or so far away that all squared distances overflow.
    pub fn nearest_colors(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.neighbours.nearest(points).into_iter().map(|row| self.colors[row as usize]).collect()
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
    fn colours_come_from_the_nearest_point_and_from_the_first_of_equals() {
        let points = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-1.0, 0.0, 0.0]];
        let cloud =
            Cloud::new(points.into_iter().zip([[0.1; 3], [0.2; 3], [0.3; 3], [0.4; 3]])).expect("points");
        let queries = [[0.0, 2.9, 0.0], [0.0, 0.0, 5.0], [-0.5, 0.0, 0.0]];
        assert_eq!(cloud.nearest_colors(&queries), [[0.3; 3], [0.1; 3], [0.2; 3]]);
    }

    #[test]
    fn identical_and_non_finite_points_do_no_harm() {
        let same = std::iter::repeat_n(([1.0, 2.0, 3.0], [0.5; 3]), 5000);
        let bad = [([f32::NAN, 0.0, 0.0], [0.0; 3]), ([f32::INFINITY; 3], [0.0; 3])];
        let cloud = Cloud::new(bad.into_iter().chain(same)).expect("points");
        assert_eq!(cloud.len(), 5000);
        let queries = [[0.0; 3], [1e30; 3], [f32::NAN; 3], [f32::NEG_INFINITY; 3]];
        assert_eq!(cloud.nearest_colors(&queries), [[0.5; 3]; 4]);
        assert!(Cloud::new(bad.into_iter()).is_none());
    }
}
