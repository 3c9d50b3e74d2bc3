//! Convolution weights in PyTorch's order and in the kernels' order.

use super::CHANNELS;

/// Where weight `(out, in, tap)` of `[out, in, k, k]` lies in `[source][k][k][16 in][16 out]`.
fn position(o: usize, i: usize, tap: usize, taps: usize) -> usize {
    ((i / CHANNELS * taps + tap) * CHANNELS + i % CHANNELS) * CHANNELS + o
}

/// A PyTorch weight `[out, in, k, k]`, `taps` = k², as `[source][k][k][16 in][16 out]`. Missing channels are 0.
pub fn arrange(values: &[f32], [out, inputs, taps]: [usize; 3]) -> Vec<f32> {
    let mut arranged = vec![0.0; inputs.div_ceil(CHANNELS) * taps * CHANNELS * CHANNELS];
    for (from, value) in values[..out * inputs * taps].iter().enumerate() {
        let (o, i, tap) = (from / taps / inputs, from / taps % inputs, from % taps);
        arranged[position(o, i, tap, taps)] = *value;
    }
    arranged
}

/// Adds the gradient of an arranged weight to `values`, the gradient in PyTorch's order.
pub fn rearrange(arranged: &[f64], [out, inputs, taps]: [usize; 3], values: &mut [f64]) {
    for (to, value) in values[..out * inputs * taps].iter_mut().enumerate() {
        let (o, i, tap) = (to / taps / inputs, to / taps % inputs, to % taps);
        *value += arranged[position(o, i, tap, taps)];
    }
}

/// Transposes every 16×16 matrix, for the gradient of the input.
pub fn transpose(arranged: &[f32]) -> Vec<f32> {
    let squares = arranged.chunks_exact(CHANNELS * CHANNELS);
    squares
        .flat_map(|square| {
            (0..CHANNELS * CHANNELS).map(|at| square[at % CHANNELS * CHANNELS + at / CHANNELS])
        })
        .collect()
}
