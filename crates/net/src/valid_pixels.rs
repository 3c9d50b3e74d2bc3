//! Which pixels become Gaussians.

use glam::Vec3;

use crate::config::{Config, RegressorStart};
use crate::hull::Hull;
use crate::network::pixel_width;
use crate::points::Points;

/// Largest distance between the points of neighbouring pixels, in pixel widths at the person's distance. Points
/// farther apart lie between two surfaces. A steeper surface is seen from the sides.
pub(crate) const STEEPEST: f32 = 4.0;

/// The pixels of each view that become Gaussians.
pub(crate) struct Chosen {
    /// `[S, S]` of every view.
    pub valid: Vec<Vec<bool>>,
    /// Pixels left out because their points are not finite.
    pub lost: usize,
    /// Pixels of the sides left out because they lie outside of the photographs' silhouettes.
    pub outside: usize,
    /// Pixels left out because their points lie between two surfaces.
    pub between: usize,
}

impl Chosen {
    /// Selects pixels of photographs by their masks `[S, S]`, and pixels of the sides by their confidences and points.
    pub fn new(config: &Config, masks: [&[bool]; 2], points: &Points) -> Self {
        let Points { host: points, conf, .. } = points;
        let is_geometric = config.regressor.start() == RegressorStart::Geometric;
        let config = &config.network;
        let (side, area) = (config.resolution, config.resolution * config.resolution);
        let views = conf.len() / area;
        let hull = config.hull_margin.filter(|_| views > 2);
        let hull = hull.map(|margin| Hull::new(masks, side, margin * side / 1024));
        let (mut lost, mut outside) = (0, 0);
        let mut keep = |view: usize, i: usize| {
            let at = view * area + i;
            let is_chosen = match masks.get(view) {
                Some(mask) => mask[i],
                None => conf[at] > config.conf_threshold,
            };
            if !is_chosen {
                return false;
            }
            let point = [points[3 * at], points[3 * at + 1], points[3 * at + 2]];
            if !Vec3::from(point).is_finite() {
                lost += 1;
                return false;
            }
            let is_inside = view < 2 || hull.as_ref().is_none_or(|hull| hull.contains(point));
            outside += usize::from(!is_inside);
            is_inside
        };
        let mut valid: Vec<Vec<bool>> =
            (0..views).map(|view| (0..area).map(|i| keep(view, i)).collect()).collect();
        let mut between = 0;
        if is_geometric {
            for (view, points) in valid.iter_mut().zip(points.chunks_exact(3 * area)) {
                between += without_steep(view, points, side, STEEPEST);
            }
        }
        Self { valid, lost, outside, between }
    }
}

/// Makes pixels of a view invalid whose points `[S, S, 3]`, metres, are farther from a neighbour's point than
/// `steepest` times the width of a pixel at the person's distance. Returns the number of these pixels.
pub(crate) fn without_steep(valid: &mut [bool], points: &[f32], side: usize, steepest: f32) -> usize {
    let farthest = (steepest * pixel_width(side)).powi(2);
    let point = |i: usize| Vec3::from_slice(&points[3 * i..]);
    let mut steep = vec![false; valid.len()];
    for i in (0..valid.len()).filter(|&i| valid[i]) {
        for j in [(i % side + 1 < side).then_some(i + 1), Some(i + side)].into_iter().flatten() {
            if valid.get(j) == Some(&true) && point(i).distance_squared(point(j)) > farthest {
                (steep[i], steep[j]) = (true, true);
            }
        }
    }
    valid.iter_mut().zip(&steep).for_each(|(valid, steep)| *valid &= !steep);
    steep.into_iter().filter(|steep| *steep).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall at two metres, half of which is a metre closer. The pixels along the step lie between both.
    #[test]
    fn points_between_two_surfaces_are_left_out() {
        let side = 8;
        let point = |i: usize| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            [0.3 * x, 0.3 * y, if x < 4.0 { 1.0 } else { 2.0 }]
        };
        let points: Vec<f32> = (0..64).flat_map(point).collect();
        // A pixel is 31 cm wide. The step is 3.4 times as long. From the end of a row to the next row it is 7 times.
        for (steepest, step) in [(3.0, true), (4.0, false)] {
            let mut valid = vec![true; 64];
            valid[3] = false;
            let lost = without_steep(&mut valid, &points, side, steepest);
            let kept = |i: usize| i != 3 && !(step && i > 7 && matches!(i % side, 3 | 4));
            assert_eq!(valid, (0..64).map(kept).collect::<Vec<_>>());
            assert_eq!(lost, if step { 14 } else { 0 });
        }
    }
}
