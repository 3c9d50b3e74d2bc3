//! The operators as plain loops in f64, for tests.

use super::{Attention, Enlarge, Linear, Tables};
use snapsnap_base::bilinear::Tap;

/// A convolution of square kernels.
pub struct Convolution {
    pub batch: usize,
    pub inputs: usize,
    pub outputs: usize,
    pub height: usize,
    pub width: usize,
    pub side: usize,
    pub stride: usize,
    pub padding: usize,
    pub rectified: bool,
}

impl Convolution {
    /// `weight` `[outputs, inputs, side, side]`.
    pub fn run(&self, x: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
        let Self { batch, inputs, outputs, height, width, side, stride, padding, rectified } = *self;
        let [rows, columns] = [height, width].map(|n| (n + 2 * padding - side) / stride + 1);
        let mut y = Vec::new();
        for i in 0..batch * outputs * rows * columns {
            let (column, row, output, image) =
                (i % columns, i / columns % rows, i / columns / rows % outputs, i / columns / rows / outputs);
            let mut sum = bias[output];
            for (input, a, b) in triples(inputs, side, side) {
                let (row, column) = (row * stride + a, column * stride + b);
                if (padding..height + padding).contains(&row) && (padding..width + padding).contains(&column)
                {
                    let at = ((image * inputs + input) * height + row - padding) * width + column - padding;
                    let value = if rectified { x[at].max(0.0) } else { x[at] };
                    sum += value * weight[((output * inputs + input) * side + a) * side + b];
                }
            }
            y.push(sum);
        }
        y
    }
}

fn triples(a: usize, b: usize, c: usize) -> impl Iterator<Item = (usize, usize, usize)> {
    (0..a * b * c).map(move |i| (i / c / b, i / c % b, i % c))
}

/// A transposed convolution.
pub fn enlarge(layer: &Enlarge, x: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
    let Enlarge { batch, inputs, outputs, height, width, stride } = *layer;
    let (rows, columns) = (height * stride, width * stride);
    let mut y = Vec::new();
    for (plane, row, column) in triples(batch * outputs, rows, columns) {
        let (image, output) = (plane / outputs, plane % outputs);
        let from =
            |input: usize| ((image * inputs + input) * height + row / stride) * width + column / stride;
        let by =
            |input: usize| ((input * outputs + output) * stride + row % stride) * stride + column % stride;
        y.push(bias[output] + (0..inputs).map(|input| x[from(input)] * weight[by(input)]).sum::<f64>());
    }
    y
}

/// A linear layer.
pub fn linear(layer: &Linear, x: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
    let Linear { rows, inputs, outputs, transposed } = *layer;
    let at = |i: usize, o: usize| if transposed { o * inputs + i } else { i * outputs + o };
    let value = |n: usize| {
        let (row, o) = (n / outputs, n % outputs);
        bias[o] + (0..inputs).map(|i| x[row * inputs + i] * weight[at(i, o)]).sum::<f64>()
    };
    (0..rows * outputs).map(value).collect()
}

/// x·Φ(x), from the power series of Φ, which converges well for |x| < 8.
pub fn gelu(x: f64) -> f64 {
    let (mut term, mut sum) = (x, x);
    for n in 1..200 {
        let n = f64::from(n);
        term *= -x * x / (2.0 * n);
        sum += term / (2.0 * n + 1.0);
    }
    x * (0.5 + sum / (2.0 * std::f64::consts::PI).sqrt())
}

/// Layer normalisation.
pub fn layer_norm(epsilon: f64, x: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
    let c = weight.len();
    let mut y = Vec::new();
    for row in x.chunks_exact(c) {
        let mean = row.iter().sum::<f64>() / c as f64;
        let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / c as f64;
        let scale = 1.0 / (variance + epsilon).sqrt();
        y.extend(row.iter().zip(weight).zip(bias).map(|((x, w), b)| (x - mean) * scale * w + b));
    }
    y
}

/// Rotation tables of tokens in rows of four, as `Rope` makes them.
pub fn tables(tokens: usize, head_dim: usize) -> [Vec<f32>; 2] {
    let pairs = head_dim / 4;
    let (mut cos, mut sin) = (Vec::new(), Vec::new());
    for token in 0..tokens {
        for (position, sign) in [token / 4, token % 4].into_iter().flat_map(|at| [(at, -1.0), (at, 1.0)]) {
            for k in 0..pairs {
                let angle = position as f64 * 100_f64.powf(-(k as f64) / pairs as f64);
                cos.push(angle.cos() as f32);
                sin.push((sign * angle.sin()) as f32);
            }
        }
    }
    [cos, sin]
}

/// Attention with rotary positions.
pub fn attention(a: &Attention, [cos, sin]: Tables, q: &[f64], k: &[f64], v: &[f64]) -> Vec<f64> {
    let (d, width) = (a.head_dim, a.heads * a.head_dim);
    let rotated = |x: &[f64], token: usize, at: usize| -> Vec<f64> {
        let turn = |i: usize| {
            let partner = i / (d / 2) * (d / 2) + (i + d / 4) % (d / 2);
            let (cos, sin) = (f64::from(cos[token * d + i]), f64::from(sin[token * d + i]));
            x[at + i] * cos + x[at + partner] * sin
        };
        (0..d).map(turn).collect()
    };
    let mut y = vec![0.0; q.len()];
    for (b, h, n) in triples(a.batch, a.heads, a.queries) {
        let at = (b * a.queries + n) * width + h * d;
        let key = |m: usize| (b * a.keys + m) * width + h * d;
        let query = rotated(q, n, at);
        let score = |m: usize| {
            let product: f64 = query.iter().zip(rotated(k, m, key(m))).map(|(q, k)| q * k).sum();
            (product / (d as f64).sqrt()).exp()
        };
        let scores: Vec<f64> = (0..a.keys).map(score).collect();
        let sum: f64 = scores.iter().sum();
        for i in 0..d {
            y[at + i] = (0..a.keys).map(|m| scores[m] / sum * v[key(m) + i]).sum();
        }
    }
    y
}

/// Bilinear resize.
pub fn resize(x: &[f64], [rows, columns]: [usize; 2], down: &[Tap], across: &[Tap]) -> Vec<f64> {
    let mut y = Vec::new();
    for (plane, row, column) in triples(x.len() / (rows * columns), down.len(), across.len()) {
        let plane = &x[plane * rows * columns..];
        let blend = |a: f64, b: f64, weight: f32| a + (b - a) * f64::from(weight);
        let (left, right, weight) = across[column];
        let line = |row: usize| blend(plane[row * columns + left], plane[row * columns + right], weight);
        let (low, high, weight) = down[row];
        y.push(blend(line(low), line(high), weight));
    }
    y
}
