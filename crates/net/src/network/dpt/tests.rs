//! The fused road of the head against Burn's operators, on odd token grids and with channels that fill no vector.

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

use super::DptHead;
use crate::config::NetworkConfig;

/// Uniform in ±1; the same numbers on every run.
fn random<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let values = (0..shape.iter().product()).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0);
    Tensor::from_data(TensorData::new(values.collect::<Vec<f32>>(), shape), &Device::flex())
}

#[test]
fn the_fused_head_equals_the_composed_one() {
    Device::flex().seed(5);
    let layer_dims = [24, 40, 33, 64];
    let config = NetworkConfig { layer_dims, feature_dim: 40, last_dim: 20, ..NetworkConfig::default() };
    let head = DptHead::new(&config, [64, 48, 47, 50], &Device::flex());
    for [batch, rows, columns] in [[1, 1, 1], [2, 3, 5], [1, 4, 9]] {
        let (tokens, grid) =
            ([64, 48, 47, 50].map(|c| random([batch, rows * columns, c], 7)), [rows, columns]);
        let (got, expected) = (head.forward(tokens.clone(), grid), head.compose(tokens, grid));
        assert_eq!(got.dims(), [batch, 4, 16 * rows, 16 * columns]);
        let norm = |x: Tensor<4>| x.square().sum().sqrt().into_scalar::<f32>();
        let error = norm(got - expected.clone()) / norm(expected);
        // Both are f32; some twenty convolutions follow one another, each good to 1e-6.
        assert!(error < 5e-6, "{rows}×{columns}: {error:e}");
    }
}
