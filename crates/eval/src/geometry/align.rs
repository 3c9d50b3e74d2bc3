//! Alignment of reconstructions that are not in the world frame, by iterative closest point (Besl & McKay 1992).

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use snapsnap_splat::RigidTransform;

use super::{check_points, double, nearest};
use crate::EvalError;

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
        match self {
            Self::None => "none",
            Self::Rigid => "rigid, by iterated closest points",
            Self::Similarity => "rigid and scale, by iterated closest points",
        }
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
/// [`EvalError::Message`] for a set without points or with one that is not finite.
pub fn icp(points: &[[f32; 3]], onto: &[[f32; 3]], scale: bool) -> Result<Alignment, EvalError> {
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
    let matrix = [
        [s(0, 0) + s(1, 1) + s(2, 2), s(1, 2) - s(2, 1), s(2, 0) - s(0, 2), s(0, 1) - s(1, 0)],
        [s(1, 2) - s(2, 1), s(0, 0) - s(1, 1) - s(2, 2), s(0, 1) + s(1, 0), s(2, 0) + s(0, 2)],
        [s(2, 0) - s(0, 2), s(0, 1) + s(1, 0), s(1, 1) - s(0, 0) - s(2, 2), s(1, 2) + s(2, 1)],
        [s(0, 1) - s(1, 0), s(2, 0) + s(0, 2), s(1, 2) + s(2, 1), s(2, 2) - s(0, 0) - s(1, 1)],
    ];
    let [w, x, y, z] = largest_eigenvector(matrix);
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    for (p, t) in points.iter().zip(targets) {
        rotated += (rotation * (double(*p) - from)).dot(double(*t) - to);
    }
    // If all points are equal, the scale is undefined.
    let scale = if scale && spread > 0.0 && rotated > 0.0 { rotated / spread } else { 1.0 };
    let translation = to - scale * (rotation * from);
    Alignment { scale, rotation, translation, cost: 0.0 }
}

/// The eigenvector of the largest eigenvalue of a symmetric matrix, by Jacobi rotations.
fn largest_eigenvector(mut a: [[f64; 4]; 4]) -> [f64; 4] {
    const SWEEPS: usize = 30;
    let mut vectors = [[0.0; 4]; 4];
    (0..4).for_each(|i| vectors[i][i] = 1.0);
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let c = 1.0 / t.hypot(1.0);
            let s = t * c;
            for row in a.iter_mut().chain(&mut vectors) {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            let (rows, others) = a.split_at_mut(q);
            for (x, y) in rows[p].iter_mut().zip(&mut others[0]) {
                (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
            }
        }
    }
    let largest = (0..4).max_by(|i, j| a[*i][*i].total_cmp(&a[*j][*j])).expect("four");
    vectors.map(|row| row[largest])
}
