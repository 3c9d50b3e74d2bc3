//! Sums in two steps against Burn's.

use burn::tensor::FloatDType;

use crate::testing::{assert_equal, tensor, values};
use crate::{mean, spread_last, sum_last};

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
