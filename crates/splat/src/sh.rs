//! Colours that depend on the direction of view: real spherical harmonics of degree 0 to 3.
//!
//! A separate tensor function, so that a scene without spherical harmonics has no cost for them.

use burn::tensor::Tensor;

use crate::{Camera, SplatError};

/// Value of the constant harmonic, 1/(2√π).
pub const C0: f32 = 0.282_094_79;
/// Degree 1: √(3/(4π)).
const C1: f32 = 0.488_602_51;
/// Degree 2: √(15/(4π)), √(5/(16π)), √(15/(16π)).
const C2: [f32; 3] = [1.092_548_4, 0.315_391_57, 0.546_274_2];
/// Degree 3: √(35/(32π)), √(105/(4π)), √(21/(32π)), √(7/(16π)), √(105/(16π)).
const C3: [f32; 5] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_33, 1.445_305_7];

/// Colours `[N,3]` of Gaussians at `means` `[N,3]` (world) for `camera`: max(0, ½ + Σ_k Y_k(d)·c_k) with d the
/// unit vector from the camera's centre to the mean, and the signs and order of the INRIA files. `coefficients`
/// `[N,K,3]`, K ∈ {1, 4, 9, 16}. Differentiable in both tensors.
///
/// # Errors
/// [`SplatError::Shape`].
pub fn colors(coefficients: &Tensor<3>, means: &Tensor<2>, camera: &Camera) -> Result<Tensor<2>, SplatError> {
    let [n, k, channels] = coefficients.dims();
    let wrong = |field, found: Vec<usize>, expected: Vec<usize>| SplatError::Shape { field, found, expected };
    if means.dims() != [n, 3] {
        return Err(wrong("means", means.dims().to_vec(), vec![n, 3]));
    }
    if channels != 3 || ![1, 4, 9, 16].contains(&k) {
        let nearest = [16, 9, 4].into_iter().find(|&full| k >= full).unwrap_or(1);
        return Err(wrong("coefficients", vec![n, k, channels], vec![n, nearest, 3]));
    }
    let band = |index: usize| coefficients.clone().narrow(1, index, 1).squeeze_dim::<2>(1);
    let mut sum = band(0) * C0 + 0.5;
    if k > 1 {
        let centre = camera.centre().as_vec3();
        let centre = Tensor::<2>::from_floats([centre.to_array()], &means.device());
        let offset = means.clone() - centre;
        // Clamped before the root: its derivative at zero is infinite.
        let length = offset.clone().square().sum_dim(1).clamp_min(1e-24).sqrt();
        let d = offset / length;
        let [x, y, z] = [0, 1, 2].map(|axis| d.clone().narrow(1, axis, 1));
        for (index, harmonic) in harmonics(&x, &y, &z, k).into_iter().enumerate() {
            sum = sum + band(index + 1) * harmonic;
        }
    }
    Ok(sum.clamp_min(0.0))
}

/// Harmonics 1 to `k` − 1 of directions given by columns `[N,1]`.
fn harmonics(x: &Tensor<2>, y: &Tensor<2>, z: &Tensor<2>, k: usize) -> Vec<Tensor<2>> {
    let [x, y, z] = [x, y, z].map(|axis| || axis.clone());
    let mut all = vec![y() * -C1, z() * C1, x() * -C1];
    if k > 4 {
        let (xx, yy, zz) = (x() * x(), y() * y(), z() * z());
        let [xx, yy, zz] = [&xx, &yy, &zz].map(|square| || square.clone());
        all.extend([
            x() * y() * C2[0],
            y() * z() * -C2[0],
            (zz() * 2.0 - xx() - yy()) * C2[1],
            x() * z() * -C2[0],
            (xx() - yy()) * C2[2],
        ]);
        if k > 9 {
            all.extend([
                y() * (xx() * 3.0 - yy()) * -C3[0],
                x() * y() * z() * C3[1],
                y() * (zz() * 4.0 - xx() - yy()) * -C3[2],
                z() * (zz() * 2.0 - xx() * 3.0 - yy() * 3.0) * C3[3],
                x() * (zz() * 4.0 - xx() - yy()) * -C3[2],
                z() * (xx() - yy()) * C3[4],
                x() * (xx() - yy() * 3.0) * -C3[0],
            ]);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};
    use glam::{DVec2, DVec3};

    use super::*;
    use crate::RigidTransform;

    /// A camera at the origin.
    fn camera() -> Camera {
        let (focal, principal_point) = (DVec2::ONE, DVec2::ZERO);
        let world_to_camera = RigidTransform::IDENTITY;
        Camera { width: 1, height: 1, focal, principal_point, world_to_camera }
    }

    /// Values of the harmonics in many directions, `[n, 16]`, read off with unit coefficients.
    fn table(directions: &[DVec3]) -> Vec<[f64; 16]> {
        let device = Device::flex();
        let n = directions.len();
        let flat: Vec<f32> = directions.iter().flat_map(|d| d.as_vec3().to_array()).collect();
        let means = Tensor::<2>::from_data(TensorData::new(flat, [n, 3]), &device);
        let mut rows = vec![[0.0; 16]; n];
        for k in 0..16 {
            // A large constant coefficient, so that no colour is clamped at 0.
            let mut unit = [0.0_f32; 16 * 3];
            unit[0] = 10.0;
            unit[3 * k] += 1.0;
            let coefficients = Tensor::<3>::from_data(TensorData::new(unit.repeat(n), [n, 16, 3]), &device);
            let found: Vec<f32> = colors(&coefficients, &means, &camera())
                .expect("shapes")
                .into_data()
                .try_into_vec()
                .expect("f32");
            for (row, color) in rows.iter_mut().zip(found.chunks_exact(3)) {
                row[k] = f64::from(color[0]) - 0.5 - 10.0 * f64::from(C0);
            }
        }
        rows
    }

    /// Spherical harmonics are the only polynomials with these products: ∫ Y_i·Y_j = δ_ij over the sphere.
    #[test]
    fn the_harmonics_are_orthonormal() {
        let n = 4000;
        let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
        let directions: Vec<DVec3> = (0..n)
            .map(|i| {
                let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
                let (sin, cos) = (golden * f64::from(i)).sin_cos();
                DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z) * 3.0
            })
            .collect();
        let rows = table(&directions);
        for i in 0..16 {
            for j in 0..16 {
                let mean: f64 = rows.iter().map(|r| r[i] * r[j]).sum::<f64>() / f64::from(n);
                let product = 4.0 * std::f64::consts::PI * mean;
                let expected = f64::from(u8::from(i == j));
                assert!((product - expected).abs() < 2e-3, "harmonics {i} and {j}: {product}");
            }
        }
    }

    /// The order and signs of the published rasterisers, along axes where one term is left.
    #[test]
    fn order_and_signs_are_those_of_the_files() {
        let rows = table(&[DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(1.0, 1.0, 1.0)]);
        for (row, k, expected) in [
            (0, 3, -0.488_602_5),
            (1, 1, -0.488_602_5),
            (2, 2, 0.488_602_5),
            (0, 8, 0.546_274_2),
            (2, 6, 2.0 * 0.315_391_6),
            (0, 15, -0.590_043_6),
            (1, 9, 0.590_043_6),
            (2, 12, 2.0 * 0.373_176_3),
            // At (1,1,1)/√3 the products are ⅓ and 3^{-3/2}.
            (3, 4, 1.092_548_4 / 3.0),
            (3, 5, -1.092_548_4 / 3.0),
            (3, 7, -1.092_548_4 / 3.0),
            (3, 10, 2.890_611_4 / 27.0_f64.sqrt()),
            (3, 11, -2.0 * 0.457_045_8 / 27.0_f64.sqrt()),
            (3, 13, -2.0 * 0.457_045_8 / 27.0_f64.sqrt()),
            (3, 14, 0.0),
        ] {
            let found: f64 = rows[row][k];
            assert!((found - expected).abs() < 1e-5, "direction {row}, harmonic {k}: {found}");
        }
    }

    #[test]
    fn colours_are_never_negative_and_wrong_shapes_are_refused() {
        let device = Device::flex();
        let means = Tensor::<2>::ones([2, 3], &device);
        let dark = Tensor::<3>::ones([2, 1, 3], &device) * -9.0;
        let found: Vec<f32> =
            colors(&dark, &means, &camera()).expect("shapes").into_data().try_into_vec().expect("f32");
        assert_eq!(found, vec![0.0; 6]);
        for shape in [[2, 2, 3], [2, 4, 4], [3, 4, 3], [2, 0, 3], [2, 25, 3]] {
            assert!(colors(&Tensor::zeros(shape, &device), &means, &camera()).is_err(), "{shape:?}");
        }
    }
}
