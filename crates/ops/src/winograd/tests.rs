//! Accuracy of Winograd's method, and products at every width of vectors.

use burn::tensor::FloatDType;
use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use pulp::{Arch, Scalar, Simd, WithSimd};

use super::GROUP;
use super::product::{Left, PANEL, Panels, Product};
use crate::host;
use crate::op::Kernel;
use crate::operators::Convolution;
use crate::testing::{random, relative_error, values, wide};

/// With the points of this crate the error is 1.5e-6, below the bound. With the points 0, ±1, ±2, ∞ it is 3.0e-6.
#[test]
fn winograd_is_accurate() {
    let [channels, side] = [256, 16];
    let x = random([1, channels, side, side], 3);
    let (weight, bias) = (random([channels, channels, 3, 3], 1), random([channels], 2));
    let (inputs, outputs, height, width) = (channels, channels, side, side);
    let (stride, rectified, in_bf16) = (1, false, false);
    let layer = Convolution { batch: 1, inputs, outputs, height, width, side: 3, stride, rectified, in_bf16 };
    let (got, _) = layer.forward([&host(x.clone()), &host(weight.clone()), &host(bias.clone())], false);
    let [x, weight] = [x, weight].map(|tensor| tensor.cast(FloatDType::F64));
    let options = ConvOptions::new([1, 1], [1, 1], [1, 1], 1);
    let exact = conv2d(x, weight, Some(bias.cast(FloatDType::F64)), options);
    let error = relative_error(&wide(&got), &values(exact));
    assert!(error < 2e-6, "{error:e}");
}

/// A product of 29×48 and 48×80, once per width of vectors that this processor has.
#[test]
fn every_width_of_vectors_computes_the_same_product() {
    let (rows, inner, columns) = (29, 48, 80);
    let (left, right) = (host(random([inner / GROUP, rows, GROUP], 1)), host(random([inner, columns], 2)));
    // `[panels][inner][32]`.
    let mut panels = vec![0.0; columns.next_multiple_of(PANEL) * inner];
    for (i, value) in right.iter().enumerate() {
        let (row, column) = (i / columns, i % columns);
        panels[(column / PANEL * inner + row) * PANEL + column % PANEL] = *value;
    }
    struct Run<'a>(Product<'a, 'a>);
    impl WithSimd for Run<'_> {
        type Output = ();
        fn with_simd<S: Simd>(self, simd: S) {
            S::vectorize(simd, self.0);
        }
    }
    let run = |dispatch: &dyn Fn(Run)| {
        let mut out = vec![0.0; rows * columns];
        let mut slices: Vec<&mut [f32]> = out.chunks_exact_mut(rows * GROUP).collect();
        let left = Left { values: &left, stride: rows * GROUP, groups: inner / GROUP, rows };
        let right = Panels { values: &panels, stride: inner * PANEL };
        dispatch(Run(Product { left, right, out: &mut slices }));
        out
    };
    let mut results = vec![run(&|op| op.with_simd(Scalar)), run(&|op| Arch::new().dispatch(op))];
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        results.push(run(&|op| op.with_simd(simd)));
    }
    for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
        let term = |k: usize| {
            f64::from(left[(k / GROUP * rows + row) * GROUP + k % GROUP])
                * f64::from(right[k * columns + column])
        };
        let expected: f64 = (0..inner).map(term).sum();
        for result in &results {
            let got = f64::from(result[(column / GROUP * rows + row) * GROUP + column % GROUP]);
            // 48 terms below 1, each rounded to 24 bits.
            assert!(
                (got - expected).abs() < 48.0 * 6e-8 * 4.0,
                "{row}, {column}: {got} instead of {expected}"
            );
        }
    }
}
