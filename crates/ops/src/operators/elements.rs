//! Element-wise operations in vector instructions. (Plain loops compile to branches here, which are ten times as slow
//! for random signs.)

use rayon::prelude::*;

use crate::vectors::vectorized;

/// out = max(x, 0).
pub fn rectify(x: &[f32], out: &mut [f32]) {
    vectorized!(|| out.iter_mut().zip(x).for_each(|(out, x)| *out = if *x > 0.0 { *x } else { 0.0 }));
}

/// gradient = 0 where x is not positive.
pub fn mask(x: &[f32], gradient: &mut [f32]) {
    vectorized!(|| {
        for (gradient, x) in gradient.iter_mut().zip(x) {
            *gradient = if *x > 0.0 { *gradient } else { 0.0 };
        }
    });
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

/// The sum of the values, as sixteen interleaved sums.
pub fn total(values: &[f32]) -> f32 {
    vectorized!(|| {
        let (chunks, rest) = values.as_chunks::<16>();
        let mut sums = [0.0_f32; 16];
        for chunk in chunks {
            sums.iter_mut().zip(chunk).for_each(|(sum, x)| *sum += x);
        }
        sums.iter().sum::<f32>() + rest.iter().sum::<f32>()
    })
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
