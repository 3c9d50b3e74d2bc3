//! A pool of memory blocks for the operators. The system clears every fresh page. For images of this size that takes
//! about as long as the operators' arithmetic.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

/// Largest number of unused values: 2 GiB of each type.
const MOST: usize = 1 << 29;

/// `len` arbitrary values, for a result that leaves this crate.
pub fn take(len: usize) -> Vec<f32> {
    f32::pool().take(len)
}

/// Returns the pool's memory to the allocator.
pub fn release_buffers() {
    f32::pool().release();
    u32::pool().release();
}

/// Floats for a while.
pub type Floats = Scratch<f32>;
/// Words for a while. A word is a pair of bf16 values.
pub type Words = Scratch<u32>;

/// A block of values that returns to the pool when it is dropped.
#[derive(Debug, Clone)]
pub struct Scratch<T: Bits>(Vec<T>);

impl<T: Bits> Scratch<T> {
    /// `len` values, which are arbitrary.
    pub fn new(len: usize) -> Self {
        Self(T::pool().take(len))
    }
}

impl<T: Bits> Deref for Scratch<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.0
    }
}

impl<T: Bits> DerefMut for Scratch<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.0
    }
}

impl<T: Bits> Drop for Scratch<T> {
    fn drop(&mut self) {
        T::pool().give(std::mem::take(&mut self.0));
    }
}

/// Unused blocks of values.
#[derive(Default)]
pub struct Pool<T> {
    free: Mutex<Vec<Vec<T>>>,
}

impl<T: Bits> Pool<T> {
    fn take(&self, len: usize) -> Vec<T> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        // Blocks of more than twice the size are left for larger requests.
        let fitting = (0..free.len()).filter(|&i| (len..=2 * len).contains(&free[i].capacity()));
        let best = fitting.min_by_key(|&i| free[i].capacity()).map(|i| free.swap_remove(i));
        drop(free);
        let Some(mut buffer) = best else { return arbitrary(len) };
        buffer.resize(len, T::default());
        buffer
    }

    fn release(&self) {
        self.free.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }

    /// Frees the oldest blocks if the pool exceeds [`MOST`] values.
    fn give(&self, buffer: Vec<T>) {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.push(buffer);
        let mut sum: usize = free.iter().map(Vec::capacity).sum();
        while sum > MOST {
            sum -= free.remove(0).capacity();
        }
    }
}

/// `len` values that are not initialised: filling them with zeros would take as long as some operators do.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
#[allow(unsafe_code, reason = "memory that is not filled")]
fn arbitrary<T: Bits>(len: usize) -> Vec<T> {
    let mut buffer = Vec::<T>::with_capacity(len);
    // SAFETY: the compiler must assume that the assembly writes all of the memory, so the memory has values. By `Bits`,
    // every pattern of bits is valid.
    unsafe {
        std::arch::asm!("/* {0} */", in(reg) buffer.as_mut_ptr(), options(nostack, preserves_flags));
        buffer.set_len(len);
    }
    buffer
}

/// `len` zeros, on processors without the assembly.
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn arbitrary<T: Bits>(len: usize) -> Vec<T> {
    vec![T::default(); len]
}

/// Types for which every pattern of bits is valid.
pub trait Bits: Copy + Default + 'static {
    /// The unused blocks of this type.
    fn pool() -> &'static Pool<Self>;
}

impl Bits for f32 {
    fn pool() -> &'static Pool<Self> {
        static FLOATS: Pool<f32> = Pool { free: Mutex::new(Vec::new()) };
        &FLOATS
    }
}

impl Bits for u32 {
    fn pool() -> &'static Pool<Self> {
        static WORDS: Pool<u32> = Pool { free: Mutex::new(Vec::new()) };
        &WORDS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returned_memory_is_used_again_unless_it_is_far_too_large() {
        let buffers = Pool::<f32>::default();
        let buffer = buffers.take(1000);
        let address = buffer.as_ptr();
        buffers.give(buffer);
        let small = buffers.take(100);
        assert_ne!(small.as_ptr(), address);
        let again = buffers.take(900);
        assert_eq!((again.as_ptr(), again.len()), (address, 900));
    }
}
