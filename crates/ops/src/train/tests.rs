//! Every operator against plain loops in f64, at sizes that reach the corners: channels that fill no group, tiles and
//! blocks that overhang, single rows. Gradients are compared with central differences of those loops.

use super::reference::{self as plain, Convolution};
use super::*;
use rand::{RngCore, SeedableRng};
use snapsnap_base::bilinear::taps;

/// Uniform in ±1; the same numbers on every run.
pub fn random(len: usize, seed: u64) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..len).map(|_| random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

/// Relative L2 error. Sums here have up to some thousand terms of 24 bits, and Winograd's points magnify their rounding:
/// the worst of all is 2.5e-6, of a weight gradient.
fn assert_equal(what: &str, got: &[f32], expected: &[f64]) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let square = |x: f64| x * x;
    let difference: f64 = got.iter().zip(expected).map(|(g, e)| square(f64::from(*g) - e)).sum();
    let error = (difference / expected.iter().copied().map(square).sum::<f64>().max(1e-30)).sqrt();
    println!("{what}: {error:e}");
    assert!(error < 5e-6, "{what}: {error:e}");
}

/// Compares a result and gradients (nothing for inputs without one) with those of `plain`, a function of the inputs.
fn check(
    what: &str,
    inputs: &[&[f32]],
    plain: impl Fn(&[Vec<f64>]) -> Vec<f64>,
    result: &[f32],
    dy: &[f32],
    gradients: &[Option<&[f32]>],
) {
    /// Elements per input whose difference is taken.
    const SAMPLES: usize = 16;
    /// Half the distance: f64's rounding over it, and its square, are 1e-10.
    const STEP: f64 = 1e-5;
    let inputs: Vec<_> = inputs.iter().map(|x| wide(x)).collect();
    assert_equal(&format!("{what}, result"), result, &plain(&inputs));
    let loss =
        |inputs: &[Vec<f64>]| -> f64 { plain(inputs).iter().zip(dy).map(|(y, g)| y * f64::from(*g)).sum() };
    for (i, gradient) in gradients.iter().enumerate() {
        let Some(gradient) = gradient else { continue };
        assert_eq!(gradient.len(), inputs[i].len(), "{what}, gradient {i}");
        let step = inputs[i].len().div_ceil(SAMPLES);
        let slope = |at: usize| {
            let mut moved = inputs.clone();
            moved[i][at] += STEP;
            let above = loss(&moved);
            moved[i][at] -= 2.0 * STEP;
            (above - loss(&moved)) / (2.0 * STEP)
        };
        let places = (0..inputs[i].len()).step_by(step);
        let (got, expected): (Vec<_>, Vec<_>) = places.map(|at| (gradient[at], slope(at))).unzip();
        assert_equal(&format!("{what}, gradient {i}"), &got, &expected);
    }
}

/// The same for an input, a weight and a bias.
fn check_layer(
    what: &str,
    inputs: [&[f32]; 3],
    plain: impl Fn(&[Vec<f64>]) -> Vec<f64>,
    result: &[f32],
    dy: &[f32],
    gradients: &Gradients,
) {
    let Gradients { input, weight, bias } = gradients;
    check(what, &inputs, plain, result, dy, &[input.as_deref(), weight.as_deref(), bias.as_deref()]);
}

#[test]
fn convolutions_of_three_taps_equal_plain_loops() {
    let sizes = [
        [1, 1, 1, 1, 1],
        [2, 5, 7, 2, 3],
        [1, 16, 48, 9, 13],
        [3, 33, 17, 1, 21],
        [1, 3, 2, 5, 700],
        [2, 20, 40, 18, 33],
        [3, 5, 18, 19, 21],
    ];
    for ([batch, inputs, outputs, height, width], stride) in
        sizes.into_iter().flat_map(|size| [1, 2].map(|stride| (size, stride)))
    {
        for rectified in [false, true] {
            let what =
                format!("{batch}×{inputs}→{outputs} at {height}×{width}, stride {stride}, {rectified}");
            let reference =
                Convolution { batch, inputs, outputs, height, width, side: 3, stride, padding: 1, rectified };
            let x = random(batch * inputs * height * width, 1);
            let (weight, bias) = (random(outputs * inputs * 9, 2), random(outputs, 3));
            let dy = random(batch * outputs * height.div_ceil(stride) * width.div_ceil(stride), 4);
            let (result, gradients) = if stride == 1 {
                let conv = Conv3x3 { batch, inputs, outputs, height, width, rectified };
                let result = conv.forward(&x, &weight, Some(&bias));
                (result, conv.backward(&x, &weight, &dy, Wanted::ALL))
            } else {
                let conv = Unfolded { batch, inputs, outputs, height, width, stride, rectified };
                let result = conv.forward(&x, &weight, Some(&bias));
                (result, conv.backward(&x, &weight, &dy, Wanted::ALL))
            };
            let plain = |x: &[Vec<f64>]| reference.run(&x[0], &x[1], &x[2]);
            check_layer(&what, [&x, &weight, &bias], plain, &result, &dy, &gradients);
        }
    }
}

/// A channel that lives in one corner: eight taps see it nowhere beside an output's gradient.
#[test]
fn taps_that_see_nothing_have_no_gradient() {
    let conv = Conv3x3 { batch: 1, inputs: 1, outputs: 1, height: 32, width: 32, rectified: true };
    let mut x = vec![-1.0; 1024];
    x[0] = 0.7;
    let mut dy = vec![0.0; 1024];
    dy[0] = 0.3;
    let gradients = conv.backward(&x, &[0.1; 9], &dy, Wanted::ALL);
    let expected: Vec<f32> = (0..9).map(|tap| if tap == 4 { 0.7 * 0.3 } else { 0.0 }).collect();
    assert_eq!(gradients.weight, Some(expected));
}

#[test]
fn convolutions_of_one_tap_equal_plain_loops() {
    for [batch, inputs, outputs, height, width] in
        [[1, 1, 1, 1, 1], [2, 35, 4, 9, 7], [3, 20, 40, 1, 300], [1, 4, 3, 130, 90]]
    {
        for rectified in [false, true] {
            let reference = Convolution {
                batch,
                inputs,
                outputs,
                height,
                width,
                side: 1,
                stride: 1,
                padding: 0,
                rectified,
            };
            let conv = Conv1x1 { batch, inputs, outputs, pixels: height * width, rectified };
            let x = random(batch * inputs * height * width, 1);
            let (weight, bias) = (random(outputs * inputs, 2), random(outputs, 3));
            let dy = random(batch * outputs * height * width, 4);
            let result = conv.forward(&x, &weight, Some(&bias));
            let gradients = conv.backward(&x, &weight, &dy, Wanted::ALL);
            let plain = |x: &[Vec<f64>]| reference.run(&x[0], &x[1], &x[2]);
            let what = format!("{batch}×{inputs}→{outputs} at {height}×{width}, {rectified}");
            check_layer(&what, [&x, &weight, &bias], plain, &result, &dy, &gradients);
        }
    }
}

#[test]
fn transposed_convolutions_equal_plain_loops() {
    for (stride, [batch, inputs, outputs, height, width]) in
        [(2, [2, 18, 35, 3, 5]), (4, [1, 16, 8, 4, 4]), (3, [3, 1, 1, 1, 2]), (2, [1, 40, 70, 30, 9])]
    {
        let layer = Enlarge { batch, inputs, outputs, height, width, stride };
        let x = random(batch * inputs * height * width, 1);
        let (weight, bias) = (random(inputs * outputs * stride * stride, 2), random(outputs, 3));
        let dy = random(batch * outputs * height * width * stride * stride, 4);
        let result = layer.forward(&x, &weight, Some(&bias));
        let gradients = layer.backward(&x, &weight, &dy, Wanted::ALL);
        let plain = |x: &[Vec<f64>]| plain::enlarge(&layer, &x[0], &x[1], &x[2]);
        let what = format!("{batch}×{inputs}→{outputs} at {height}×{width}, {stride} times as large");
        check_layer(&what, [&x, &weight, &bias], plain, &result, &dy, &gradients);
    }
}

#[test]
fn patch_embeddings_equal_plain_loops() {
    for [batch, inputs, outputs, height, width, side] in
        [[2, 3, 19, 6, 4, 2], [1, 8, 5, 3, 12, 3], [3, 1, 1, 16, 16, 16]]
    {
        let layer = Patches { batch, inputs, outputs, height, width, side };
        let reference = Convolution {
            batch,
            inputs,
            outputs,
            height,
            width,
            side,
            stride: side,
            padding: 0,
            rectified: false,
        };
        let x = random(batch * inputs * height * width, 1);
        let (weight, bias) = (random(outputs * inputs * side * side, 2), random(outputs, 3));
        let tokens = height / side * (width / side);
        let dy = random(batch * tokens * outputs, 4);
        let result = layer.forward(&x, &weight, Some(&bias));
        let gradients = layer.backward(&x, &weight, &dy, Wanted::ALL);
        let plain = |x: &[Vec<f64>]| {
            let planes = reference.run(&x[0], &x[1], &x[2]);
            let place =
                |i: usize| (i / outputs / tokens * outputs + i % outputs) * tokens + i / outputs % tokens;
            (0..planes.len()).map(|i| planes[place(i)]).collect()
        };
        check_layer(&format!("patches of {side}"), [&x, &weight, &bias], plain, &result, &dy, &gradients);
    }
}

#[test]
fn linear_layers_equal_plain_loops() {
    for [rows, inputs, outputs] in [[1, 1, 16], [7, 20, 37], [131, 9, 70], [300, 5, 3]] {
        for (gelu, transposed) in [(false, false), (false, true), (true, false), (true, true)] {
            let layer = Linear { rows, inputs, outputs, transposed };
            let (x, weight) = (random(rows * inputs, 1), random(inputs * outputs, 2));
            let (bias, dy) = (random(outputs, 3), random(rows * outputs, 4));
            let (result, before) = if gelu {
                let [result, before] = layer.forward_gelu(&x, &weight, Some(&bias));
                (result, Some(before))
            } else {
                (layer.forward(&x, &weight, Some(&bias)), None)
            };
            let gradients = layer.backward(&x, &weight, before.as_deref(), &dy, Wanted::ALL);
            let plain = |x: &[Vec<f64>]| {
                let y = plain::linear(&layer, &x[0], &x[1], &x[2]);
                if gelu { y.into_iter().map(plain::gelu).collect() } else { y }
            };
            let what = format!("{rows}×{inputs}→{outputs}, GELU {gelu}, transposed {transposed}");
            check_layer(&what, [&x, &weight, &bias], plain, &result, &dy, &gradients);
        }
    }
}

#[test]
fn layer_norm_equals_plain_loops() {
    for [rows, channels] in [[1, 3], [130, 37], [3, 192]] {
        let norm = LayerNorm { channels, epsilon: 1e-6 };
        let x = random(rows * channels, 1);
        let (weight, bias, dy) = (random(channels, 2), random(channels, 3), random(rows * channels, 4));
        let (result, statistics) = norm.forward(&x, &weight, &bias);
        let gradients = norm.backward(&x, &weight, &statistics, &dy, Wanted::ALL);
        let plain = |x: &[Vec<f64>]| plain::layer_norm(1e-6, &x[0], &x[1], &x[2]);
        check_layer(&format!("{rows}×{channels}"), [&x, &weight, &bias], plain, &result, &dy, &gradients);
    }
}

#[test]
fn rotary_attention_equals_plain_loops() {
    for [batch, queries, keys, heads, head_dim] in [[1, 1, 1, 1, 4], [2, 5, 5, 3, 8], [1, 70, 66, 2, 4]] {
        let attention = Attention { batch, queries, keys, heads, head_dim };
        let channels = heads * head_dim;
        let inputs = [queries, keys, keys].map(|n| batch * n * channels);
        let [q, k, v] = [0, 1, 2].map(|i| random(inputs[i], i as u64));
        let dy = random(batch * queries * channels, 4);
        let tables = plain::tables(queries.max(keys), head_dim);
        let (qkv, rope) = (Tokens::apart([&q, &k, &v], channels), [&tables[0][..], &tables[1]]);
        let (result, logarithms) = attention.forward(qkv, rope);
        let gradients = attention.backward(qkv, rope, &logarithms, &dy);
        let what = format!("{queries} and {keys} tokens");
        let plain = |x: &[Vec<f64>]| plain::attention(&attention, rope, &x[0], &x[1], &x[2]);
        let gradients = gradients.each_ref().map(|gradient| Some(&gradient[..]));
        check(&what, &[&q, &k, &v], plain, &result, &dy, &gradients);
    }
}

#[test]
fn attention_of_parts_equals_that_of_tensors() {
    let attention = Attention { batch: 2, queries: 67, keys: 67, heads: 2, head_dim: 8 };
    let (channels, tokens) = (16, 2 * 67);
    let (qkv, dy) = (random(tokens * 3 * channels, 1), random(tokens * channels, 2));
    let part = |i: usize| -> Vec<f32> {
        qkv.chunks_exact(3 * channels).flat_map(|token| &token[i * channels..][..channels]).copied().collect()
    };
    let apart = [part(0), part(1), part(2)];
    let tables = plain::tables(67, 8);
    let rope = [&tables[0][..], &tables[1]];
    let (parts, tensors) =
        (Tokens::parts(&qkv, channels), Tokens::apart(apart.each_ref().map(|x| &x[..]), channels));
    let (result, logarithms) = attention.forward(parts, rope);
    assert_eq!(result, attention.forward(tensors, rope).0);
    let joined = attention.backward_parts(parts, rope, &logarithms, &dy);
    let gradients = attention.backward(tensors, rope, &logarithms, &dy);
    for (i, got) in joined.chunks_exact(channels).enumerate() {
        assert_eq!(got, &gradients[i % 3][i / 3 * channels..][..channels]);
    }
}

#[test]
fn resizing_back_equals_plain_loops() {
    for (from, to) in [([1, 1], [2, 2]), ([3, 5], [6, 10]), ([9, 2], [4, 7]), ([5, 6], [5, 13])] {
        for align_corners in [false, true] {
            let [down, across] = [0, 1].map(|axis| taps(from[axis], to[axis], align_corners));
            let (x, dy) = (random(3 * from[0] * from[1], 1), random(3 * to[0] * to[1], 2));
            let result = resize(&x, from, &down, &across);
            let gradient = resize_gradient(&dy, from, &down, &across);
            let plain = |x: &[Vec<f64>]| plain::resize(&x[0], from, &down, &across);
            check(
                &format!("{from:?} → {to:?}, {align_corners}"),
                &[&x],
                plain,
                &result,
                &dy,
                &[Some(&gradient)],
            );
        }
    }
}

/// Results and gradients of all operators, at sizes of several tasks.
fn everything() -> Vec<Vec<f32>> {
    let mut all = Vec::new();
    let keep = |all: &mut Vec<_>, g: Gradients| all.extend([g.input, g.weight, g.bias].into_iter().flatten());
    let (x, dy) = (random(2 * 40 * 30 * 50, 1), random(2 * 72 * 30 * 50, 2));
    let (weight, bias) = (random(72 * 40 * 9, 3), random(72, 4));
    let conv = Conv3x3 { batch: 2, inputs: 40, outputs: 72, height: 30, width: 50, rectified: true };
    all.push(conv.forward(&x, &weight, Some(&bias)));
    keep(&mut all, conv.backward(&x, &weight, &dy, Wanted::ALL));
    let conv = Conv1x1 { batch: 2, inputs: 40, outputs: 72, pixels: 1500, rectified: true };
    all.push(conv.forward(&x, &weight, Some(&bias)));
    keep(&mut all, conv.backward(&x, &weight, &dy, Wanted::ALL));
    let linear = Linear { rows: 1500, inputs: 80, outputs: 72, transposed: false };
    let [result, before] = linear.forward_gelu(&x, &weight, Some(&bias));
    all.push(result);
    keep(&mut all, linear.backward(&x, &weight, Some(&before), &dy, Wanted::ALL));
    let norm = LayerNorm { channels: 80, epsilon: 1e-6 };
    let (result, statistics) = norm.forward(&x, &weight[..80], &weight[..80]);
    all.push(result);
    keep(&mut all, norm.backward(&x, &weight[..80], &statistics, &dy[..x.len()], Wanted::ALL));
    all
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        pool.install(everything).into_iter().map(bits).collect::<Vec<_>>()
    };
    assert!(run(1) == run(3));
}

#[test]
fn only_wanted_gradients_are_found_and_they_are_the_same() {
    let conv = Conv3x3 { batch: 1, inputs: 3, outputs: 5, height: 6, width: 7, rectified: false };
    let (x, weight, dy) = (random(3 * 42, 1), random(135, 2), random(5 * 42, 3));
    let all = conv.backward(&x, &weight, &dy, Wanted::ALL);
    for bits in 0..8 {
        let wanted = Wanted { input: bits & 1 > 0, weight: bits & 2 > 0, bias: bits & 4 > 0 };
        let got = conv.backward(&x, &weight, &dy, wanted);
        assert_eq!(got.input, all.input.clone().filter(|_| wanted.input));
        assert_eq!(got.weight, all.weight.clone().filter(|_| wanted.weight));
        assert_eq!(got.bias.is_some(), wanted.bias);
        let bias = got.bias.unwrap_or_else(|| all.bias.clone().expect("all are wanted"));
        assert_equal("bias", &bias, &wide(all.bias.as_ref().expect("all are wanted")));
    }
}
