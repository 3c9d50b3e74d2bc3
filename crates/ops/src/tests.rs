//! The kernels against the plain tensor code, at sizes that reach their corners.

use burn::module::Param;
use burn::nn::LinearConfig;
use burn::tensor::activation::gelu;
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

use super::Rope;

/// Uniform in ±1; the same numbers on every run.
pub(crate) fn uniform(len: usize, seed: u64) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..len).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0).collect()
}

pub(crate) fn random<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    Tensor::from_data(TensorData::new(uniform(shape.iter().product(), seed), shape), &Device::flex())
}

/// Relative L2 error. Both are f32, whose rounding over some hundred terms stays below a few 1e-6.
pub(crate) fn assert_equal<const D: usize>(what: &str, got: Tensor<D>, expected: Tensor<D>) {
    assert_eq!(got.dims(), expected.dims(), "{what}");
    let norm = |x: Tensor<D>| x.square().sum().sqrt().into_scalar::<f32>();
    let error = norm(got - expected.clone()) / norm(expected);
    println!("{what}: {error:e}");
    assert!(error < 5e-6, "{what}: {error:e}");
}

#[test]
fn rotary_attention_equals_its_composition() {
    for (rows, columns, heads, head_dim) in [(2, 3, 2, 4), (13, 11, 3, 16), (16, 17, 1, 64)] {
        let (n, dim) = (rows * columns, heads * head_dim);
        let rope = Rope::new(rows, columns, head_dim, 100.0, &Device::flex());
        let [q, k, v] = [1, 2, 3].map(|seed| random([2, n, dim], seed));
        let expected = super::plain_attention(q.clone(), k.clone(), v.clone(), [&rope, &rope], heads);
        assert_equal(&format!("{n} tokens"), super::rotary_attention(q, k, v, &rope, heads, false), expected);
    }
}

#[test]
fn linear_gelu_equals_its_composition() {
    let mut layer = LinearConfig::new(20, 37).init(&Device::flex());
    layer.weight = Param::from_tensor(random([20, 37], 1));
    layer.bias = Some(Param::from_tensor(random([37], 2)));
    let x = random([2, 19, 20], 3);
    assert_equal("gelu", super::linear_gelu(&layer, x.clone()), gelu(layer.forward(x)));
}
