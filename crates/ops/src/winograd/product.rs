//! Matrix products whose factors are stored in the order in which the kernel reads them, so that nothing is packed.
//!
//! The kernel keeps a block of the result in registers (12 rows of 32 columns with AVX-512), sums over the whole inner
//! dimension and writes the block once. Every element is one sum in one order, for any number of threads.

use pulp::{Simd, WithSimd};

use super::GROUP;

/// Columns of a panel of the right factor.
pub const PANEL: usize = 2 * GROUP;

/// Left factor `[rows, 16·groups]`: `[rows][16]` per group, with `stride` floats from one group to the next.
#[derive(Clone, Copy)]
pub struct Left<'a> {
    pub values: &'a [f32],
    pub stride: usize,
    pub groups: usize,
    pub rows: usize,
}

/// Right factor `[16·groups, columns]`: `[16·groups][32]` per panel, with `stride` floats from one panel to the next.
#[derive(Clone, Copy)]
pub struct Panels<'a> {
    pub values: &'a [f32],
    pub stride: usize,
}

/// out = left · right.
pub struct Product<'a, 'b> {
    pub left: Left<'a>,
    pub right: Panels<'a>,
    /// `[rows][16]` per group of 16 columns.
    pub out: &'a mut [&'b mut [f32]],
}

impl WithSimd for Product<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors per row of a block of 32 columns and of a block of 16 columns, and rows per block: as many as there
        // are registers beside those for the factors. Sixteen registers are too few for a block of 32 columns.
        match S::F32_LANES {
            16 => panels::<S, 2, 1, 12>(simd, self),
            8 => panels::<S, 2, 2, 6>(simd, self),
            4 => panels::<S, 4, 4, 6>(simd, self),
            _ => panels::<S, 16, 16, 1>(simd, self),
        }
    }
}

#[inline(always)]
fn panels<S: Simd, const WIDE: usize, const NARROW: usize, const ROWS: usize>(simd: S, product: Product) {
    let Product { left, right, out } = product;
    for (p, out) in out.chunks_mut(PANEL / GROUP).enumerate() {
        let panel = &right.values[p * right.stride..][..left.groups * GROUP * PANEL];
        if out.len() == 2 && WIDE * S::F32_LANES == PANEL {
            rows::<S, WIDE, ROWS>(simd, left, panel, out);
        } else {
            for (i, out) in out.chunks_mut(1).enumerate() {
                // The second half of the panel begins 16 floats later.
                rows::<S, NARROW, ROWS>(simd, left, &panel[i * GROUP..], out);
            }
        }
    }
}

/// All rows of the result in VECTORS vectors of columns.
#[inline(always)]
fn rows<S: Simd, const VECTORS: usize, const ROWS: usize>(
    simd: S,
    left: Left,
    panel: &[f32],
    out: &mut [&mut [f32]],
) {
    /// Rows of the smaller block, for the remaining rows.
    const FEW: usize = 4;
    let mut row = 0;
    while row < left.rows {
        // The last block begins earlier instead of being smaller. Rows that are computed twice get the same values.
        if left.rows >= ROWS && left.rows - row > FEW {
            row = row.min(left.rows - ROWS);
            block::<S, VECTORS, ROWS>(simd, left, row, panel, out);
            row += ROWS;
        } else if left.rows >= FEW {
            row = row.min(left.rows - FEW);
            block::<S, VECTORS, FEW>(simd, left, row, panel, out);
            row += FEW;
        } else {
            block::<S, VECTORS, 1>(simd, left, row, panel, out);
            row += 1;
        }
    }
}

/// ROWS rows from `row` on, in VECTORS vectors of columns.
#[inline(always)]
fn block<S: Simd, const VECTORS: usize, const ROWS: usize>(
    simd: S,
    left: Left,
    row: usize,
    panel: &[f32],
    out: &mut [&mut [f32]],
) {
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
    for group in 0..left.groups {
        let (values, _) = left.values[group * left.stride + row * GROUP..].as_chunks::<GROUP>();
        let values: &[[f32; GROUP]; ROWS] = values.first_chunk().expect("the block lies inside");
        let weights = &panel[group * GROUP * PANEL..];
        let weights = &weights[..(GROUP - 1) * PANEL + VECTORS * S::F32_LANES];
        for k in 0..GROUP {
            let weights = load::<S, VECTORS>(simd, &weights[k * PANEL..]);
            for (sums, values) in sums.iter_mut().zip(values) {
                let value = simd.splat_f32s(values[k]);
                for v in 0..VECTORS {
                    sums[v] = simd.mul_add_e_f32s(value, weights[v], sums[v]);
                }
            }
        }
    }
    let vectors = GROUP / S::F32_LANES;
    for (o, out) in out.iter_mut().enumerate() {
        let (out, _) = S::as_mut_simd_f32s(&mut out[row * GROUP..][..ROWS * GROUP]);
        for (r, sums) in sums.iter().enumerate() {
            for v in 0..vectors {
                out[r * vectors + v] = sums[o * vectors + v];
            }
        }
    }
}

#[inline(always)]
fn load<S: Simd, const VECTORS: usize>(simd: S, values: &[f32]) -> [S::f32s; VECTORS] {
    let (values, _) = S::as_simd_f32s(values);
    let mut vectors = [simd.splat_f32s(0.0); VECTORS];
    vectors.copy_from_slice(&values[..VECTORS]);
    vectors
}
