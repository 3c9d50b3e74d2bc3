//! Activations of the regressor's 14 channels (SNAPSNAP §8.3).

use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;

/// Gaussian attributes of N pixels.
#[derive(Debug, Clone)]
pub struct Attributes {
    /// `[N, 1]` in (0, 1).
    pub opacity: Tensor<2>,
    /// Standard deviations `[N, 3]`, metres.
    pub scale: Tensor<2>,
    /// Unit quaternions `[N, 4]` (w, x, y, z).
    pub rotation: Tensor<2>,
    /// `[N, 3]` in [−1, 1].
    pub color: Tensor<2>,
    /// Offsets from the point map `[N, 3]`, metres, front camera's axes.
    pub offset: Tensor<2>,
}

impl Attributes {
    /// Features `[N, 14]`: opacity, scale, rotation, colour, offset.
    pub fn from_features(features: Tensor<2>) -> Self {
        let part = |from: usize, width: usize| features.clone().narrow(1, from, width);
        Self {
            opacity: sigmoid(part(0, 1)),
            scale: sharp_softplus(part(1, 3)),
            rotation: unit(part(4, 4)),
            color: part(8, 3).tanh(),
            offset: part(11, 3) * 0.001,
        }
    }
}

/// 0.001·ln(1 + e^(100·x)), written so that no exponential overflows: 0.1·max(x, 0) + 0.001·ln(1 + e^(−100·|x|)).
/// PyTorch's softplus switches to the straight line above 100·x = 20, where the two differ by 2e-9 of 20.
fn sharp_softplus(x: Tensor<2>) -> Tensor<2> {
    x.clone().clamp_min(0.0) * 0.1 + (x.abs() * -100.0).exp().log1p() * 0.001
}

/// Rows scaled to length one; a row shorter than 1e-12 is divided by that instead (PyTorch's `normalize`).
fn unit(x: Tensor<2>) -> Tensor<2> {
    const MIN_NORM: f64 = 1e-12;
    // Scaled by the largest component first, so that squares neither overflow nor vanish.
    let largest = x.clone().abs().max_dim(1).clamp_min(f64::from(f32::MIN_POSITIVE));
    let norm = (x.clone() / largest.clone()).square().sum_dim(1).sqrt() * largest;
    x / norm.clamp_min(MIN_NORM)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    fn values(x: Tensor<2>) -> Vec<f32> {
        x.into_data().try_into_vec().expect("f32")
    }

    /// Check value of SNAPSNAP §13.4: the scale head at 0 gives 6.931e-4.
    #[test]
    fn softplus_has_its_published_value_and_stays_finite_at_the_extremes() {
        let device = Device::flex();
        let got = values(sharp_softplus(Tensor::from_data([[0.0, 0.3, -0.05, 1e30, -1e30]], &device)));
        let expected = [0.001 * std::f32::consts::LN_2, 0.03, 0.001 * (-5.0_f32).exp().ln_1p(), 1e29, 0.0];
        for (g, e) in got.iter().zip(expected) {
            assert!((g - e).abs() <= 1e-6 * e.abs().max(1e-3), "{got:?}");
        }
    }

    #[test]
    fn quaternions_are_unit_even_when_huge_tiny_or_zero() {
        let device = Device::flex();
        let rows =
            Tensor::from_data([[3.0, 0.0, -4.0, 0.0], [1e30, 1e30, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], &device);
        let got = values(unit(rows));
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let expected = [0.6, 0.0, -0.8, 0.0, half, half, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert!(got.iter().zip(expected).all(|(g, e)| (g - e).abs() < 1e-6), "{got:?}");
    }
}
