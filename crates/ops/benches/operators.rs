//! Times the operators of a training step one by one. `docs/operators_pytorch.py` compares with PyTorch's operators.
//!
//! Each line of input is a command. `time SECONDS NAME SIZES…` prints the times of the fastest forward and backward run
//! in ms. `check FOLDER NAME SIZES…` reads `FOLDER/in0 …`, writes `FOLDER/out0 …` (result, then gradients), and prints
//! the number of outputs.

use std::io::BufRead;
use std::time::{Duration, Instant};

use snapsnap_ops::buffers::give;
use snapsnap_ops::train::{
    Attention, Conv1x1, Conv3x3, Gradients, LayerNorm, Linear, Tokens, Unfolded, Wanted, resize,
    resize_gradient, taps,
};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// A forward or backward pass, which returns everything it computed.
type Run<'a> = Box<dyn Fn() -> Vec<Vec<f32>> + 'a>;

/// Uniform in ±1.
fn random(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

/// Lengths of the inputs and of the output's gradient.
fn lengths(name: &str, s: &[usize]) -> Vec<usize> {
    match name {
        "conv3x3" => {
            let bias = (s[5] == 1).then_some(s[2]);
            let inputs = [s[0] * s[1] * s[3] * s[3], s[1] * s[2] * 9];
            inputs.into_iter().chain(bias).chain([s[0] * s[2] * s[3] * s[3]]).collect()
        }
        "conv1x1" => vec![s[0] * s[1] * s[3] * s[3], s[1] * s[2], s[2], s[0] * s[2] * s[3] * s[3]],
        "halve" => {
            vec![s[0] * s[1] * s[3] * s[3], s[1] * s[2] * 9, s[2], s[0] * s[2] * s[3].div_ceil(2).pow(2)]
        }
        "resize" => vec![s[0] * s[1] * s[2] * s[2], s[0] * s[1] * s[2] * s[2] * 4],
        "linear" => vec![s[0] * s[1], s[1] * s[2], s[2], s[0] * s[2]],
        "norm" => vec![s[0] * s[1], s[1], s[1], s[0] * s[1]],
        "attention" => vec![s[0] * s[1] * s[2] * s[3] * s[4]; 4],
        _ => panic!("no operator is called {name}"),
    }
}

/// Forward and backward pass.
fn build<'a>(name: &str, half: bool, s: &[usize], x: &'a [Vec<f32>]) -> [Run<'a>; 2] {
    let dy = &x[x.len() - 1];
    // The third input, unless it is the last one.
    let bias = x.get(2..x.len() - 1).and_then(|rest| Some(&rest.first()?[..]));
    let wanted = Wanted { bias: bias.is_some(), ..Wanted::ALL };
    macro_rules! passes {
        ($layer:expr) => {{
            let layer = $layer;
            [
                Box::new(move || vec![layer.forward(&x[0], &x[1], bias)]),
                Box::new(move || all(layer.backward(&x[0], &x[1], dy, wanted))),
            ]
        }};
    }
    let (batch, inputs, rectified) = (s[0], s[1], s.get(4) == Some(&1));
    let [outputs, height] = [2, 3].map(|i| s.get(i).copied().unwrap_or(0));
    let width = height;
    match name {
        "conv3x3" => passes!(Conv3x3 { batch, inputs, outputs, height, width, rectified }),
        "conv1x1" => passes!(Conv1x1 { batch, inputs, outputs, pixels: height * width, rectified, half }),
        "halve" => {
            passes!(Unfolded { batch, inputs, outputs, height, width, stride: 2, rectified: false })
        }
        "resize" => {
            let size = [s[2]; 2];
            let (axis, copy) = (taps(s[2], 2 * s[2], true), taps(s[2], 2 * s[2], true));
            [
                Box::new(move || vec![resize(&x[0], size, &axis, &axis)]),
                Box::new(move || vec![resize_gradient(dy, size, &copy, &copy)]),
            ]
        }
        "linear" => {
            let layer = Linear { rows: s[0], inputs: s[1], outputs: s[2], transposed: false, half };
            let gelu = move || layer.forward_gelu(&x[0], &x[1], bias, true);
            let before = (s[3] == 1).then(|| gelu().1).flatten();
            let activated = s[3] == 1;
            [
                Box::new(move || {
                    if activated {
                        let (y, before) = gelu();
                        before.into_iter().for_each(give);
                        vec![y]
                    } else {
                        vec![layer.forward(&x[0], &x[1], bias)]
                    }
                }),
                Box::new(move || all(layer.backward(&x[0], &x[1], before.as_deref(), dy, Wanted::ALL))),
            ]
        }
        "norm" => {
            let norm = LayerNorm { channels: s[1], epsilon: 1e-6 };
            let statistics = norm.forward(&x[0], &x[1], &x[2]).1;
            [
                Box::new(move || vec![norm.forward(&x[0], &x[1], &x[2]).0]),
                Box::new(move || all(norm.backward(&x[0], &x[1], &statistics, dy, Wanted::ALL))),
            ]
        }
        "attention" => {
            let n = s[1] * s[2];
            let attention = Attention { batch: s[0], queries: n, keys: n, heads: s[3], head_dim: s[4], half };
            let (rope, copy) = (tables(s[1], s[2], s[4]), tables(s[1], s[2], s[4]));
            let qkv = Tokens::apart([&x[0], &x[1], &x[2]], s[3] * s[4]);
            let logarithms = attention.forward(qkv, [&rope[0], &rope[1]]).1;
            [
                Box::new(move || vec![attention.forward(qkv, [&copy[0], &copy[1]]).0]),
                Box::new(move || attention.backward(qkv, [&rope[0], &rope[1]], &logarithms, dy).into()),
            ]
        }
        _ => panic!("no operator is called {name}"),
    }
}

fn all(gradients: Gradients) -> Vec<Vec<f32>> {
    [gradients.input, gradients.weight, gradients.bias].into_iter().flatten().collect()
}

/// Rotation tables of a grid of tokens, as `Rope` makes them.
fn tables(rows: usize, columns: usize, head_dim: usize) -> [Vec<f32>; 2] {
    let pairs = head_dim / 4;
    let (mut cos, mut sin) = (Vec::new(), Vec::new());
    for token in 0..rows * columns {
        let position = [token / columns, token % columns];
        for (position, sign) in position.into_iter().flat_map(|at| [(at, -1.0), (at, 1.0)]) {
            for k in 0..pairs {
                let angle = position as f64 * 100_f64.powf(-(k as f64) / pairs as f64);
                cos.push(angle.cos() as f32);
                sin.push((sign * angle.sin()) as f32);
            }
        }
    }
    [cos, sin]
}

fn read(path: &str, len: usize) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("a readable file");
    assert_eq!(bytes.len(), 4 * len, "{path}");
    bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

fn main() {
    // On a thread of the pool: a caller from outside would wait for the pool at every operator, which takes longer than
    // the small operators.
    rayon::scope(|_| serve());
}

/// Answers until there is no more input.
fn serve() {
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("a readable line");
        let words: Vec<&str> = line.split_whitespace().collect();
        let (mode, argument, name) = (words[0], words[1], words[2]);
        // A name with 16 behind it: products in bf16.
        let (name, half) = name.strip_suffix("16").map_or((name, false), |name| (name, true));
        let sizes: Vec<usize> = words[3..].iter().map(|word| word.parse().expect("a size")).collect();
        let lengths = lengths(name, &sizes);
        let input = |(i, &len): (usize, &usize)| match mode {
            "time" => random(len, i as u32 + 1),
            _ => read(&format!("{argument}/in{i}"), len),
        };
        let inputs: Vec<Vec<f32>> = lengths.iter().enumerate().map(input).collect();
        let [forward, backward] = build(name, half, &sizes, &inputs);
        if mode == "time" {
            let seconds = Duration::from_secs_f64(argument.parse().expect("a number of seconds"));
            let (mut best, mut count, begin) = ([f64::INFINITY; 2], 0, Instant::now());
            while count < 3 || begin.elapsed() < seconds {
                for (best, run) in best.iter_mut().zip([&forward, &backward]) {
                    let begin = Instant::now();
                    let out = run();
                    *best = best.min(begin.elapsed().as_secs_f64() * 1e3);
                    out.into_iter().for_each(give);
                }
                count += 1;
            }
            println!("{} {}", best[0], best[1]);
        } else {
            let out: Vec<_> = forward().into_iter().chain(backward()).collect();
            for (i, out) in out.iter().enumerate() {
                let bytes: Vec<u8> = out.iter().flat_map(|x| x.to_le_bytes()).collect();
                std::fs::write(format!("{argument}/out{i}"), bytes).expect("a writable folder");
            }
            println!("{}", out.len());
        }
    }
}
