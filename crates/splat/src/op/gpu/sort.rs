//! Stable radix sort of u32 keys with their positions, four bits a pass.

use cubecl::prelude::*;

use super::buffers::{Buffers, arg};
use super::scan::exclusive_sum;
use burn_cubecl::tensor::CubeTensor;

const UNITS: usize = 256;
/// Pairs of each unit. The pairs are consecutive, which keeps the order of equal keys.
const ITEMS: usize = 8;
const BLOCK: usize = UNITS * ITEMS;
const BITS: u32 = 4;
const DIGITS: usize = 1 << BITS;
/// Digit counters of all units of a cube: digit by digit, unit by unit.
const COUNTERS: usize = DIGITS * UNITS;
/// Consecutive counters that one unit adds up.
const SHARE: usize = COUNTERS / UNITS;

/// Sorts `n` keys by their lowest `bits` bits; equal keys keep their order. Returns the keys and their old positions.
pub fn sort(buffers: &Buffers, keys: CubeTensor, n: usize, bits: u32) -> (CubeTensor, CubeTensor) {
    let blocks = n.div_ceil(BLOCK).max(1);
    let dim = CubeDim::new_1d(UNITS as u32);
    let cubes = || buffers.cubes(blocks);
    let mut pairs = (keys.clone(), keys);
    let mut shift = 0;
    // At least one pass, since the first pass makes the positions.
    while shift == 0 || shift < bits {
        let counts = buffers.u32(DIGITS * blocks);
        let mask = (1 << (bits - shift).min(BITS)) - 1;
        histogram::launch(&buffers.client, cubes(), dim, arg(&pairs.0), arg(&counts), n, blocks, shift, mask);
        let offsets = exclusive_sum(buffers, &counts, DIGITS * blocks);
        let sorted = (buffers.u32(n.max(1)), buffers.u32(n.max(1)));
        scatter::launch(
            &buffers.client,
            cubes(),
            dim,
            pairs.0.into_buffer_arg(),
            pairs.1.into_buffer_arg(),
            offsets.into_buffer_arg(),
            arg(&sorted.0),
            arg(&sorted.1),
            n,
            blocks,
            shift,
            mask,
            shift == 0,
        );
        pairs = sorted;
        shift += BITS;
    }
    pairs
}

/// Counts this unit's digits into its column of `counters`.
#[cube]
fn count(keys: &[u32], counters: &mut Shared<[u32]>, first: usize, n: usize, shift: u32, mask: u32) {
    let unit = UNIT_POS as usize;
    for digit in 0..comptime!(DIGITS) {
        counters[digit * comptime!(UNITS) + unit] = 0u32;
    }
    for i in 0..comptime!(ITEMS) {
        if first + i < n {
            let digit = ((keys[first + i] >> shift) & mask) as usize;
            counters[digit * comptime!(UNITS) + unit] += 1u32;
        }
    }
}

/// How often each digit occurs in each block: `counts` `[DIGITS, blocks]`.
#[cube(launch)]
fn histogram(keys: &[u32], counts: &mut [u32], n: usize, blocks: usize, shift: u32, mask: u32) {
    if CUBE_POS >= blocks {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let mut counters = Shared::<[u32]>::new_slice(comptime!(COUNTERS));
    let mut parts = Shared::<[u32]>::new_slice(comptime!(UNITS));
    count(keys, &mut counters, CUBE_POS * comptime!(BLOCK) + unit * comptime!(ITEMS), n, shift, mask);
    sync_cube();
    let mut part = 0u32;
    for i in 0..comptime!(SHARE) {
        part += counters[unit * comptime!(SHARE) + i];
    }
    parts[unit] = part;
    sync_cube();
    if unit < comptime!(DIGITS) {
        let mut sum = 0u32;
        for i in 0..comptime!(UNITS / SHARE) {
            sum += parts[unit * comptime!(UNITS / SHARE) + i];
        }
        counts[unit * blocks + CUBE_POS] = sum;
    }
}

/// Moves every pair to its place: behind all smaller digits, all equal ones of earlier blocks, and all equal ones of
/// this block that come before it.
#[cube(launch)]
#[allow(clippy::too_many_arguments, reason = "a kernel takes its buffers one by one")]
fn scatter(
    keys: &[u32],
    values: &[u32],
    offsets: &[u32],
    sorted_keys: &mut [u32],
    sorted_values: &mut [u32],
    n: usize,
    blocks: usize,
    shift: u32,
    mask: u32,
    #[comptime] counting: bool,
) {
    if CUBE_POS >= blocks {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let first = CUBE_POS * comptime!(BLOCK) + unit * comptime!(ITEMS);
    let mut counters = Shared::<[u32]>::new_slice(comptime!(COUNTERS));
    let mut parts = Shared::<[u32]>::new_slice(comptime!(UNITS));
    count(keys, &mut counters, first, n, shift, mask);
    sync_cube();
    // Exclusive prefix sums along each digit's row, a share of a row per unit.
    let mut part = 0u32;
    for i in 0..comptime!(SHARE) {
        part += counters[unit * comptime!(SHARE) + i];
    }
    parts[unit] = part;
    sync_cube();
    let row = unit / comptime!(UNITS / SHARE) * comptime!(UNITS / SHARE);
    let mut running = 0u32;
    for i in row..unit {
        running += parts[i];
    }
    for i in 0..comptime!(SHARE) {
        let at = unit * comptime!(SHARE) + i;
        let own = counters[at];
        counters[at] = running;
        running += own;
    }
    sync_cube();
    for i in 0..comptime!(ITEMS) {
        if first + i < n {
            let key = keys[first + i];
            let digit = ((key >> shift) & mask) as usize;
            let counter = digit * comptime!(UNITS) + unit;
            let place = (offsets[digit * blocks + CUBE_POS] + counters[counter]) as usize;
            counters[counter] += 1u32;
            sorted_keys[place] = key;
            if comptime!(counting) {
                sorted_values[place] = (first + i) as u32;
            } else {
                sorted_values[place] = values[first + i];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::buffers::testing::{read, upload, with_buffers};
    use super::sort;

    fn check(keys: &[u32], bits: u32) {
        with_buffers(|buffers| {
            let n = keys.len();
            let mask = ((1_u64 << bits) - 1) as u32;
            let mut order: Vec<u32> = (0..n as u32).collect();
            order.sort_by_key(|&i| keys[i as usize] & mask);
            let sorted: Vec<u32> = order.iter().map(|&i| keys[i as usize]).collect();

            let (got_keys, got_order) = sort(buffers, upload(buffers, keys), n, bits);
            assert!(read(got_keys)[..n] == sorted, "{n} keys of {bits} bits");
            assert!(read(got_order)[..n] == order, "{n} positions, {bits} bits");
        });
    }

    fn keys(n: u32) -> Vec<u32> {
        (0..n).map(|i| i.wrapping_mul(2_654_435_761) ^ (i << 7)).collect()
    }

    #[test]
    fn every_size_is_sorted_and_stable() {
        for n in [0, 1, 2, 7, 8, 9, 255, 256, 257, 2047, 2048, 2049, 50_000, 1_000_000] {
            check(&keys(n), 32);
        }
    }

    #[test]
    fn equal_keys_keep_their_order() {
        check(&vec![3; 10_000], 4);
        check(&vec![u32::MAX; 5000], 32);
        check(&keys(30_000).iter().map(|k| k % 3).collect::<Vec<_>>(), 2);
    }

    #[test]
    fn bits_beyond_the_asked_ones_do_not_count() {
        check(&keys(20_000), 8);
        check(&keys(20_000), 13);
        check(&keys(300), 1);
    }
}
