//! Element-wise operations in vector instructions. (Plain loops compile to branches here, which are ten times as slow
//! for random signs.)

use rayon::prelude::*;

use crate::vectors::vectorized;
use crate::winograd::planes::keep_positive;

/// Independent accumulators of a reduction, as many as the widest vector has lanes.
pub const LANES: usize = 16;

/// out = max(x, 0).
pub fn rectify(x: &[f32], out: &mut [f32]) {
    vectorized!(|| out.iter_mut().zip(x).for_each(|(out, x)| *out = if *x > 0.0 { *x } else { 0.0 }));
}

/// gradient = 0 where x is not positive.
pub fn mask(x: &[f32], gradient: &mut [f32]) {
    vectorized!(|| keep_positive(gradient, x));
}

/// out = x + y.
pub fn add_constant(x: &[f32], y: f32, out: &mut [f32]) {
    vectorized!(|| out.iter_mut().zip(x).for_each(|(out, x)| *out = x + y));
}

/// Adds every row to `sums`.
pub fn add_rows(rows: &[f32], sums: &mut [f32]) {
    vectorized!(|| {
        for row in rows.chunks_exact(sums.len()) {
            sums.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
        }
    });
}

/// Adds `row` to every row.
pub fn add_to_rows(row: &[f32], rows: &mut [f32]) {
    vectorized!(|| {
        for out in rows.chunks_exact_mut(row.len()) {
            out.iter_mut().zip(row).for_each(|(out, x)| *out += x);
        }
    });
}

/// The sum of f over all positions of the slices, as sixteen interleaved sums.
#[inline(always)]
pub fn sum<const N: usize>(slices: [&[f32]; N], f: impl Fn([f32; N]) -> f32) -> f32 {
    let whole = slices[0].len() / LANES * LANES;
    let mut sums = [0.0; LANES];
    let chunks = slices.map(|slice| slice.as_chunks::<LANES>().0);
    for i in 0..whole / LANES {
        let chunk = chunks.map(|chunks| &chunks[i]);
        for lane in 0..LANES {
            sums[lane] += f(chunk.map(|chunk| chunk[lane]));
        }
    }
    let rest = (whole..slices[0].len()).map(|i| f(slices.map(|slice| slice[i])));
    sums.into_iter().sum::<f32>() + rest.sum::<f32>()
}

/// The sum of the values.
pub fn total(values: &[f32]) -> f32 {
    vectorized!(|| sum([values], |[x]| x))
}

/// Sums of every channel over the pixels of all images `[batch, channels, pixels]`: the gradient of a bias.
pub fn channel_sums(images: &[f32], batch: usize, channels: usize) -> Vec<f32> {
    let pixels = images.len() / (batch * channels);
    let sum = |c: usize| {
        let sums =
            (0..batch).map(|image| f64::from(total(&images[(image * channels + c) * pixels..][..pixels])));
        sums.sum::<f64>() as f32
    };
    (0..channels).into_par_iter().map(sum).collect()
}
