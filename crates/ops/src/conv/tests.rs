//! Every convolution against its adjoint, and the kernels' order of weights against PyTorch's.

use super::{
    Backward, CHANNELS, Conv, Moments, Plane, Shortcut, Source, Upstream, Wanted, arrange, rearrange,
    transpose,
};

use crate::tests::uniform as random;

fn dot(a: impl IntoIterator<Item = f64>, b: &[f32]) -> f64 {
    a.into_iter().zip(b).map(|(a, b)| a * f64::from(*b)).sum()
}

fn norm(values: &[f32]) -> f64 {
    dot(wide(values), values).sqrt()
}

fn wide(values: &[f32]) -> impl Iterator<Item = f64> {
    values.iter().map(|&x| f64::from(x))
}

/// ⟨conv x, g⟩ = ⟨x, ∂x⟩ = ⟨w, ∂w⟩ without bias: the convolution is linear in both.
#[test]
fn gradients_are_adjoint_to_the_convolution() {
    for ([height, width], stride, enlarge) in [
        ([12, 20], 1, false),
        ([7, 13], 1, false),
        ([33, 70], 1, false),
        ([12, 20], 2, false),
        ([7, 13], 2, false),
        ([6, 62], 1, true),
        ([5, 3], 1, true),
    ] {
        let planes: Vec<Plane> = (0..2)
            .map(|seed| {
                let data = random(height * width * CHANNELS, seed);
                Plane { height, width, data, moments: Moments::default() }
            })
            .collect();
        let sources: Vec<_> = planes.iter().map(|plane| Source { plane, affine: None }).collect();
        let weights = random(2 * 9 * CHANNELS * CHANNELS, 3);
        let (sources, weights) = (&sources[..], &weights[..]);
        let (bias, shortcut, scale) = ([0.0; CHANNELS], Shortcut::None, 1.0);
        let out = Conv { sources, weights, bias, stride, enlarge, shortcut, scale }.run();
        let gradient = random(out.data.len(), 4);
        let expected = dot(wide(&out.data), &gradient);
        let wanted = Wanted { input: true, parameters: true };
        let upstream = Upstream::Scaled(&gradient, 1.0);
        let got = Backward { sources, weights, upstream, stride, enlarge, wanted }.run();
        let by_input: f64 = planes.iter().zip(&got.inputs).map(|(plane, g)| dot(wide(g), &plane.data)).sum();
        let by_weight = dot(got.weights.iter().copied(), weights);
        // Each of the outputs carries the rounding of 288 products.
        let scale = norm(&out.data) * norm(&gradient);
        for (what, value) in [("input", by_input), ("weight", by_weight)] {
            let error = (value - expected).abs();
            assert!(error < 1e-6 * scale, "{height}×{width}, stride {stride}, {enlarge}, {what}: {error:e}");
        }
    }
}

#[test]
fn weights_find_their_way_back() {
    for shape in [[16, 6, 9], [14, 16, 9], [16, 32, 9], [16, 32, 1], [14, 14, 1]] {
        let values = random(shape.iter().product(), 1);
        let arranged: Vec<f64> = wide(&arrange(&values, shape)).collect();
        let mut back = vec![0.0; values.len()];
        rearrange(&arranged, shape, &mut back);
        assert!(back.iter().zip(&values).all(|(a, b)| *a == f64::from(*b)), "{shape:?}");
    }
}

#[test]
fn transposed_twice_is_untouched() {
    let weights = random(9 * CHANNELS * CHANNELS, 1);
    let transposed = transpose(&weights);
    assert_eq!(transposed[CHANNELS], weights[1]);
    assert_eq!(transpose(&transposed), weights);
}
