//! Bilinear resize of planes and its gradient. Every input row is resized to the output's width once, and every output
//! row is a mean of two resized rows.

use burn::tensor::module::interpolate;
use burn::tensor::ops::{InterpolateMode, InterpolateOptions};
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use snapsnap_base::bilinear::{Tap, taps};

use crate::buffers::take;
use crate::device::has_kernels;
use crate::op::{self, Given, InputGradients, Kept, Kernel};
use crate::vectors::vectorized;

/// Bilinear resize of `[B, C, H, W]` to `size` (rows, columns).
///
/// `align_corners`: the outermost samples coincide (inside the DPT head). Otherwise the outer edges of the pixels
/// coincide (everywhere else). [0, 1] becomes [0, ⅓, ⅔, 1] or [0, ¼, ¾, 1] (docs/method.md, "Check values").
pub fn bilinear(x: Tensor<4>, size: [usize; 2], align_corners: bool) -> Tensor<4> {
    let ([b, c, h, w], device) = (x.dims(), x.device());
    let [down, across] = [(h, size[0]), (w, size[1])].map(|(from, to)| taps(from, to, align_corners));
    if has_kernels(&x) {
        let none: Option<Tensor<1>> = None;
        let kernel = Resize { from: [b, c, h, w], down, across };
        return op::run(kernel, [b, c, size[0], size[1]], x, none.clone(), none);
    }
    if device.is_autodiff() {
        // Burn's own operator has no backward pass on GPUs. Products with constant matrices have one.
        let matrix = |taps: &[Tap], from: usize| {
            let mut values = vec![0.0_f32; taps.len() * from];
            for (row, &(low, high, weight)) in values.chunks_exact_mut(from).zip(taps) {
                row[low] += 1.0 - weight;
                row[high] += weight;
            }
            let data = TensorData::new(values, [taps.len(), from]);
            Tensor::<2>::from_data(data, &device).cast(x.dtype())
        };
        let (down, across) = (matrix(&down, h).unsqueeze(), matrix(&across, w).transpose().unsqueeze());
        return down.matmul(x).matmul(across);
    }
    let options = InterpolateOptions::new(InterpolateMode::Bilinear).with_align_corners(align_corners);
    interpolate(x, options.with_output_size(size))
}

/// A bilinear resize.
#[derive(Debug)]
struct Resize {
    /// B, C, H, W of the input.
    from: [usize; 4],
    down: Vec<Tap>,
    across: Vec<Tap>,
}

impl Kernel for Resize {
    fn forward(&self, [x, ..]: [&[f32]; 3], _keep: bool) -> (Vec<f32>, Kept) {
        let [batch, channels, rows, columns] = self.from;
        let (width, size) = (self.across.len(), self.down.len() * self.across.len());
        let mut out = vec![0.0_f32; batch * channels * size];
        let planes = out.par_chunks_exact_mut(size).zip(x.par_chunks_exact(rows * columns));
        planes.for_each(|(out, plane)| {
            // The two resized rows in use, and their row numbers.
            let mut held = [usize::MAX; 2];
            let mut stretched = [vec![0.0; width], vec![0.0; width]];
            for (out, &(low, high, weight)) in out.chunks_exact_mut(width).zip(&self.down) {
                for row in [low, high] {
                    // Neighbouring rows differ in parity, so they never share a slot.
                    if held[row % 2] != row {
                        held[row % 2] = row;
                        let line = &plane[row * columns..(row + 1) * columns];
                        for (out, &(low, high, weight)) in stretched[row % 2].iter_mut().zip(&self.across) {
                            *out = line[low] + (line[high] - line[low]) * weight;
                        }
                    }
                }
                let (a, b) = (&stretched[low % 2], &stretched[high % 2]);
                for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
                    *out = a + (b - a) * weight;
                }
            }
        });
        (out, None)
    }

    fn backward(&self, Given { upstream, .. }: Given) -> InputGradients {
        let [batch, channels, rows, columns] = self.from;
        let (width, size) = (self.across.len(), self.down.len() * self.across.len());
        let mut out = take(batch * channels * rows * columns);
        let (down, across) = (uses(&self.down, rows), uses(&self.across, columns));
        let planes = out.par_chunks_exact_mut(rows * columns).zip(upstream.par_chunks_exact(size));
        planes.for_each_init(
            || vec![0.0; width],
            |sum, (out, gradient)| {
                // Rows are summed first, because whole rows are vectors.
                for (uses, out) in down.iter().zip(out.chunks_exact_mut(columns)) {
                    sum.fill(0.0);
                    for &(from, weight) in uses {
                        let line = &gradient[from * width..][..width];
                        vectorized!(|| sum.iter_mut().zip(line).for_each(|(sum, x)| *sum += weight * x));
                    }
                    for (out, uses) in out.iter_mut().zip(&across) {
                        *out = uses.iter().map(|&(from, weight)| weight * sum[from]).sum();
                    }
                }
            },
        );
        [Some(out), None, None]
    }
}

/// The transpose of taps: for each of `count` positions that are read, the positions that are written from it in their
/// order, with their weights, which are not 0.
fn uses(taps: &[Tap], count: usize) -> Vec<Vec<(usize, f32)>> {
    let mut uses = vec![Vec::new(); count];
    for (target, &(low, high, weight)) in taps.iter().enumerate() {
        for (position, weight) in [(low, 1.0 - weight), (high, weight)] {
            if weight != 0.0 {
                uses[position].push((target, weight));
            }
        }
    }
    uses
}
