//! Colours of the unseen sides: every side point takes the colour of the nearest front or back point, or the most usual
//! colour around this point (docs/method.md, "Side colours").

use std::num::NonZeroUsize;

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// Value of a side pixel without a point.
pub(crate) const EMPTY: f32 = -1.0;
/// Distance in metres up to which the exact nearest neighbour is found. A k-d tree visits most of its points for a
/// query that is far from all of them, so that farther queries use a thinned cloud.
const NEAR: f32 = 0.05;
/// Least number of points in a thinned cloud.
const THINNED: usize = 20_000;

/// Number of nearest points among which a colour is the most usual one.
const NEIGHBOURS: NonZeroUsize = NonZeroUsize::new(45).expect("is not 0");

/// Coloured points for nearest-neighbour search.
struct Cloud {
    tree: ImmutableKdTree<f32, 3>,
    points: Vec<[f32; 3]>,
    colors: Vec<[f32; 3]>,
    /// Every `step`-th point, for queries farther than [`NEAR`].
    thinned: ImmutableKdTree<f32, 3>,
    step: usize,
}

impl Cloud {
    /// A cloud of points (metres) with colours. Points that are not finite are left out.
    ///
    /// `None` if no finite point is left.
    fn new(points: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Option<Self> {
        let (points, colors): (Vec<[f32; 3]>, Vec<_>) =
            points.filter(|(p, _)| Vec3::from(*p).is_finite()).unzip();
        if points.is_empty() {
            return None;
        }
        let step = (points.len() / THINNED).max(1);
        let some = points.iter().copied().step_by(step).collect::<Vec<_>>();
        let [tree, thinned] = [&points, &some]
            .map(|points| ImmutableKdTree::new_from_slice(points).expect("fewer points than u32 can number"));
        Some(Self { tree, points, colors, thinned, step })
    }

    /// The nearest neighbour of each point (metres), on all cores; `None` for points that are not finite.
    fn nearest(&self, points: &[[f32; 3]]) -> Vec<Option<usize>> {
        let mut rows = vec![None; points.len()];
        let mut left: Vec<usize> = (0..points.len()).filter(|i| Vec3::from(points[*i]).is_finite()).collect();
        for (tree, distance, step) in [(&self.tree, NEAR, 1), (&self.thinned, f32::INFINITY, self.step)] {
            let queries: Vec<[f32; 3]> = left.iter().map(|i| points[*i]).collect();
            let found = tree.query_batch(&queries).nearest_n::<SquaredEuclidean<f32>>(NonZeroUsize::MIN);
            let found = found.within(distance * distance).execute();
            let mut nearest = found.iter().map(|found| found.first());
            left.retain(|i| match nearest.next().flatten() {
                Some(found) => {
                    rows[*i] = Some(step * found.item as usize);
                    false
                }
                None => true,
            });
        }
        rows
    }

    /// The colours of these rows of the cloud, each replaced by the most usual colour around it: of the nearest
    /// points' colours, the one nearest to the median of each channel.
    fn usual_colors(&self, rows: &[usize]) -> Vec<[f32; 3]> {
        let queries: Vec<[f32; 3]> = rows.iter().map(|row| self.points[*row]).collect();
        let found = self.tree.query_batch(&queries).nearest_n::<SquaredEuclidean<f32>>(NEIGHBOURS);
        let found = found.within(NEAR * NEAR).execute();
        let color = |row: usize| Vec3::from(self.colors[row]);
        let near = found.iter().map(|found| found.iter().map(|found| color(found.item as usize)).collect());
        let near: Vec<Vec<Vec3>> = near.collect();
        let usual = |(near, row): (&Vec<Vec3>, &usize)| {
            let median = median(near).unwrap_or_default();
            let apart = |color: &&Vec3| color.distance_squared(median);
            near.iter()
                .min_by(|a, b| apart(a).total_cmp(&apart(b)))
                .map_or(self.colors[*row], |c| c.to_array())
        };
        near.par_iter().zip(rows).map(usual).collect()
    }
}

/// The median of each channel; `None` without colours.
pub fn median(colors: &[Vec3]) -> Option<Vec3> {
    let channel = |c: usize| {
        let mut values: Vec<f32> = colors.iter().map(|color| color[c]).collect();
        *values.select_nth_unstable_by(colors.len() / 2, f32::total_cmp).1
    };
    (!colors.is_empty()).then(|| Vec3::new(channel(0), channel(1), channel(2)))
}

/// Pseudo images of the sides' maps `[3, S, S]`: every valid pixel has the colour of the nearest valid point of the
/// photographs `[3, S, S]`, or the most usual colour around this point, `is_usual`: pixels of a mask's rim may show the
/// background. `points` `[V, S, S, 3]` are the points of all views.
pub fn side_images(
    photos: [&[f32]; 2],
    points: &[f32],
    valid: &[Vec<bool>],
    is_usual: bool,
) -> Vec<Vec<f32>> {
    let area = valid[0].len();
    let points = points.as_chunks::<3>().0;
    let point = |view: usize, i: usize| -> [f32; 3] { points[view * area + i] };
    let seen = (0..2).flat_map(|view| {
        let (photo, mask) = (photos[view], &valid[view]);
        let color = move |i: usize| [photo[i], photo[area + i], photo[2 * area + i]];
        (0..area).filter(|&i| mask[i]).map(move |i| (point(view, i), color(i)))
    });
    let cloud = Cloud::new(seen);
    (2..valid.len()).map(|view| paint(cloud.as_ref(), |i| point(view, i), &valid[view], is_usual)).collect()
}

fn paint(
    cloud: Option<&Cloud>,
    point: impl Fn(usize) -> [f32; 3],
    valid: &[bool],
    is_usual: bool,
) -> Vec<f32> {
    let area = valid.len();
    let mut image = vec![EMPTY; 3 * area];
    let Some(cloud) = cloud else { return image };
    let pixels: Vec<usize> = (0..area).filter(|&i| valid[i]).collect();
    let points: Vec<[f32; 3]> = pixels.iter().map(|&i| point(i)).collect();
    let rows = cloud.nearest(&points);
    // Many pixels share a neighbour.
    let mut used: Vec<usize> = rows.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let colors = match is_usual {
        true => cloud.usual_colors(&used),
        false => used.iter().map(|row| cloud.colors[*row]).collect(),
    };
    for (&i, row) in pixels.iter().zip(rows) {
        let Some(place) = row.and_then(|row| used.binary_search(&row).ok()) else { continue };
        for (channel, value) in colors[place].into_iter().enumerate() {
            image[channel * area + i] = value;
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The points of a line, each with its place as its colour.
    #[test]
    fn far_points_have_a_neighbour_near_the_nearest() {
        let line = (0..100_000).map(|i| i as f32 * 1e-5);
        let cloud = Cloud::new(line.map(|x| ([x, 0.0, 0.0], [x; 3]))).expect("points");
        let found = cloud.nearest(&[[0.30001, 0.04, 0.0], [0.30001, 0.2, 0.0]]);
        let found: Vec<f32> = found.into_iter().flatten().map(|row| cloud.colors[row][0]).collect();
        assert!((found[0] - 0.30001).abs() < 1e-6 && (found[1] - 0.30001).abs() <= 5e-5, "{found:?}");
        // Neighbours' colours rise along the line. A speck has the colour of its surroundings.
        let usual = cloud.usual_colors(&[50_000])[0][0];
        assert!((usual - 0.5).abs() < 5e-4, "{usual}");
        let mut specked = cloud;
        specked.colors[50_000] = [9.0; 3];
        let usual = specked.usual_colors(&[50_000])[0][0];
        assert!((usual - 0.5).abs() < 5e-4, "{usual}");
    }

    #[test]
    fn identical_and_non_finite_points_do_no_harm() {
        let same = std::iter::repeat_n(([1.0, 2.0, 3.0], [0.5; 3]), 5000);
        let bad = [([f32::NAN, 0.0, 0.0], [0.0; 3]), ([f32::INFINITY; 3], [0.0; 3])];
        let cloud = Cloud::new(bad.into_iter().chain(same)).expect("points");
        assert_eq!(cloud.colors.len(), 5000);
        let queries = [[1.0, 2.0, 3.1], [1e15; 3], [f32::NAN; 3], [f32::NEG_INFINITY; 3]];
        let found: Vec<bool> = cloud.nearest(&queries).iter().map(Option::is_some).collect();
        assert_eq!(found, [true, true, false, false]);
        assert_eq!(cloud.usual_colors(&[7]), [[0.5; 3]]);
        assert!(Cloud::new(bad.into_iter()).is_none());
    }
}
