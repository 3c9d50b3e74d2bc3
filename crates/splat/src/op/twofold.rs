//! A function that Rust and CubeCL spell differently: `exp` runs on CPUs, and CubeCL calls `exp::expand` where a
//! `#[cube]` function that calls `exp` is compiled for a GPU.

/// exp(x) for x ≤ 0, within 2 units in the last place; exp(−87) for x below −87. GPUs use their own exp.
///
/// x = n·ln 2 + r with |r| ≤ ½ ln 2; exp(r) by its Taylor polynomial, whose remainder r⁸/8! is below 6e-9; 2ⁿ by the
/// exponent bits. A loop over this function compiles to SIMD, which it does not with the standard library's exp.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    /// Adding this constant rounds a small float to an integer, which is then in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    /// ln 2 in two parts: the first has few enough bits that n times it is exact.
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let x = x.max(-87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN_2_HIGH) - n * LN_2_LOW;
    let mut p = 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23;
    p * f32::from_bits(exponent)
}

pub mod exp {
    use cubecl::prelude::*;

    pub fn expand(scope: &Scope, x: NativeExpand<f32>) -> NativeExpand<f32> {
        x.__expand_exp_method(scope)
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn exp_is_within_two_units_in_the_last_place() {
        for i in 0..870_000 {
            let x = -(i as f32) * 1e-4;
            let exact = f64::from(x).exp();
            let error = (f64::from(super::exp(x)) - exact).abs() / exact;
            assert!(error < 2.0 * f64::from(f32::EPSILON), "exp({x}): relative error {error}");
        }
        assert_eq!(super::exp(0.0), 1.0);
        assert_eq!(super::exp(-1e30), super::exp(-87.0));
    }
}
