//! The operators against Burn's in f64, forward and backward, with channels that fill no group, tiles and blocks that
//! overhang, and single rows.

use super::*;
use crate::op::{Given, Kernel};
use crate::rotary::plain_attention;
use crate::testing::{assert_equal, relative_error, tensor, uniform as random, values, wide};
use crate::{Rope, bilinear, has_kernels, is_bf16, layers, linear_gelu, rotary_attention};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::nn::conv::{Conv2dConfig, ConvTranspose2dConfig};
use burn::nn::{LayerNormConfig, LinearConfig, PaddingConfig2d};
use burn::tensor::{Device, FloatDType, Gradients, Tensor};

/// Replaces all parameters by random values of a float type.
struct Filled {
    float: FloatDType,
    seed: u64,
}

impl ModuleMapper for Filled {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, values, mapper) = param.consume();
        self.seed += 1;
        let values = tensor(values.dims(), self.seed, self.float);
        Param::from_mapped_value(id, values.require_grad(), mapper)
    }
}

/// Collects the gradients of all parameters.
struct Collect<'a>(&'a Gradients, Vec<Vec<f64>>);

impl ModuleVisitor for Collect<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.1.push(values(param.val().grad(self.0).expect("every parameter counts")));
    }
}

/// Compares `run` in f32, and in f32 with parameters in bf16, with `run` in f64: the result, and the gradients of the
/// input and of the module's parameters. Only an input in f32 reaches the operators of this crate.
fn check<M: Module, const A: usize, const D: usize>(
    what: &str,
    module: M,
    shape: [usize; A],
    run: impl Fn(&M, Tensor<A>) -> Tensor<D>,
) {
    use FloatDType::{BF16, F32, F64};
    let [got, half, expected] = [(F32, F32), (BF16, F32), (F64, F64)].map(|(of_module, float)| {
        let module = module.clone().map(&mut Filled { float: of_module, seed: 10 });
        let x = tensor(shape, 1, float).require_grad();
        let y = run(&module, x.clone());
        let all = (y.clone() * tensor(y.dims(), 2, float)).sum().backward();
        let of_input = values(x.grad(&all).expect("tracked"));
        let mut collect = Collect(&all, vec![values(y), of_input]);
        module.visit(&mut collect);
        collect.1
    });
    for (i, ((got, half), expected)) in got.iter().zip(&half).zip(&expected).enumerate() {
        assert_equal(&format!("{what}, tensor {i}"), got, expected);
        // The rounding of bf16 is 2⁻⁹ at most. The bound also keeps the cosine above 0.9999.
        let error = relative_error(half, expected);
        println!("{what}, tensor {i} in bf16: {error:e}");
        assert!(error < 1e-2, "{what}, tensor {i} in bf16: {error:e}");
    }
}

/// Compares a convolution, also of max(x, 0), with a padding of half a kernel.
fn check_convolution([batch, inputs, outputs, height, width]: [usize; 5], side: usize, stride: usize) {
    let half = side / 2;
    let layer = Conv2dConfig::new([inputs, outputs], [side; 2]).with_stride([stride; 2]);
    let layer = layer.with_padding(PaddingConfig2d::Explicit(half, half, half, half));
    for rectified in [false, true] {
        let what = format!("{batch}×{inputs}→{outputs} at {height}×{width}, stride {stride}, {rectified}");
        let layer = layer.init(&Device::flex().autodiff());
        check(&what, layer, [batch, inputs, height, width], |l, x| layers::conv2d(l, x, rectified));
    }
}

#[test]
fn convolutions_of_three_taps_equal_burns() {
    for size in [
        [1, 1, 1, 1, 1],
        [2, 5, 7, 2, 3],
        [1, 16, 48, 9, 13],
        [3, 33, 17, 1, 21],
        [1, 3, 2, 5, 700],
        [2, 20, 40, 18, 33],
        [3, 5, 18, 19, 21],
    ] {
        [1, 2].into_iter().for_each(|stride| check_convolution(size, 3, stride));
    }
}

/// A 3×3 convolution with stride 1.
fn convolution([batch, inputs, outputs, height, width]: [usize; 5]) -> Convolution {
    let (side, stride, rectified, in_bf16) = (3, 1, false, false);
    Convolution { batch, inputs, outputs, height, width, side, stride, rectified, in_bf16 }
}

#[test]
fn taps_that_see_nothing_have_no_gradient() {
    let conv = Convolution { rectified: true, ..convolution([1, 1, 1, 32, 32]) };
    let mut x = vec![-1.0; 1024];
    x[0] = 0.7;
    let mut dy = vec![0.0; 1024];
    dy[0] = 0.3;
    let inputs: [&[f32]; 3] = [&x, &[0.1; 9], &[0.0]];
    let [_, weight, _] = conv.backward(Given { inputs, kept: None, upstream: &dy, wanted: [true; 3] });
    let expected: Vec<f32> = (0..9).map(|tap| if tap == 4 { 0.7 * 0.3 } else { 0.0 }).collect();
    assert_eq!(weight, Some(expected));
}

#[test]
fn convolutions_of_one_tap_equal_burns() {
    for size in [[1, 1, 1, 1, 1], [2, 35, 4, 9, 7], [3, 20, 40, 1, 300], [1, 4, 3, 130, 90]] {
        check_convolution(size, 1, 1);
    }
}

#[test]
fn transposed_convolutions_equal_burns() {
    for (stride, [batch, inputs, outputs, height, width]) in
        [(2, [2, 18, 35, 3, 5]), (4, [1, 16, 8, 4, 4]), (3, [3, 1, 1, 1, 2]), (2, [1, 40, 70, 30, 9])]
    {
        let layer = ConvTranspose2dConfig::new([inputs, outputs], [stride; 2]).with_stride([stride; 2]);
        let layer = layer.init(&Device::flex().autodiff());
        let what = format!("{batch}×{inputs}→{outputs} at {height}×{width}, {stride} times as large");
        check(&what, layer, [batch, inputs, height, width], layers::enlarge);
    }
}

#[test]
fn patch_embeddings_equal_burns() {
    for [batch, inputs, outputs, height, width, side] in
        [[2, 3, 19, 6, 4, 2], [1, 8, 5, 3, 12, 3], [3, 1, 1, 16, 16, 16]]
    {
        let layer = Conv2dConfig::new([inputs, outputs], [side; 2]).with_stride([side; 2]);
        let layer = layer.with_padding(PaddingConfig2d::Valid).init(&Device::flex().autodiff());
        check(&format!("patches of {side}"), layer, [batch, inputs, height, width], layers::patches);
    }
}

#[test]
fn linear_layers_equal_burns() {
    for [rows, inputs, outputs] in [[1, 1, 16], [7, 20, 37], [131, 9, 70], [300, 5, 3]] {
        let layer = LinearConfig::new(inputs, outputs).init(&Device::flex().autodiff());
        let (what, shape) = (format!("{rows}×{inputs}→{outputs}"), [1, rows, inputs]);
        check(&what, layer.clone(), shape, layers::linear);
        check(&format!("{what}, GELU"), layer, shape, linear_gelu);
    }
}

#[test]
fn layer_norm_equals_burns() {
    for [rows, channels] in [[1, 3], [130, 37], [3, 192]] {
        let layer = LayerNormConfig::new(channels).with_epsilon(1e-6).init(&Device::flex().autodiff());
        let norm = |l: &_, x| layers::layer_norm(l, 1e-6, x);
        check(&format!("{rows}×{channels}"), layer, [1, rows, channels], norm);
    }
}

/// Keys and values as parameters, so that `check` compares their gradients.
#[derive(Module, Debug)]
struct Pairs {
    keys: Param<Tensor<3>>,
    values: Param<Tensor<3>>,
}

#[test]
fn rotary_attention_equals_burns() {
    let device = Device::flex().autodiff();
    for [batch, rows, columns, heads, head_dim] in
        [[1, 1, 1, 1, 4], [2, 1, 5, 3, 8], [1, 10, 7, 2, 4], [2, 13, 11, 3, 16], [2, 16, 17, 1, 64]]
    {
        let (n, c) = (rows * columns, heads * head_dim);
        let zeros = || Param::from_tensor(Tensor::zeros([batch, n, c], &device));
        let rope = Rope::new(rows, columns, head_dim, 100.0, &device);
        let run = |pairs: &Pairs, q: Tensor<3>| {
            let (k, v) = (pairs.keys.val(), pairs.values.val());
            if has_kernels(&q) {
                let in_bf16 = is_bf16(&pairs.keys);
                let [k, v] = [k, v].map(|x| x.cast(FloatDType::F32));
                return rotary_attention([q, k, v], &rope, heads, in_bf16);
            }
            let [cos, sin] = [&rope.cos, &rope.sin].map(|table| table.clone().cast(FloatDType::F64));
            plain_attention([q, k, v], &Rope { cos, sin }, heads)
        };
        let pairs = Pairs { keys: zeros(), values: zeros() };
        check(&format!("{rows}×{columns} tokens"), pairs, [batch, n, c], run);
    }
}

#[test]
fn resizing_equals_burns() {
    for (from, to) in [([1, 1], [2, 2]), ([3, 5], [6, 10]), ([9, 2], [4, 7]), ([5, 6], [5, 13])] {
        for align_corners in [false, true] {
            let nothing = Vec::<Param<Tensor<1>>>::new();
            let what = format!("{from:?} → {to:?}, {align_corners}");
            check(&what, nothing, [1, 3, from[0], from[1]], |_, x| bilinear(x, to, align_corners));
        }
    }
}

/// Results and gradients of all operators, at sizes that need several tasks.
fn everything(in_bf16: bool) -> Vec<Vec<f32>> {
    fn add(all: &mut Vec<Vec<f32>>, kernel: &dyn Kernel, [x, y, z, upstream]: [&[f32]; 4]) {
        let (inputs, wanted) = ([x, y, z], [true; 3]);
        let (result, kept) = kernel.forward(inputs, true);
        assert_eq!(kernel.forward(inputs, false).0, result);
        all.push(result);
        all.extend(kernel.backward(Given { inputs, kept, upstream, wanted }).into_iter().flatten());
    }
    let mut all = Vec::new();
    let (x, dy) = (random(2 * 40 * 30 * 50, 1), random(2 * 72 * 30 * 50, 2));
    let (weight, bias) = (random(72 * 40 * 9, 3), random(72, 4));
    let (batch, outputs) = (2, 72);
    let given = [&x[..], &weight, &bias, &dy];
    let conv = Convolution { rectified: true, in_bf16, ..convolution([batch, 40, outputs, 30, 50]) };
    add(&mut all, &conv, given);
    let halving = Convolution { stride: 2, ..conv };
    add(&mut all, &halving, [&x, &weight, &bias, &dy[..2 * 72 * 15 * 25]]);
    add(&mut all, &Convolution { side: 1, ..conv }, given);
    let linear = Linear { rows: 1500, inputs: 80, outputs, transposed: false, in_bf16, gelu: true };
    add(&mut all, &linear, given);
    let norm = LayerNorm { channels: 80, epsilon: 1e-6 };
    add(&mut all, &norm, [&x, &weight[..80], &weight[..80], &dy[..x.len()]]);
    let rope = [0, 1].map(|table| dy[table * 150 * 8..][..150 * 8].to_vec());
    let attention = Attention { batch, tokens: 150, heads: 2, head_dim: 8, in_bf16, rope };
    let len = 2 * 150 * 16;
    add(&mut all, &attention, [&x[..len], &x[len..2 * len], &x[2 * len..3 * len], &dy[..len]]);
    all
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let run = |threads: usize, in_bf16: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        pool.install(|| everything(in_bf16)).into_iter().map(bits).collect::<Vec<_>>()
    };
    for in_bf16 in [false, true] {
        assert!(run(1, in_bf16) == run(3, in_bf16), "{in_bf16}");
    }
}

#[test]
fn only_wanted_gradients_are_found_and_they_are_the_same() {
    let conv = convolution([1, 3, 5, 6, 7]);
    let (x, weight, dy) = (random(3 * 42, 1), random(135, 2), random(5 * 42, 3));
    let inputs: [&[f32]; 3] = [&x, &weight, &[0.0]];
    let backward = |wanted| conv.backward(Given { inputs, kept: None, upstream: &dy, wanted });
    let all = backward([true; 3]);
    for bits in 0..8 {
        let wanted = [1, 2, 4].map(|bit| bits & bit > 0);
        let got = backward(wanted);
        assert_eq!(got[0], all[0].clone().filter(|_| wanted[0]));
        assert_eq!(got[1], all[1].clone().filter(|_| wanted[1]));
        assert_eq!(got[2].is_some(), wanted[2]);
        let all = all[2].as_ref().expect("all are wanted");
        assert_equal("bias", &wide(got[2].as_ref().unwrap_or(all)), &wide(all));
    }
}
