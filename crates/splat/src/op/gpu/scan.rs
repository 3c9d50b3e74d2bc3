//! Exclusive prefix sum of u32.

use cubecl::prelude::*;

use super::buffers::{Buffers, arg};
use burn_cubecl::tensor::CubeTensor;

/// Units of a cube.
const UNITS: usize = 256;
/// Consecutive numbers that each unit adds up by itself.
const ITEMS: usize = 4;
const BLOCK: usize = UNITS * ITEMS;

/// Exclusive prefix sum of the first `n` numbers of `input`: `n + 1` numbers, of which the last is the total. Sums wrap
/// at 2³².
pub fn exclusive_sum(buffers: &Buffers, input: &CubeTensor, n: usize) -> CubeTensor {
    let blocks = (n + 1).div_ceil(BLOCK);
    let output = buffers.u32(n + 1);
    let sums = buffers.u32(blocks);
    let dim = CubeDim::new_1d(UNITS as u32);
    let cubes = || buffers.cubes(blocks);
    scan_blocks::launch(&buffers.client, cubes(), dim, arg(input), arg(&output), arg(&sums), n, blocks);
    if blocks > 1 {
        let before = exclusive_sum(buffers, &sums, blocks);
        add_blocks::launch(&buffers.client, cubes(), dim, before.into_buffer_arg(), arg(&output), n, blocks);
    }
    output
}

/// Prefix sums within each block, and each block's total.
#[cube(launch)]
fn scan_blocks(input: &[u32], output: &mut [u32], sums: &mut [u32], n: usize, blocks: usize) {
    if CUBE_POS >= blocks {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let first = CUBE_POS * comptime!(BLOCK) + unit * comptime!(ITEMS);
    let mut own = 0u32;
    for i in 0..comptime!(ITEMS) {
        if first + i < n {
            own += input[first + i];
        }
    }
    let mut running = exclusive_in_cube(own);
    for i in 0..comptime!(ITEMS) {
        if first + i <= n {
            output[first + i] = running;
        }
        if first + i < n {
            running += input[first + i];
        }
    }
    if UNIT_POS == comptime!(UNITS as u32 - 1) {
        sums[CUBE_POS] = running;
    }
}

/// Sum of `own` over the units of the cube before this one.
#[cube]
fn exclusive_in_cube(own: u32) -> u32 {
    let mut shared = Shared::<[u32]>::new_slice(comptime!(UNITS));
    let unit = UNIT_POS as usize;
    shared[unit] = own;
    sync_cube();
    let mut reach = 1usize;
    while reach < comptime!(UNITS) {
        let mut before = 0u32;
        if unit >= reach {
            before = shared[unit - reach];
        }
        sync_cube();
        shared[unit] += before;
        sync_cube();
        reach *= 2;
    }
    shared[unit] - own
}

/// Adds the sum of all earlier blocks to each block.
#[cube(launch)]
fn add_blocks(before: &[u32], output: &mut [u32], n: usize, blocks: usize) {
    if CUBE_POS >= blocks {
        terminate!();
    }
    let offset = before[CUBE_POS];
    let first = CUBE_POS * comptime!(BLOCK) + UNIT_POS as usize;
    for i in 0..comptime!(ITEMS) {
        let at = first + i * comptime!(UNITS);
        if at <= n {
            output[at] += offset;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::buffers::testing::{read, upload, with_buffers};
    use super::exclusive_sum;

    fn check(input: &[u32]) {
        with_buffers(|buffers| {
            let mut expected = vec![0_u32];
            for v in input {
                expected.push(expected[expected.len() - 1].wrapping_add(*v));
            }
            let got = read(exclusive_sum(buffers, &upload(buffers, input), input.len()));
            assert!(got == expected, "{} numbers", input.len());
        });
    }

    #[test]
    fn sums_of_every_size_are_exact() {
        for n in [0, 1, 2, 3, 4, 5, 255, 256, 257, 1023, 1024, 1025, 4096, 1_000_000] {
            check(&(0..n).map(|i: u32| i.wrapping_mul(2_654_435_761) >> 24).collect::<Vec<_>>());
        }
        check(&[7; 1_048_577]);
    }

    #[test]
    fn sums_wrap() {
        check(&[u32::MAX, 2, u32::MAX, u32::MAX]);
    }
}
