//! Sixteen pixels of a row at a time, as plain loops over arrays that compile to SIMD.

use crate::options::TILE;

use super::splats::Splat;

/// One value per pixel of a tile's row.
pub type Lanes = [f32; TILE];

/// Pixel centres of a tile's columns, relative to the tile's first pixel.
pub const CENTRES: Lanes = {
    let mut centres = [0.0; TILE];
    let mut i = 0;
    while i < TILE {
        centres[i] = i as f32 + 0.5;
        i += 1;
    }
    centres
};

/// exp(x) for x ≤ 0, within 2 units in the last place; below −87 it stays at exp(−87).
///
/// x = n·ln 2 + r with |r| ≤ ½ ln 2; exp(r) by its Taylor polynomial, whose remainder r⁸/8! is below 6e-9; 2ⁿ by the
/// exponent bits.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    /// Adding it to a small float rounds that to an integer, which the low bits then hold.
    const ROUND: f32 = 12_582_912.0;
    /// ln 2 in two parts: the first has few enough bits that n times it is exact.
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let x = x.max(-87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN_2_HIGH) - n * LN_2_LOW;
    let mut p = 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23;
    p * f32::from_bits(exponent)
}

/// The parts of a splat's quadratic form along a row of pixels.
pub struct Row {
    /// d_x.
    pub dx: Lanes,
    /// d_y + k·d_x.
    pub sheared: Lanes,
    /// o·exp(−½ dᵀΛd), before the clamp at α_max.
    pub alpha: Lanes,
}

/// The splat over the row of pixels whose first column is `left` and whose centre is at `y`.
#[inline(always)]
pub fn row(splat: &Splat, left: f32, y: f32) -> Row {
    let dy = y - splat.v;
    let mut row = Row { dx: [0.0; TILE], sheared: [0.0; TILE], alpha: [0.0; TILE] };
    for i in 0..TILE {
        let dx = (left + CENTRES[i]) - splat.u;
        let sheared = dy + splat.k * dx;
        let p = splat.l0 * dx;
        let q = splat.l1 * sheared;
        row.dx[i] = dx;
        row.sheared[i] = sheared;
        row.alpha[i] = splat.opacity * exp(-0.5 * (p * p + q * q));
    }
    row
}

/// Splats that [`fetch`] copies at once.
pub const BATCH: usize = 64;

/// Copies the splats of `entries` side by side. They lie all over a large array; loads that nothing waits for overlap,
/// one after another they would each take the whole way to memory.
#[inline(always)]
pub fn fetch(splats: &[Splat], entries: &[u32], batch: &mut [Splat; BATCH]) {
    for (slot, &entry) in batch.iter_mut().zip(entries) {
        *slot = splats[entry as usize];
    }
}

/// First and last row of the tile that starts at image row `top` within the splat's reach.
#[inline(always)]
pub fn rows(splat: &Splat, top: usize) -> std::ops::RangeInclusive<usize> {
    let first = usize::from(splat.rows[0]).max(top) - top;
    let last = usize::from(splat.rows[1]).min(top + TILE - 1) - top;
    first..=last
}

#[cfg(test)]
mod tests {
    #[test]
    fn exp_is_within_two_units_in_the_last_place() {
        for i in 0..870_000 {
            let x = -(i as f32) * 1e-4;
            let exact = f64::from(x).exp();
            let error = (f64::from(super::exp(x)) - exact).abs() / exact;
            assert!(error < 2.0 * f64::from(f32::EPSILON), "exp({x}): relative error {error}");
        }
        assert_eq!(super::exp(0.0), 1.0);
        assert_eq!(super::exp(-1e30), super::exp(-87.0));
    }
}
