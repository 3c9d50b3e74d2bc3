//! The kernels of the regressor against the plain tensor code, with groups of several channels and sizes that reach
//! its corners: bands that do not divide, widths below a register block, strides.

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

use super::{Statistics, kernel};
use crate::config::Config;
use crate::weights::{WeightFile, init};

/// Uniform in ±1; the same numbers on every run.
fn random<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let values = (0..shape.iter().product()).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0);
    Tensor::from_data(TensorData::new(values.collect::<Vec<f32>>(), shape), &Device::flex())
}

/// Relative L2 error; both roads are f32, whose rounding over some hundred terms stays below a few 1e-6.
fn assert_equal<const D: usize>(what: &str, got: Tensor<D>, expected: Tensor<D>) {
    assert_eq!(got.dims(), expected.dims(), "{what}");
    let norm = |x: Tensor<D>| x.square().sum().sqrt().into_scalar::<f32>();
    let error = norm(got - expected.clone()) / norm(expected);
    println!("{what}: {error:e}");
    assert!(error < 5e-6, "{what}: {error:e}");
}

#[test]
fn the_fused_regressor_equals_the_composed_one() {
    for (groups, height, width) in [(16, 32, 44), (8, 20, 36), (4, 36, 64), (1, 24, 28)] {
        let mut config = Config::default();
        (config.network.enc_depth, config.network.dec_depth) = (1, 1);
        (config.network.enc_dim, config.network.dec_dim, config.network.hooks) = (64, 48, [0, 1, 1, 1]);
        config.regressor.groups = groups;
        let file = tempfile::NamedTempFile::new().expect("temporary file");
        init(&config, 5, file.path(), &|_, _| ()).expect("written");
        let weights = WeightFile::open(file.path(), None).expect("our file");
        let regressor = &weights.regressors(&Device::flex()).expect("weights")[0];
        // Means away from 0, as z ≈ 2 m is.
        let image = |seed| random([2, 6, height, width], seed) + 2.0;
        let x = image(1);
        let (mut fast, mut plain) = (Statistics::measured(), Statistics::measured());
        let got = kernel::regress(&regressor.pred_unet, &regressor.gs_conv, x.clone(), &mut fast);
        let composed = |x: Tensor<4>, statistics: &mut Statistics| {
            regressor.gs_conv.forward(regressor.pred_unet.forward(x, statistics)).permute([0, 2, 3, 1])
        };
        let what = format!("{groups} groups at {height}×{width}");
        assert_equal(&what, got.clone(), composed(x.clone(), &mut plain));
        // Each road understands the statistics of the other.
        let other = image(2);
        let by_fast =
            kernel::regress(&regressor.pred_unet, &regressor.gs_conv, other.clone(), &mut plain.frozen());
        assert_equal(&format!("{what}, frozen"), by_fast, composed(other, &mut fast.frozen()));
    }
}
