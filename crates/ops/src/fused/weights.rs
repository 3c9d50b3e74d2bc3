//! Convolution weights in PyTorch's order and in the kernels' order.

use super::CHANNELS;

/// Where the weights of `[out, in, k, k]`, `taps` = k², lie in `[source][k][k][16 in][16 out]`, in their order.
fn positions([out, inputs, taps]: [usize; 3]) -> impl Iterator<Item = usize> {
    (0..out * inputs * taps).map(move |from| {
        let (o, i, tap) = (from / taps / inputs, from / taps % inputs, from % taps);
        ((i / CHANNELS * taps + tap) * CHANNELS + i % CHANNELS) * CHANNELS + o
    })
}

/// A PyTorch weight `[out, in, k, k]`, `taps` = k², as `[source][k][k][16 in][16 out]`. Missing channels are 0.
pub fn arrange(values: &[f32], shape @ [_, inputs, taps]: [usize; 3]) -> Vec<f32> {
    let mut arranged = vec![0.0; inputs.div_ceil(CHANNELS) * taps * CHANNELS * CHANNELS];
    positions(shape).zip(values).for_each(|(at, value)| arranged[at] = *value);
    arranged
}

/// Adds the gradient of an arranged weight to `values`, the gradient in PyTorch's order.
pub fn rearrange(arranged: &[f64], shape: [usize; 3], values: &mut [f64]) {
    positions(shape).zip(values).for_each(|(at, value)| *value += arranged[at]);
}

/// Transposes every 16×16 matrix, for the gradient of the input.
pub fn transpose(arranged: &[f32]) -> Vec<f32> {
    let squares = arranged.as_chunks::<CHANNELS>().0.chunks_exact(CHANNELS);
    let columns = squares.flat_map(|square| (0..CHANNELS).map(move |column| (square, column)));
    columns.flat_map(|(square, column)| square.iter().map(move |row| row[column])).collect()
}
