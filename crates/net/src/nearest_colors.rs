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

/// Pixels to each side of a photograph's pixel among which a colour is the most usual one. A third of the
/// rows and columns is enough.
const REACH: usize = 6;
const STEP: usize = 3;

/// Points for nearest-neighbour search.
struct Cloud {
    tree: ImmutableKdTree<f32, 3>,
    /// Every `step`-th point, for queries farther than [`NEAR`].
    thinned: ImmutableKdTree<f32, 3>,
    step: usize,
}

impl Cloud {
    /// A cloud of finite points (metres). `None` if there is no point.
    fn new(points: &[[f32; 3]]) -> Option<Self> {
        if points.is_empty() {
            return None;
        }
        let step = (points.len() / THINNED).max(1);
        let some = points.iter().copied().step_by(step).collect::<Vec<_>>();
        let [tree, thinned] = [points, &some]
            .map(|points| ImmutableKdTree::new_from_slice(points).expect("fewer points than u32 can number"));
        Some(Self { tree, thinned, step })
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
/// photographs `[3, S, S]`, or the most usual colour around this point's pixel, `is_usual`: pixels of a mask's rim may
/// show the background. `points` `[V, S, S, 3]` are the points of all views.
pub fn side_images(
    photos: [&[f32]; 2],
    points: &[f32],
    valid: &[Vec<bool>],
    is_usual: bool,
) -> Vec<Vec<f32>> {
    let area = valid[0].len();
    let points = points.as_chunks::<3>().0;
    let seen = (0..2 * area).filter(|&i| valid[i / area][i % area] && Vec3::from(points[i]).is_finite());
    let seen: Vec<usize> = seen.collect();
    let cloud = Cloud::new(&seen.iter().map(|&i| points[i]).collect::<Vec<_>>());
    let color = |i: usize| Vec3::from([0, 1, 2].map(|c| photos[i / area][c * area + i % area]));
    let paint = |view: usize| {
        let mut image = vec![EMPTY; 3 * area];
        let Some(cloud) = &cloud else { return image };
        let pixels: Vec<usize> = (0..area).filter(|&i| valid[view][i]).collect();
        let queries: Vec<[f32; 3]> = pixels.iter().map(|&i| points[view * area + i]).collect();
        let rows = cloud.nearest(&queries);
        // Many pixels share a neighbour.
        let mut used: Vec<usize> = rows.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let of_row = |&row: &usize| match is_usual {
            true => usual_color(seen[row], points, valid, color),
            false => color(seen[row]),
        };
        let colors: Vec<Vec3> = used.par_iter().map(of_row).collect();
        for (i, row) in pixels.into_iter().zip(rows) {
            let Some(place) = row.and_then(|row| used.binary_search(&row).ok()) else { continue };
            for channel in 0..3 {
                image[channel * area + i] = colors[place][channel];
            }
        }
        image
    };
    (2..valid.len()).map(paint).collect()
}

/// The most usual colour of the surface around a photograph's pixel: of the colours of the pixels whose points are
/// near its own, the one nearest to the median of each channel.
fn usual_color(
    pixel: usize,
    points: &[[f32; 3]],
    valid: &[Vec<bool>],
    color: impl Fn(usize) -> Vec3,
) -> Vec3 {
    let area = valid[0].len();
    let (view, side) = (pixel / area, area.isqrt());
    let (x, y) = (pixel % area % side, pixel % area / side);
    let around = |at: usize| (at.saturating_sub(REACH)..(at + REACH + 1).min(side)).step_by(STEP);
    let point = |i: usize| Vec3::from(points[i]);
    let near: Vec<Vec3> = around(y)
        .flat_map(|y| around(x).map(move |x| y * side + x))
        .filter(|&i| valid[view][i] && point(view * area + i).distance_squared(point(pixel)) <= NEAR * NEAR)
        .map(|i| color(view * area + i))
        .collect();
    let median = median(&near).unwrap_or_default();
    let apart = |color: &Vec3| color.distance_squared(median);
    near.into_iter().min_by(|a, b| apart(a).total_cmp(&apart(b))).unwrap_or_else(|| color(pixel))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_points_have_a_neighbour_near_the_nearest() {
        let line: Vec<[f32; 3]> = (0..100_000).map(|i| [i as f32 * 1e-5, 0.0, 0.0]).collect();
        let cloud = Cloud::new(&line).expect("points");
        let found = cloud.nearest(&[[0.30001, 0.04, 0.0], [0.30001, 0.2, 0.0]]);
        let found: Vec<f32> = found.into_iter().flatten().map(|row| line[row][0]).collect();
        assert!((found[0] - 0.30001).abs() < 1e-6 && (found[1] - 0.30001).abs() <= 5e-5, "{found:?}");
    }

    #[test]
    fn a_speck_has_the_color_of_its_surroundings() {
        // A wall of 32² pixels, 2 mm apart, whose red rises to the right, with a blue speck and a far pixel beside it.
        let (side, area, speck) = (32, 1024, 16 * 32 + 16);
        let mut points: Vec<f32> =
            (0..area).flat_map(|i| [i % side, i / side, 0].map(|v| v as f32 * 2e-3)).collect();
        points[3 * (speck + 1) + 2] = 1.0;
        let mut photo: Vec<f32> = (0..area).map(|i| (i % side) as f32 / 32.0).collect();
        photo.extend(vec![0.0; 2 * area]);
        for (channel, value) in [9.0, 9.0, -9.0].into_iter().enumerate() {
            photo[channel * area + speck] = value;
            photo[channel * area + speck + 1] = -value;
        }
        let (all, none) = (vec![true; area], vec![false; area]);
        let mut asked = none.clone();
        asked[speck] = true;
        let points = [&points[..], &points, &points].concat();
        let of = |is_usual: bool| {
            let images =
                side_images([&photo, &photo], &points, &[all.clone(), none.clone(), asked.clone()], is_usual);
            assert_eq!(images[0][0], EMPTY);
            [0, 1, 2].map(|c| images[0][c * area + speck])
        };
        assert_eq!(of(false), [9.0, 9.0, -9.0]);
        let [red, green, blue] = of(true);
        assert!((red - 0.5).abs() <= 1.0 / 32.0 && green == 0.0 && blue == 0.0, "{red} {green} {blue}");
    }

    #[test]
    fn identical_and_non_finite_points_do_no_harm() {
        let cloud = Cloud::new(&[[1.0, 2.0, 3.0]; 5000]).expect("points");
        let queries = [[1.0, 2.0, 3.1], [1e15; 3], [f32::NAN; 3], [f32::NEG_INFINITY; 3]];
        let found: Vec<bool> = cloud.nearest(&queries).iter().map(Option::is_some).collect();
        assert_eq!(found, [true, true, false, false]);
        // A photograph of points that are not finite colours nothing.
        let images = side_images([&[0.5; 3]; 2], &[f32::NAN; 9], &vec![vec![true]; 3], true);
        assert_eq!(images, [[EMPTY; 3]]);
    }
}
