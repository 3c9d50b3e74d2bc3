//! A set of 3D Gaussians as tensors on one device.

use burn::tensor::{Device, Tensor};
use glam::{DMat3, DQuat, DVec3};

use crate::{RigidTransform, SplatError};

/// N anisotropic 3D Gaussians with one colour each (SH degree 0), after activation.
#[derive(Debug, Clone)]
pub struct Gaussians {
    /// Centres `[N,3]`, metres.
    pub means: Tensor<2>,
    /// Unit quaternions `[N,4]` (w, x, y, z).
    pub rotations: Tensor<2>,
    /// Standard deviations along the rotated axes `[N,3]`, metres, > 0.
    pub scales: Tensor<2>,
    /// Opacities `[N]` in [0, 1].
    pub opacities: Tensor<1>,
    /// Colours `[N,3]` (red, green, blue), 0 black, 1 white; values outside of [0, 1] are allowed.
    pub colors: Tensor<2>,
}

impl Gaussians {
    /// A set of these tensors.
    ///
    /// # Errors
    /// [`SplatError::Shape`] if the number of rows or columns of a tensor is wrong.
    pub fn new(
        means: Tensor<2>,
        rotations: Tensor<2>,
        scales: Tensor<2>,
        opacities: Tensor<1>,
        colors: Tensor<2>,
    ) -> Result<Self, SplatError> {
        let gaussians = Self { means, rotations, scales, opacities, colors };
        gaussians.check()?;
        Ok(gaussians)
    }

    /// Whether the shapes fit together.
    ///
    /// # Errors
    /// [`SplatError::Shape`].
    pub(crate) fn check(&self) -> Result<(), SplatError> {
        let n = self.len();
        let check = |field, found: &[usize], expected: &[usize]| {
            if found == expected {
                return Ok(());
            }
            Err(SplatError::Shape { field, found: found.to_vec(), expected: expected.to_vec() })
        };
        check("means", &self.means.dims(), &[n, 3])?;
        check("rotations", &self.rotations.dims(), &[n, 4])?;
        check("scales", &self.scales.dims(), &[n, 3])?;
        check("opacities", &self.opacities.dims(), &[n])?;
        check("colors", &self.colors.dims(), &[n, 3])
    }

    /// All Gaussians of these sets.
    pub fn joined(parts: &[Self]) -> Self {
        let rows =
            |of: fn(&Self) -> &Tensor<2>| Tensor::cat(parts.iter().map(|part| of(part).clone()).collect(), 0);
        Self {
            means: rows(|part| &part.means),
            rotations: rows(|part| &part.rotations),
            scales: rows(|part| &part.scales),
            opacities: Tensor::cat(parts.iter().map(|part| part.opacities.clone()).collect(), 0),
            colors: rows(|part| &part.colors),
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.dims()[0]
    }

    /// Whether there is no Gaussian at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Device that holds the tensors.
    pub fn device(&self) -> Device {
        self.means.device()
    }

    /// Transforms the centres but not the quaternions.
    pub fn with_means_transformed(mut self, transform: &RigidTransform) -> Self {
        self.means = affine(self.means, &transform.rotation, transform.translation);
        self
    }

    /// Scales the whole set by `factor` about the origin.
    pub fn scaled(mut self, factor: f64) -> Self {
        self.means = self.means * factor;
        self.scales = self.scales * factor;
        self
    }

    /// Moves the whole set rigidly: the centres, and the quaternions by left multiplication
    /// (docs/method.md, "World frame").
    ///
    /// # Panics
    /// If `transform` is a reflection: no quaternion can express the mirrored Gaussians.
    pub fn transformed(mut self, transform: &RigidTransform) -> Self {
        assert!(transform.rotation.determinant() > 0.0, "a reflection cannot rotate quaternions");
        let q = DQuat::from_mat3(&transform.rotation);
        let (w, x, y, z) = (q.w as f32, q.x as f32, q.y as f32, q.z as f32);
        // Row i is the contribution of component i of the right factor to q ⊗ r, in (w, x, y, z) order.
        let product = [[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]];
        self.rotations = times(self.rotations, &product);
        self.with_means_transformed(transform)
    }
}

/// M·p + t for each row p of `points` `[N,3]`.
pub fn affine(points: Tensor<2>, matrix: &DMat3, translation: DVec3) -> Tensor<2> {
    // Row vectors: (M·p)ᵀ = pᵀ·Mᵀ, and glam's columns are the rows of Mᵀ.
    let rows = matrix.to_cols_array_2d().map(|column| column.map(|v| v as f32));
    let translation = [translation.to_array().map(|v| v as f32)];
    let translation = Tensor::<2>::from_floats(translation, &points.device());
    times(points, &rows) + translation
}

/// `x` `[N, K]` times a small constant matrix with K rows, as a sum of K scaled rows: a matrix product is autotuned for
/// seconds on a GPU, and not every backend supports one with N = 0.
fn times<const C: usize>(x: Tensor<2>, rows: &[[f32; C]]) -> Tensor<2> {
    let device = x.device();
    let term =
        |(i, row): (usize, &[f32; C])| x.clone().narrow(1, i, 1) * Tensor::<2>::from_floats([*row], &device);
    rows.iter().enumerate().map(term).reduce(|sum, term| sum + term).expect("K > 0")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Camera;

    #[test]
    fn transforming_rotates_the_covariance_with_the_means() {
        let device = Device::flex();
        let q = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 0.7);
        let mean = DVec3::new(0.3, -0.2, 2.1);
        let transform = Camera::orbit_at_yaw_degrees(40.0, 64).world_to_camera.inverse();
        let ones = Tensor::<2>::ones([1, 3], &device);
        let means = Tensor::from_floats([mean.as_vec3().to_array()], &device);
        let rotations = Tensor::from_floats([[q.w, q.x, q.y, q.z].map(|v| v as f32)], &device);
        let one = Gaussians::new(means, rotations, ones.clone(), Tensor::ones([1], &device), ones);
        let moved = one.expect("shapes").transformed(&transform);
        let r: Vec<f32> = moved.rotations.into_data().try_into_vec().expect("f32");
        let got = DMat3::from_quat(DQuat::from_xyzw(r[1].into(), r[2].into(), r[3].into(), r[0].into()));
        let expected = transform.rotation * DMat3::from_quat(q);
        assert!((got - expected).to_cols_array().iter().all(|d| d.abs() < 1e-6));
        let m: Vec<f32> = moved.means.into_data().try_into_vec().expect("f32");
        let got = DVec3::new(m[0].into(), m[1].into(), m[2].into());
        assert!((got - transform.apply(mean)).length() < 1e-6, "{got}");
    }
}
