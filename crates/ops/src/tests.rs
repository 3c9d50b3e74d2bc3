//! The kernels against the plain tensor code, at sizes that are no multiple of a block.

use burn::module::Param;
use burn::nn::LinearConfig;
use burn::tensor::activation::gelu;
use burn::tensor::{Device, FloatDType};

use crate::rotary::plain_attention;
use crate::testing::{assert_equal, random, tensor, values};
use crate::{Rope, linear_gelu, mean, rotary_attention, spread_last, sum_last};

#[test]
fn rotary_attention_equals_its_composition() {
    for (rows, columns, heads, head_dim) in [(2, 3, 2, 4), (13, 11, 3, 16), (16, 17, 1, 64)] {
        let (n, dim) = (rows * columns, heads * head_dim);
        let rope = Rope::new(rows, columns, head_dim, 100.0, &Device::flex());
        let [q, k, v] = [1, 2, 3].map(|seed| random([2, n, dim], seed));
        let expected = plain_attention(q.clone(), k.clone(), v.clone(), [&rope, &rope], heads);
        let got = rotary_attention(q, k, v, &rope, heads, false);
        assert_equal(&format!("{n} tokens"), &values(got), &values(expected));
    }
}

#[test]
fn linear_gelu_equals_its_composition() {
    let mut layer = LinearConfig::new(20, 37).init(&Device::flex());
    layer.weight = Param::from_tensor(random([20, 37], 1));
    layer.bias = Some(Param::from_tensor(random([37], 2)));
    let x = random([2, 19, 20], 3);
    assert_equal("gelu", &values(linear_gelu(&layer, x.clone())), &values(gelu(layer.forward(x))));
}

/// Also for a prime number of values, which are summed in one step.
#[test]
fn sums_in_two_steps_and_their_gradients_equal_burns() {
    for n in [1, 6, 12, 13, 30] {
        let tracked = |shape: [usize; 3], seed| tensor(shape, seed, FloatDType::F32).require_grad();
        let (x, few) = (tracked([2, 3, n], 1), tracked([2, 3, 1], 2));
        let results = [
            [sum_last(x.clone()) * few.clone(), spread_last(few.clone(), n) * x.clone()],
            [x.clone().sum_dim(2) * few.clone(), few.clone() * x.clone()],
        ];
        let [ours, burns] = results.map(|results| {
            results.map(|y| {
                let gradients = y.clone().square().sum().backward();
                [&x, &few].map(|x| x.grad(&gradients).expect("tracked"))
            })
        });
        for (ours, burns) in ours.into_iter().flatten().zip(burns.into_iter().flatten()) {
            assert_equal(&format!("{n} values"), &values(ours), &values(burns));
        }
        assert_equal("mean", &values(mean(x.clone())), &values(x.mean()));
    }
}
