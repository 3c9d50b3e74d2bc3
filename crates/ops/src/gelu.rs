//! Bias and GELU in one pass over memory.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::math::gelu;

/// Rows per task: enough to pay for the task, little enough to share them out.
const ROWS: usize = 16;

/// x ← gelu(x + bias), row by row; `x` `[rows, bias.len()]`.
pub fn bias_gelu(x: &mut [f32], bias: &[f32]) {
    let arch = Arch::new();
    x.par_chunks_mut(ROWS * bias.len()).for_each(|rows| arch.dispatch(Rows { rows, bias }));
}

struct Rows<'a> {
    rows: &'a mut [f32],
    bias: &'a [f32],
}

impl WithSimd for Rows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for row in self.rows.chunks_exact_mut(self.bias.len()) {
            for (x, b) in row.iter_mut().zip(self.bias) {
                *x = gelu(*x + b);
            }
        }
    }
}
