//! Linear layers, alone or followed by GELU: one matrix product per block of rows. Bias, GELU and their gradients are
//! computed while the block is in the cache.

use rayon::prelude::*;

use super::elements::{add_rows, add_to_rows};
use super::{join, parts};
use crate::buffers::{Floats, take};
use crate::math::{gelu, gelu_derivative};
use crate::multiply::{Right, product};
use crate::op::{Given, InputGradients, Kept, Kernel};
use crate::vectors::vectorized;

/// Rows per task of the products over rows.
const ROWS: usize = 128;
/// Least and largest number of rows of the weight's gradient per task. Each task reads all of one factor.
const WEIGHT_ROWS: [usize; 2] = [48, 256];
/// Number of tasks of the weight's gradient, within the limits of [`WEIGHT_ROWS`].
const WEIGHT_TASKS: usize = 16;

/// Sizes of a layer.
#[derive(Debug, Clone, Copy)]
pub struct Linear {
    /// Rows of input and output: tokens of all samples.
    pub rows: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// The weight is `[outputs, inputs]`, as in a convolution, instead of `[inputs, outputs]`.
    pub transposed: bool,
    /// Products in bf16, if the processor has the instructions.
    pub in_bf16: bool,
    /// GELU (erf form) follows.
    pub gelu: bool,
}

impl Kernel for Linear {
    /// x · weight + bias, then GELU if the layer has it: `x` `[rows, inputs]` → `[rows, outputs]`. Keeps the values
    /// before GELU.
    fn forward(&self, [x, weight, bias]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let (size, piece) = (self.rows * self.outputs, ROWS * self.outputs);
        let (mut out, mut before) = (take(size), (self.gelu && keep).then(|| Floats::new(size)));
        let weight = Right::new(self.in_bf16, [self.inputs, self.outputs], (weight, self.strides()));
        let kept = parts(before.as_deref_mut(), piece, self.rows.div_ceil(ROWS));
        let tasks = out.par_chunks_mut(piece).zip(x.par_chunks(ROWS * self.inputs));
        tasks.zip(kept).for_each(|((out, x), before)| match before {
            Some(before) => {
                self.product(x, &weight, bias, before);
                vectorized!(|| out.iter_mut().zip(before.iter()).for_each(|(out, z)| *out = gelu(*z)));
            }
            None => {
                self.product(x, &weight, bias, out);
                if self.gelu {
                    vectorized!(|| out.iter_mut().for_each(|out| *out = gelu(*out)));
                }
            }
        });
        (out, before.map(|before| Box::new(before) as _))
    }

    fn backward(&self, given: Given) -> InputGradients {
        let Given { inputs: [x, weight, _], kept, upstream: dy, wanted: [of_input, of_weight, of_bias] } =
            given;
        let before = kept.and_then(|kept| kept.downcast::<Floats>().ok());
        assert_eq!(before.is_some(), self.gelu, "kept by the forward pass");
        let Self { rows, inputs, outputs, .. } = *self;
        let blocks = rows.div_ceil(ROWS);
        let mut dx = of_input.then(|| take(rows * inputs));
        let mut dz = self.gelu.then(|| Floats::new(rows * outputs));
        let mut sums = vec![0.0; if of_bias { blocks * outputs } else { 0 }];
        let [column, row] = self.strides();
        let transposed = of_input.then(|| Right::Plain((weight, [row, column])));
        let results = parts(dx.as_deref_mut(), ROWS * inputs, blocks).into_par_iter();
        let changed = parts(dz.as_deref_mut(), ROWS * outputs, blocks);
        let totals = parts(of_bias.then_some(&mut sums), outputs, blocks);
        results.zip(changed).zip(totals).enumerate().for_each(|(i, ((dx, dz), sums))| {
            let rows = i * ROWS * outputs..((i + 1) * ROWS).min(rows) * outputs;
            let dy = &dy[rows.clone()];
            let dz: &[f32] = match (dz, &before) {
                (Some(dz), Some(before)) => {
                    derive(&before[rows], dy, dz);
                    dz
                }
                _ => dy,
            };
            if let Some(sums) = sums {
                add_rows(dz, sums);
            }
            if let Some((dx, rhs)) = dx.zip(transposed.as_ref()) {
                let size = [dz.len() / outputs, inputs, outputs];
                product(size, (dz, [1, outputs]), rhs, dx, false);
            }
        });
        let weight = of_weight.then(|| self.weight_gradient(x, dz.as_deref().unwrap_or(dy)));
        [dx, weight, of_bias.then(|| join(sums.chunks_exact(outputs), outputs))]
    }
}

impl Linear {
    fn weight_gradient(&self, x: &[f32], dz: &[f32]) -> Vec<f32> {
        // Rows and columns in the order in which the weight is stored.
        let (inputs, outputs) = ((x, self.inputs), (dz, self.outputs));
        let ((left, rows), (right, columns)) =
            if self.transposed { (outputs, inputs) } else { (inputs, outputs) };
        let mut out = take(rows * columns);
        let rhs = &Right::Plain((right, [1, columns]));
        let block = rows.div_ceil(WEIGHT_TASKS).clamp(WEIGHT_ROWS[0], WEIGHT_ROWS[1]);
        out.par_chunks_mut(block * columns).enumerate().for_each(|(i, out)| {
            let size = [out.len() / columns, columns, self.rows];
            let lhs = (&left[i * block..], [rows, 1]);
            product(size, lhs, rhs, out, false);
        });
        out
    }

    /// (column, row) strides of the weight as `[inputs, outputs]`.
    fn strides(&self) -> [usize; 2] {
        if self.transposed { [self.inputs, 1] } else { [1, self.outputs] }
    }

    fn product(&self, x: &[f32], rhs: &Right, bias: &[f32], out: &mut [f32]) {
        let (size, lhs) = ([x.len() / self.inputs, self.outputs, self.inputs], (x, [1, self.inputs]));
        product(size, lhs, rhs, out, false);
        // An absent bias is one zero.
        if bias.len() == self.outputs {
            add_to_rows(bias, out);
        }
    }
}

/// dz = dy · gelu'(z).
fn derive(z: &[f32], dy: &[f32], dz: &mut [f32]) {
    vectorized!(|| {
        for ((dz, z), dy) in dz.iter_mut().zip(z).zip(dy) {
            *dz = dy * gelu_derivative(*z);
        }
    });
}
