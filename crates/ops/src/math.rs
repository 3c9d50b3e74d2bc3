//! Elementary functions in plain Rust that the compiler turns into vector instructions.

/// eˣ with a relative error below 3e-7. x is clamped to ±87.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // Adding and subtracting 1.5·2²³ rounds to an integer, which is in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts. The first part has so few bits that its product with n is exact (Cody and Waite).
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let x = x.clamp(-87.0, 87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN2_HIGH - n * LN2_LOW;
    let p = 1.0 / 720.0 + r * (1.0 / 5040.0);
    let p = 1.0 / 24.0 + r * (1.0 / 120.0 + r * p);
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * p)));
    p * f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000))
}

/// x / (1 + e⁻ˣ).
#[inline(always)]
pub fn silu(x: f32) -> f32 {
    x / (1.0 + exp(-x))
}

/// x·σ(x) and its derivative σ(x)·(1 + x·(1 − σ(x))).
#[inline(always)]
pub fn silu_and_slope(x: f32) -> [f32; 2] {
    let sigmoid = 1.0 / (1.0 + exp(-x));
    let value = x * sigmoid;
    [value, sigmoid + value * (1.0 - sigmoid)]
}

/// GELU: x·Φ(x), with Φ from approximation 7.1.26 of the error function by Abramowitz and Stegun (absolute error below
/// 1.5e-7).
#[inline(always)]
pub fn gelu(x: f32) -> f32 {
    x * normal(x)[0]
}

/// The derivative of GELU: Φ(x) + x·φ(x).
#[inline(always)]
pub fn gelu_derivative(x: f32) -> f32 {
    // 1/√(2π).
    const PEAK: f32 = 0.398_942_3;
    let [below, bell] = normal(x);
    below + x * PEAK * bell
}

/// Φ(x) and e^(−x²/2).
#[inline(always)]
fn normal(x: f32) -> [f32; 2] {
    let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let poly = 1.421_413_7 + t * (-1.453_152 + t * 1.061_405_4);
    let poly = t * (0.254_829_6 + t * (-0.284_496_74 + t * poly));
    let bell = exp(-z * z);
    let tail = 0.5 * poly * bell;
    [if x < 0.0 { tail } else { 1.0 - tail }, bell]
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_1_SQRT_2;

    use burn::tensor::{Device, FloatDType, Tensor, TensorData};

    use super::*;
    use crate::testing::values;

    fn sweep() -> impl Iterator<Item = f32> {
        (-870_000..=870_000).map(|i| i as f32 * 1e-4)
    }

    #[test]
    fn exp_is_accurate_to_its_bound() {
        let error = |x: f32| {
            let expected = f64::from(x).exp();
            ((f64::from(exp(x)) - expected) / expected).abs()
        };
        let worst = sweep().map(error).fold(0.0, f64::max);
        assert!(worst < 3e-7, "{worst:e}");
    }

    /// Against the error function in f64, and Burn's derivative of it.
    #[test]
    fn gelu_and_its_derivative_are_accurate_to_their_bounds() {
        let grid: Vec<f32> = (-80..=80).map(|i| i as f32 * 0.1).collect();
        let data = TensorData::new(grid.clone(), [grid.len()]);
        let x = Tensor::<1>::from_data(data, &Device::flex().autodiff()).cast(FloatDType::F64).require_grad();
        let expected = x.clone() * ((x.clone() * FRAC_1_SQRT_2).erf() + 1.0) * 0.5;
        let slopes = x.grad(&expected.clone().sum().backward()).expect("tracked");
        for ((x, expected), slope) in grid.into_iter().zip(values(expected)).zip(values(slopes)) {
            let error = (f64::from(gelu(x)) - expected).abs();
            // 1.5e-7 times at most |x|, plus f32 rounding of the result.
            assert!(error <= 3e-7 * f64::from(x.abs()).max(0.1), "gelu({x}): {error:e}");
            let error = (f64::from(gelu_derivative(x)) - slope).abs();
            assert!(error <= 1e-6, "gelu'({x}): {error:e}");
        }
    }

    #[test]
    fn silu_and_its_slope_are_accurate_to_rounding() {
        for x in sweep() {
            let sigmoid = (1.0 + (-f64::from(x)).exp()).recip();
            let (value, slope) = (f64::from(x) * sigmoid, sigmoid * (1.0 + f64::from(x) * (1.0 - sigmoid)));
            let got = silu_and_slope(x).into_iter().chain([silu(x)]);
            for (got, expected) in got.zip([value, slope, value]) {
                // The 3e-7 of `exp` and three roundings of terms up to max(1, |x|).
                let error = (f64::from(got) - expected).abs();
                assert!(error <= 1e-6 * f64::from(x.abs()).max(1.0), "x = {x}: {error:e}");
            }
        }
    }
}
