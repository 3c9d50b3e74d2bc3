//! The gradients of a 3×3 convolution's weights and biases.
//!
//! The images are divided into a fixed number of parts. Each part sums the products of its tiles, block after block.
//! The sums of the parts are added in a fixed order, for the same bits with any number of threads.

use pulp::Arch;
use rayon::prelude::*;

use super::Convolution;
use super::transposed::{Accumulate, OutputGradients, Taps};
use crate::buffers::{Floats, take};
use crate::winograd::GROUP;
use crate::winograd::planes::Planes;
use crate::winograd::transforms::{Block, Inputs, POINTS, TILE, lines};

/// Largest number of parts: enough for the cores of a desktop computer.
const PARTS: usize = 16;
/// Fewest tiles per part, so that a part's sums are no more data than its transformed tiles.
const PART_TILES: usize = 96;
/// Points per task, if there are fewer parts than cores.
const TASK_POINTS: usize = 6;

impl Convolution {
    /// Gradients of weight and bias.
    pub(super) fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> [Vec<f32>; 2] {
        let [rows, columns] = [self.height, self.width].map(|side| side.div_ceil(TILE));
        let band = self.band_rows();
        let blocks: Vec<_> = (0..self.batch)
            .flat_map(|image| (0..rows).step_by(band).map(move |row| (image, row, band.min(rows - row))))
            .collect();
        let parts = (self.batch * rows * columns / PART_TILES).clamp(1, PARTS.min(blocks.len()));
        let sums: Vec<_> =
            blocks.par_chunks(blocks.len().div_ceil(parts)).map(|blocks| self.part(x, dy, blocks)).collect();
        let [inputs, outputs] = [self.inputs, self.outputs].map(|n| n.next_multiple_of(GROUP));
        let mut weight = take(self.outputs * self.inputs * 9);
        let arch = Arch::new();
        weight.par_chunks_exact_mut(self.inputs * 9).enumerate().for_each(|(output, out)| {
            let parts: Vec<_> = sums.iter().map(|(sums, _)| &sums[output * inputs..]).collect();
            arch.dispatch(Taps { parts: &parts, stride: inputs * outputs, out });
        });
        let bias = |c: usize| sums.iter().map(|(_, bias)| bias[c]).sum::<f64>() as f32;
        [weight, (0..self.outputs).map(bias).collect()]
    }

    /// The products' sums `[36][outputs][inputs]`, channels in whole groups, over rows of tiles (image, first row,
    /// rows), and the sums of the output's gradient.
    fn part(&self, x: &[f32], dy: &[f32], blocks: &[(usize, usize, usize)]) -> (Floats, Vec<f64>) {
        let arch = Arch::new();
        let (plane, columns) = (self.pixels(), self.width.div_ceil(TILE));
        let [inputs, outputs] = [self.inputs, self.outputs].map(|n| n.next_multiple_of(GROUP));
        let part = columns.div_ceil(columns.div_ceil(self.block_tiles()));
        let stride = (self.band_rows() * part) | 1;
        let mut read = Floats::new(lines(part));
        let mut values = Floats::new(POINTS * inputs * stride);
        let mut gradients = Floats::new(POINTS * outputs * stride);
        let mut products = Floats::new(POINTS * outputs * inputs);
        let mut bias = vec![0.0; outputs];
        let mut add = false;
        let image = |data, rectified| Planes { data, height: self.height, width: self.width, rectified };
        for &(i, row, rows) in blocks {
            let x = image(&x[i * self.inputs * plane..][..self.inputs * plane], self.rectified);
            let dy = image(&dy[i * self.outputs * plane..][..self.outputs * plane], false);
            for column in (0..columns).step_by(part) {
                let block = Block { row, column, rows, columns: part.min(columns - column) };
                let room = &mut read[..lines(block.columns)];
                arch.dispatch(Inputs { source: &x, block, stride, lines: room, out: &mut values });
                let (lines, out, sums) = (&mut read[..], &mut gradients, &mut bias[..]);
                arch.dispatch(OutputGradients { source: &dy, block, stride, lines, out, sums });
                let task = |(point, out)| {
                    let left: &[f32] = &gradients[point * outputs * stride..][..outputs * stride];
                    let right = &values[point * inputs * stride..][..inputs * stride];
                    arch.dispatch(Accumulate { left, right, stride, tiles: block.tiles(), add, out });
                };
                let per_point = products.par_chunks_exact_mut(outputs * inputs).enumerate();
                per_point.with_min_len(TASK_POINTS).for_each(task);
                add = true;
            }
        }
        (products, bias)
    }
}
