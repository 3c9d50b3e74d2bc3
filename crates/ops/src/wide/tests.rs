//! The wide convolutions against Burn's, at sizes that reach their corners: channels that fill no group or panel, tiles
//! that overhang, fewer rows than a register block, rows longer than a block.

use burn::tensor::activation::relu;
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{Device, Tensor, TensorData};
use pulp::{Arch, Scalar, Simd, WithSimd};

use super::product::{Left, PANEL, Product, Right, pack};
use super::{Buffers, Conv3x3, GROUP, Image, Pointwise, Source};
use crate::tests::{assert_equal, random};
use crate::{bilinear, host};

/// Inputs, outputs, height, width.
const SIZES: [[usize; 4]; 7] = [
    [1, 1, 1, 1],
    [5, 7, 2, 3],
    [16, 48, 9, 13],
    [33, 17, 1, 21],
    [200, 70, 7, 301],
    [20, 40, 5, 1300],
    [256, 256, 12, 20],
];

fn image(x: &Tensor<4>) -> Image {
    let [_, channels, height, width] = x.dims();
    Image::from_pixels(&host(x.clone().permute([0, 2, 3, 1])), channels, [height, width], &Buffers::default())
}

fn tensor(image: &Image) -> Tensor<4> {
    let Image { channels, height, width, ref data } = *image;
    let groups = channels.div_ceil(GROUP);
    let data = TensorData::new(data.clone(), [1, groups, height * width, GROUP]);
    let planes = Tensor::<4>::from_data(data, &Device::flex()).swap_dims(2, 3);
    planes.reshape([1, groups * GROUP, height, width]).narrow(1, 0, channels)
}

fn direct(x: Tensor<4>, weight: &Tensor<4>, bias: &Tensor<1>, stride: usize) -> Tensor<4> {
    let padding = weight.dims()[2] / 2;
    let options = ConvOptions::new([stride; 2], [padding; 2], [1, 1], 1);
    conv2d(x, weight.clone(), Some(bias.clone()), options)
}

/// An input, a weight of side `side` and a bias.
fn example([inputs, outputs, height, width]: [usize; 4], side: usize) -> (Tensor<4>, Tensor<4>, Tensor<1>) {
    (random([1, inputs, height, width], 3), random([outputs, inputs, side, side], 1), random([outputs], 2))
}

#[test]
fn winograd_equals_direct_convolution() {
    for size @ [inputs, outputs, height, width] in SIZES {
        let ((x, weight, bias), buffers) = (example(size, 3), Buffers::default());
        let layer = || Conv3x3::new(&host(weight.clone()), &host(bias.clone()), [inputs, outputs], &buffers);
        let image = image(&x);
        let sources = [
            ("plain", Source::plain(&image), x.clone()),
            ("rectified", Source::rectified(&image), relu(x.clone())),
            ("doubled", Source::doubled(&image), bilinear(x, [2 * height, 2 * width], true)),
        ];
        for (name, source, x) in sources {
            let what = format!("{inputs}→{outputs} at {height}×{width}, {name}");
            let expected = direct(x, &weight, &bias, 1);
            let mut got = layer().run(&source, &buffers);
            assert_equal(&what, tensor(&got), expected.clone());
            layer().add_to(&mut got, &source, &buffers);
            assert_equal(&format!("{what}, added"), tensor(&got), expected * 2.0);
        }
    }
}

#[test]
fn a_rectified_projection_equals_its_composition() {
    for size @ [inputs, outputs, height, width] in SIZES {
        let ((x, weight, bias), buffers) = (example(size, 3), Buffers::default());
        let (last, last_bias) = (random([4, outputs, 1, 1], 4), random([4], 5));
        let pointwise = Pointwise::new(&host(last.clone()), &host(last_bias.clone()), [outputs, 4], &buffers);
        let layer = Conv3x3::new(&host(weight.clone()), &host(bias.clone()), [inputs, outputs], &buffers);
        let got = layer.rectified_into(&pointwise, &Source::plain(&image(&x)), &buffers);
        let got = Tensor::from_data(TensorData::new(got, [1, 4, height, width]), &Device::flex());
        let expected = direct(relu(direct(x, &weight, &bias, 1)), &last, &last_bias, 1);
        assert_equal(&format!("{inputs}→{outputs}→4 at {height}×{width}"), got, expected);
    }
}

#[test]
fn pointwise_layers_equal_burns() {
    for size @ [inputs, outputs, height, width] in SIZES {
        let (what, buffers) = (format!("{inputs}→{outputs} at {height}×{width}"), Buffers::default());
        let (x, weight, bias) = example(size, 1);
        let layer = Pointwise::new(&host(weight.clone()), &host(bias.clone()), [inputs, outputs], &buffers);
        assert_equal(&what, tensor(&layer.run(&image(&x), &buffers)), direct(x, &weight, &bias, 1));

        let (x, weight, bias) = example(size, 3);
        let layer =
            Pointwise::halving(&host(weight.clone()), &host(bias.clone()), [inputs, outputs], &buffers);
        let got = layer.run(&image(&x).unfold(&buffers), &buffers);
        assert_equal(&format!("{what}, halving"), tensor(&got), direct(x, &weight, &bias, 2));
    }
    for (stride, [inputs, outputs, height, width]) in
        [(2, [18, 35, 3, 5]), (4, [96, 96, 4, 4]), (3, [1, 1, 1, 2])]
    {
        let buffers = Buffers::default();
        let x = random([1, inputs, height, width], 1);
        let (weight, bias) = (random([inputs, outputs, stride, stride], 2), random([outputs], 3));
        let channels = [inputs, outputs];
        let layer =
            Pointwise::enlarging(&host(weight.clone()), &host(bias.clone()), channels, stride, &buffers);
        let got = layer.run(&image(&x), &buffers).shuffle(stride, outputs, &buffers);
        let options = ConvTransposeOptions::new([stride; 2], [0, 0], [0, 0], [1, 1], 1);
        let expected = conv_transpose2d(x, weight, Some(bias), options);
        assert_equal(&format!("{inputs}→{outputs}, {stride} times as large"), tensor(&got), expected);
    }
}

#[test]
fn a_doubled_image_is_cut_to_the_one_it_is_added_to() {
    for [height, width] in [[3_usize, 5], [4, 4], [1, 2]] {
        let coarse = random([1, 35, height.div_ceil(2), width.div_ceil(2)], 1);
        let fine = random([1, 35, height, width], 2);
        let mut got = image(&fine);
        got.add_doubled(&image(&coarse));
        let doubled = bilinear(coarse, [height, width].map(|n| 2 * n.div_ceil(2)), true);
        let expected = fine + doubled.narrow(2, 0, height).narrow(3, 0, width);
        assert_equal(&format!("{height}×{width}"), tensor(&got), expected);
    }
}

/// The bound is what F(4×4, 3×3) reaches with its points (1.5e-6) and some room; with 0, ±1, ±2, ∞ it is 3.0e-6.
#[test]
fn winograd_is_accurate() {
    let [channels, side] = [256, 16];
    let (x, weight, bias) = example([channels, channels, side, side], 3);
    let (x_values, weights, biases) = (host(x.clone()), host(weight), host(bias));
    let buffers = Buffers::default();
    let layer = Conv3x3::new(&weights, &biases, [channels; 2], &buffers);
    let got = host(tensor(&layer.run(&Source::plain(&image(&x)), &buffers)));
    let exact = |output: usize, y: usize, x: usize| {
        let mut sum = f64::from(biases[output]);
        for (input, tap) in (0..channels).flat_map(|input| (0..9).map(move |tap| (input, tap))) {
            // One more than the place in the image.
            let (y, x) = (y + tap / 3, x + tap % 3);
            if (1..=side).contains(&y) && (1..=side).contains(&x) {
                let weight = weights[(output * channels + input) * 9 + tap];
                sum += f64::from(x_values[(input * side + y - 1) * side + x - 1]) * f64::from(weight);
            }
        }
        sum
    };
    let (mut errors, mut squares) = (0.0, 0.0);
    for (at, got) in got.iter().enumerate().step_by(7) {
        let expected = exact(at / (side * side), at / side % side, at % side);
        errors += (f64::from(*got) - expected).powi(2);
        squares += expected * expected;
    }
    let error = (errors / squares).sqrt();
    assert!(error < 2e-6, "{error:e}");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let (x, weight, bias) = example([40, 72, 30, 50], 3);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| {
            let buffers = Buffers::default();
            let layer = Conv3x3::new(&host(weight.clone()), &host(bias.clone()), [40, 72], &buffers);
            layer.run(&Source::doubled(&image(&x)), &buffers).data
        })
    };
    let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
    assert_eq!(bits(run(1)), bits(run(3)));
}

/// A product of 29×48 and 48×80, once per width of vectors that this processor has.
#[test]
fn every_width_of_vectors_computes_the_same_product() {
    let (rows, inner, columns) = (29, 48, 80);
    let (left, right) = (host(random([inner / GROUP, rows, GROUP], 1)), host(random([inner, columns], 2)));
    let bias = host(random([columns.next_multiple_of(PANEL)], 3));
    let mut panels = vec![0.0; columns.next_multiple_of(PANEL) * inner];
    let places = |count: usize, step: usize| (0..count).map(|i| Some(i * step)).collect::<Vec<_>>();
    pack(&right, &places(inner, columns), &places(columns, 1), &mut panels);
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
        let right = Right { values: &panels, stride: inner * PANEL };
        dispatch(Run(Product { left, right, bias: Some(&bias), out: &mut slices }));
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
        let expected = f64::from(bias[column]) + (0..inner).map(term).sum::<f64>();
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

#[test]
fn returned_memory_is_used_again_unless_it_is_far_too_large() {
    let buffers = Buffers::default();
    let buffer = buffers.take(1000);
    let address = buffer.as_ptr();
    buffers.give(buffer);
    let small = buffers.take(100);
    assert_ne!(small.as_ptr(), address);
    let again = buffers.take(900);
    assert_eq!((again.as_ptr(), again.len()), (address, 900));
}
