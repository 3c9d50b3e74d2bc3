//! Weights averaged over the last steps. On held-out people they are better than the last weights.

use burn::tensor::{Device, Tensor};
use rayon::prelude::*;
use snapsnap_ops::host;

use crate::networks::{Rows, row};

/// Values per task on the CPU.
const PIECE: usize = 1 << 14;

/// An exponential moving average.
pub struct Average {
    /// Share of the average that a step keeps, after the first steps.
    pub decay: f64,
    /// The averages.
    pub rows: Rows,
}

impl Average {
    /// Adds the weights after `step` steps. The first steps keep less of the average, since it is mostly the initial
    /// weights.
    pub fn update(&mut self, step: u64, rows: Rows) {
        let decay = self.decay.min((1.0 + step as f64) / (10.0 + step as f64));
        for (name, new) in rows {
            if let Some(average) = self.rows.remove(&name) {
                self.rows.insert(name, blended(average, new, decay));
            }
        }
    }
}

fn blended(average: Tensor<1>, new: Tensor<1>, decay: f64) -> Tensor<1> {
    let device = new.device();
    let average = average.to_device(&device);
    if device != Device::flex() {
        return average * decay + new * (1.0 - decay);
    }
    let (mut average, new) = (host(average), new.into_data());
    let new: &[f32] = new.as_slice().expect("all tensors here are f32");
    let share = (1.0 - decay) as f32;
    average.par_chunks_mut(PIECE).zip(new.par_chunks(PIECE)).for_each(|(average, new)| {
        average.iter_mut().zip(new).for_each(|(average, new)| *average += (new - *average) * share);
    });
    row(average, &device)
}
