//! Memory to use again. The system clears every fresh page, which for planes of this size takes about as long as their
//! arithmetic.

use std::sync::{Mutex, PoisonError};

/// Most floats that wait to be used again: 1 GiB.
const MOST: usize = 1 << 28;

/// Blocks of floats that nobody needs at the moment.
#[derive(Debug, Default)]
pub struct Buffers {
    free: Mutex<Vec<Vec<f32>>>,
}

impl Buffers {
    /// None yet.
    pub const fn new() -> Self {
        Self { free: Mutex::new(Vec::new()) }
    }

    /// `len` floats of any value.
    pub fn take(&self, len: usize) -> Vec<f32> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        // Much larger ones are left for those who need them.
        let fitting = (0..free.len()).filter(|&i| (len..=2 * len).contains(&free[i].capacity()));
        let best = fitting.min_by_key(|&i| free[i].capacity()).map(|i| free.swap_remove(i));
        drop(free);
        let Some(mut buffer) = best else { return vec![0.0; len] };
        buffer.resize(len, 0.0);
        buffer
    }

    /// Takes back what nobody needs any more; beyond 2²⁸ floats (1 GiB), those that have waited longest are let go.
    pub fn give(&self, buffer: Vec<f32>) {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.push(buffer);
        let mut sum: usize = free.iter().map(Vec::capacity).sum();
        while sum > MOST {
            sum -= free.remove(0).capacity();
        }
    }
}
