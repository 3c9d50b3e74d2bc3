//! Alignment of reconstructions that are not in the world frame, by iterative closest point (Besl & McKay 1992).

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4};
use serde::{Deserialize, Serialize};
use snapsnap_splat::RigidTransform;

use super::{check_points, double, nearest};
use crate::Result;

/// Number of points that are aligned. The truth has ten times as many.
pub(crate) const ALIGNED: usize = 5_000;
/// Largest number of steps.
const MOST: usize = 100;
/// Least relative decrease of the mean squared distance in a step.
const ENOUGH: f64 = 1e-6;

/// Alignment of reconstructions with the ground truth before they are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Align {
    /// No alignment.
    #[default]
    None,
    /// Rotation and translation.
    Rigid,
    /// Rotation, translation and scale.
    Similarity,
}

impl Align {
    /// Name of the method in reports.
    pub fn description(self) -> &'static str {
        ["none", "rigid, by iterated closest points", "rigid and scale, by iterated closest points"]
            [self as usize]
    }
}

/// x ↦ scale · rotation · x + translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// 1 for rigid motions.
    pub scale: f64,
    /// A proper rotation.
    pub rotation: DQuat,
    /// In the unit of the points.
    pub translation: DVec3,
    /// Mean squared distance to the nearest neighbour after the motion.
    pub cost: f64,
}

impl Alignment {
    /// The moved point.
    pub fn apply(&self, point: [f32; 3]) -> [f32; 3] {
        (self.scale * (self.rotation * double(point)) + self.translation).as_vec3().to_array()
    }

    /// The rigid part, for points that are scaled already.
    pub fn rigid(&self) -> RigidTransform {
        RigidTransform { rotation: DMat3::from_quat(self.rotation), translation: self.translation }
    }

    /// Rotation in degrees, shift of the points' mean in hundredths of their unit, and scale.
    pub fn figures(&self, points: &[[f32; 3]]) -> [f64; 3] {
        let angle = 2.0 * self.rotation.w.abs().min(1.0).acos();
        // `translation` depends on the world's origin, the shift of the mean does not.
        let middle = points.iter().map(|p| double(*p)).sum::<DVec3>() / points.len() as f64;
        let moved = self.scale * (self.rotation * middle) + self.translation - middle;
        [angle.to_degrees(), 1e2 * moved.length(), self.scale]
    }
}

/// Motion of `points` onto `onto`. Each step pairs every point with its nearest neighbour and finds the best rigid
/// motion of the pairs (with `scale`: the best similarity). The result is the nearest minimum, so the initial error
/// must be below some 30° and a quarter of the size.
///
/// # Errors
/// [`EvalError::Message`](crate::EvalError::Message) for a set without points or with one that is not finite.
pub fn icp(points: &[[f32; 3]], onto: &[[f32; 3]], scale: bool) -> Result<Alignment> {
    check_points(points)?;
    check_points(onto)?;
    let cost = |moved: &[[f32; 3]]| {
        let pairs = nearest(moved, onto);
        let squares = pairs.iter().map(|(_, distance)| distance * distance).sum::<f64>();
        (pairs, squares / moved.len() as f64)
    };
    let (mut pairs, cost_at_rest) = cost(points);
    let mut best =
        Alignment { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO, cost: cost_at_rest };
    for _ in 0..MOST {
        let targets: Vec<[f32; 3]> = pairs.iter().map(|(row, _)| onto[*row]).collect();
        let motion = procrustes(points, &targets, scale);
        let moved: Vec<[f32; 3]> = points.iter().map(|p| motion.apply(*p)).collect();
        let (next, after) = cost(&moved);
        let gain = best.cost - after;
        if gain > 0.0 {
            best = Alignment { cost: after, ..motion };
        }
        if gain <= ENOUGH * after {
            break;
        }
        pairs = next;
    }
    Ok(best)
}

/// The motion of `points` with the least squared distances to `targets`, row by row (Horn 1987). The quaternion of its
/// rotation is the eigenvector of the largest eigenvalue of a symmetric matrix of covariances.
pub(crate) fn procrustes(points: &[[f32; 3]], targets: &[[f32; 3]], scale: bool) -> Alignment {
    let n = points.len() as f64;
    let centre = |of: &[[f32; 3]]| of.iter().map(|p| double(*p)).sum::<DVec3>() / n;
    let (from, to) = (centre(points), centre(targets));
    let mut covariance = DMat3::ZERO;
    let (mut spread, mut rotated) = (0.0, 0.0);
    for (p, t) in points.iter().zip(targets) {
        let (p, t) = (double(*p) - from, double(*t) - to);
        // Columns: m[c][r] = Σ p_r · t_c.
        covariance += DMat3::from_cols(p * t.x, p * t.y, p * t.z);
        spread += p.length_squared();
    }
    let m = covariance.to_cols_array_2d();
    let s = |row: usize, column: usize| m[column][row];
    let matrix = DMat4::from_cols_array_2d(&[
        [s(0, 0) + s(1, 1) + s(2, 2), s(1, 2) - s(2, 1), s(2, 0) - s(0, 2), s(0, 1) - s(1, 0)],
        [s(1, 2) - s(2, 1), s(0, 0) - s(1, 1) - s(2, 2), s(0, 1) + s(1, 0), s(2, 0) + s(0, 2)],
        [s(2, 0) - s(0, 2), s(0, 1) + s(1, 0), s(1, 1) - s(0, 0) - s(2, 2), s(1, 2) + s(2, 1)],
        [s(0, 1) - s(1, 0), s(2, 0) + s(0, 2), s(1, 2) + s(2, 1), s(2, 2) - s(0, 0) - s(1, 1)],
    ]);
    let [w, x, y, z] = largest_eigenvector(matrix).to_array();
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    for (p, t) in points.iter().zip(targets) {
        rotated += (rotation * (double(*p) - from)).dot(double(*t) - to);
    }
    // If all points are equal, the scale is undefined.
    let scale = if scale && spread > 0.0 && rotated > 0.0 { rotated / spread } else { 1.0 };
    let translation = to - scale * (rotation * from);
    Alignment { scale, rotation, translation, cost: 0.0 }
}

/// The eigenvector of the largest eigenvalue of a symmetric matrix: a column of a high power.
fn largest_eigenvector(matrix: DMat4) -> DVec4 {
    /// Squarings: eigenvalues that differ in the last digit are told apart.
    const SQUARINGS: usize = 60;
    let size = |m: DMat4| m.to_cols_array().map(f64::abs).iter().sum::<f64>();
    // No eigenvalue is negative after the shift. If all points are equal, the matrix is 0.
    let mut power = matrix + (size(matrix) + f64::MIN_POSITIVE) * DMat4::IDENTITY;
    for _ in 0..SQUARINGS {
        power *= 1.0 / size(power);
        power *= power;
    }
    let columns = (0..4).map(|i| power.col(i));
    columns.max_by(|a, b| a.length_squared().total_cmp(&b.length_squared())).expect("four")
}
