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
    use super::*;

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

    /// The reference Φ is 20,000 steps of Simpson's rule over the normal density.
    #[test]
    fn gelu_is_accurate_to_its_bound() {
        let phi = |x: f64| {
            let density = |u: f64| (-0.5 * u * u).exp() / (2.0 * std::f64::consts::PI).sqrt();
            let (n, h) = (20_000, x / 20_000.0);
            let inner: f64 =
                (1..n).map(|i| density(f64::from(i) * h) * if i % 2 == 1 { 4.0 } else { 2.0 }).sum();
            0.5 + h / 3.0 * (density(0.0) + inner + density(x))
        };
        for i in -80..=80 {
            let x = i as f32 * 0.1;
            let expected = f64::from(x) * phi(f64::from(x));
            let error = (f64::from(gelu(x)) - expected).abs();
            // 1.5e-7 times at most |x|, plus f32 rounding of the result.
            assert!(error <= 3e-7 * f64::from(x.abs()).max(0.1), "gelu({x}): {error:e}");
        }
    }

    #[test]
    fn the_slope_of_silu_is_accurate_to_rounding() {
        for x in sweep() {
            let sigmoid = (1.0 + (-f64::from(x)).exp()).recip();
            let expected = [f64::from(x) * sigmoid, sigmoid * (1.0 + f64::from(x) * (1.0 - sigmoid))];
            let got = silu_and_slope(x);
            for (got, expected) in got.into_iter().zip(expected) {
                // The 3e-7 of `exp` and three roundings of terms up to max(1, |x|).
                let error = (f64::from(got) - expected).abs();
                assert!(error <= 1e-6 * f64::from(x.abs()).max(1.0), "x = {x}: {error:e}");
            }
        }
    }

    /// Against central differences of `gelu`, whose step is wide enough for its rounding.
    #[test]
    fn gelu_derivative_is_the_slope() {
        for i in -80..=80 {
            let (x, h) = (i as f32 * 0.1, 0.01);
            let slope =
                (f64::from(gelu(x + h)) - f64::from(gelu(x - h))) / (f64::from(x + h) - f64::from(x - h));
            // h² / 6 times the third derivative (at most 1.2), and GELU's own error over 2·h.
            let error = (f64::from(gelu_derivative(x)) - slope).abs();
            assert!(error < 6e-5 + 3e-5 * f64::from(x.abs()), "gelu'({x}): {error:e}");
        }
    }

    #[test]
    fn silu_has_its_limits() {
        assert_eq!(silu(0.0), 0.0);
        assert!((silu(1.0) - 0.731_058_6).abs() < 1e-6);
        assert_eq!(silu(100.0), 100.0);
        assert!(silu(-100.0).abs() < 1e-30);
    }
}
