//! What the tests share: random values, and comparisons with a reference.

use burn::tensor::{Device, FloatDType, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

/// Uniform in ±1 from a fixed seed.
pub fn uniform(len: usize, seed: u64) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..len).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0).collect()
}

/// [`uniform`] values on `flex`.
pub fn random<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    Tensor::from_data(TensorData::new(uniform(shape.iter().product(), seed), shape), &Device::flex())
}

/// [`uniform`] values of any float type on `flex` with autodiff.
pub fn tensor<const D: usize>(shape: [usize; D], seed: u64, float: FloatDType) -> Tensor<D> {
    let data = TensorData::new(uniform(shape.iter().product(), seed), shape);
    Tensor::<D>::from_data(data, &Device::flex().autodiff()).cast(float)
}

/// The values of a tensor of any float type.
pub fn values<const D: usize>(x: Tensor<D>) -> Vec<f64> {
    x.into_data().convert::<f64>().try_into_vec().expect("f64")
}

/// The values in f64.
pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

/// The L2 norm of the difference over the norm of the expected values.
pub fn relative_error(got: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    let difference = norm(&mut got.iter().zip(expected).map(|(got, expected)| got - expected));
    difference / norm(&mut expected.iter().copied()).max(1e-15)
}

/// Bounds the relative error. Sums have up to some thousand terms of 24 bits, and Winograd's points magnify their
/// rounding. The largest error is 2.5e-6, of a weight gradient.
pub fn assert_equal(what: &str, got: &[f64], expected: &[f64]) {
    let error = relative_error(got, expected);
    println!("{what}: {error:e}");
    assert!(error < 5e-6, "{what}: {error:e}");
}
