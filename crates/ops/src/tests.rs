//! The kernels against the plain tensor code, at sizes that are no multiple of a block.

use burn::module::Param;
use burn::nn::LinearConfig;
use burn::tensor::activation::gelu;
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngCore, SeedableRng};

use super::Rope;

/// Uniform in ±1 from a fixed seed.
pub(crate) fn uniform(len: usize, seed: u64) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..len).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0).collect()
}

pub(crate) fn random<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    Tensor::from_data(TensorData::new(uniform(shape.iter().product(), seed), shape), &Device::flex())
}

/// Bounds the relative L2 error. f32 rounding over some hundred terms stays below a few 1e-6.
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

/// Also for a prime number of values, which are summed in one step.
#[test]
fn sums_in_two_steps_and_their_gradients_equal_burns() {
    let device = Device::flex().autodiff();
    for n in [1, 6, 12, 13, 30] {
        let tracked = |shape, seed| {
            let data = random::<3>(shape, seed).into_data();
            Tensor::<3>::from_data(data, &device).require_grad()
        };
        let (x, few) = (tracked([2, 3, n], 1), tracked([2, 3, 1], 2));
        let results = [
            [super::sum_last(x.clone()) * few.clone(), super::spread_last(few.clone(), n) * x.clone()],
            [x.clone().sum_dim(2) * few.clone(), few.clone() * x.clone()],
        ];
        let [ours, burns] = results.map(|results| {
            results.map(|y| {
                let gradients = y.clone().square().sum().backward();
                [&x, &few].map(|x| x.grad(&gradients).expect("tracked"))
            })
        });
        for (ours, burns) in ours.into_iter().flatten().zip(burns.into_iter().flatten()) {
            assert_equal(&format!("{n} values"), ours, burns);
        }
        assert_equal("mean", super::mean(x.clone().inner()), x.clone().inner().mean());
    }
}
