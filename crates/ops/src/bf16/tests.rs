//! Products of bf16 factors against f64.

use super::*;
use crate::multiply::{self, Right};
use crate::testing::uniform;

/// Nearest bf16, ties to even.
fn nearest(x: f32) -> f32 {
    let bits = x.to_bits();
    f32::from_bits((bits + 0x7fff + (bits >> 16 & 1)) & 0xffff_0000)
}

/// Whether this processor has the instructions; prints a line if it has not.
fn can_try() -> bool {
    if !is_there() {
        println!("skipped: this processor has no instructions for bf16 (AVX512-BF16)");
    }
    is_there()
}

#[test]
fn products_equal_those_of_rounded_factors() {
    if !can_try() {
        return;
    }
    for [m, n, k] in
        [[1, 1, 1], [12, 32, 32], [13, 33, 33], [5, 70, 31], [150, 16, 64], [40, 100, 300], [3, 9, 1000]]
    {
        // All four orders of storage, and one with gaps.
        for (i, (ls, rs)) in
            [([1, k], [1, n]), ([m, 1], [1, n]), ([1, k], [k, 1]), ([m, 1], [k, 1]), ([2, 2 * k], [2 * k, 2])]
                .into_iter()
                .enumerate()
        {
            let (lhs, rhs) = (uniform(2 * m * k, 1), uniform(2 * k * n, 2));
            let right = Right::packed([k, n], (&rhs, rs));
            for add in [false, true] {
                let mut out = vec![0.5; m * n];
                multiply::product([m, n, k], (&lhs, ls), &right, &mut out, add);
                for (row, out) in out.chunks_exact(n).enumerate() {
                    for (column, got) in out.iter().enumerate() {
                        let terms = (0..k).map(|i| {
                            let (a, b) = (lhs[row * ls[1] + i * ls[0]], rhs[i * rs[1] + column * rs[0]]);
                            f64::from(nearest(a)) * f64::from(nearest(b))
                        });
                        let expected = terms.sum::<f64>() + if add { 0.5 } else { 0.0 };
                        let error = (f64::from(*got) - expected).abs();
                        assert!(error < 2e-5, "{m}×{n}×{k}, order {i}, {row}, {column}: {got}, {expected}");
                    }
                }
            }
        }
    }
}

/// Infinities stay infinite, and every NaN stays NaN.
#[test]
fn rounding_keeps_what_is_not_finite() {
    let values = [
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::from_bits(0x7f80_0001),
        f32::from_bits(0xffff_ffff),
        f32::MAX,
    ];
    if !can_try() {
        return;
    }
    let right = Right::packed([1, 5], (&values, [1, 5]));
    let mut out = [0.0; 5];
    multiply::product([1, 5, 1], (&[1.0], [1, 1]), &right, &mut out, false);
    assert!(
        out[0] == f32::INFINITY && out[1] == f32::NEG_INFINITY && out[2].is_nan() && out[3].is_nan(),
        "{out:?}"
    );
    // The largest float is nearer to infinity than to the largest bf16.
    assert_eq!(out[4], f32::INFINITY);
}
