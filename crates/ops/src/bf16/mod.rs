//! Matrix products of factors in bf16 with sums in f32, on processors that have `vdpbf16ps` of AVX-512.
//!
//! Values are rounded to bf16 to the nearest, ties to even. A word holds two values that are adjacent in the inner
//! dimension k, which is padded with zeros to blocks of 32:
//!
//! * the left factor as `[blocks][rows][16 pairs]`;
//! * the right factor as panels of 32 columns, `[panels][blocks · 16 pairs][32]`.
//!
//! Every element is one sum in one order, for any number of threads. Subnormal numbers count as 0.
//!
//! `unsafe` is needed to call functions with instructions that not every processor has.

#![cfg_attr(not(target_arch = "x86_64"), allow(unused, reason = "there is no unit"))]

#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(test)]
mod tests;

/// Pairs of k in a block.
pub const PAIRS: usize = 16;
/// Values of k in a block.
pub const BLOCK: usize = 2 * PAIRS;
/// Columns of a panel.
pub const PANEL: usize = 32;
/// Rows of padding behind the left factor, which a kernel may read.
pub const SLACK: usize = 32;

/// One row of the left factor in one block of k.
pub type Row = [u32; PAIRS];
/// One pair of k of a packed right factor in one panel.
pub type Columns = [u32; PANEL];
/// A block of sums. A kernel fills its first rows.
type Sums = [[f32; PANEL]; SLACK];

/// Whether this processor has the instructions.
pub fn is_there() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        avx512::is_there()
    }
    #[cfg(not(target_arch = "x86_64"))]
    false
}

/// Values in f32 that become a factor: rows of the left factor, or columns of the right factor.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// Values.
    pub values: &'a [f32],
    /// Distance of one row or column from the next, in values.
    pub stride: usize,
    /// Distance of one k from the next, in values.
    pub inner: usize,
    /// Rows or columns.
    pub count: usize,
    /// Values of k.
    pub depth: usize,
}

impl Source<'_> {
    /// Blocks of k.
    pub fn blocks(&self) -> usize {
        self.depth.div_ceil(BLOCK)
    }

    fn check(&self) {
        let last = (self.count - 1) * self.stride + (self.depth - 1) * self.inner;
        assert!(last < self.values.len(), "the strides stay inside");
    }

    /// Rows between the blocks of a packed left factor.
    pub fn packed_rows(&self) -> usize {
        self.count.next_multiple_of(PAIRS)
    }

    /// Packs rows `[blocks][packed_rows][16]`.
    pub fn pack_left(&self, out: &mut [Row]) {
        self.check();
        assert_eq!(out.len(), self.blocks() * self.packed_rows());
        #[cfg(target_arch = "x86_64")]
        avx512::pack_left(self, out);
    }

    /// Words of the packed right factor.
    pub fn words_right(&self) -> usize {
        self.count.div_ceil(PANEL) * PANEL * self.blocks() * PAIRS
    }

    /// Packs columns `[panels][blocks · 16][32]`.
    pub fn pack_right(&self, out: &mut [Columns]) {
        self.check();
        assert_eq!(out.len() * PANEL, self.words_right());
        #[cfg(target_arch = "x86_64")]
        avx512::pack_right(self, out);
    }
}

/// Computes `left` · `right`, and calls `each` with row, first column and up to 32 neighbouring sums. `left` are the
/// packed rows of `source` and [`SLACK`] more rows, `right` the packed columns.
///
/// # Panics
/// If a factor is smaller than the sizes say, or if the processor lacks the instructions.
pub fn product(
    source: &Source,
    left: &[Row],
    right: &[Columns],
    columns: usize,
    mut each: impl FnMut(usize, usize, &[f32]),
) {
    let (rows, packed, depth) = (source.count, source.packed_rows(), source.blocks() * PAIRS);
    assert!(left.len() >= source.blocks() * packed + SLACK, "blocks lie inside, with slack");
    assert!(right.len() >= columns.div_ceil(PANEL) * depth, "panels lie inside");
    #[cfg(target_arch = "x86_64")]
    {
        let mut sums: Sums = [[0.0; PANEL]; SLACK];
        for (column, panel) in (0..columns).step_by(PANEL).zip(right.chunks_exact(depth)) {
            let count = (columns - column).min(PANEL);
            let mut row = 0;
            while row < rows {
                let height = (rows - row).next_multiple_of(4).min(12);
                avx512::block(&left[row..], packed, height, count, panel, &mut sums);
                for (i, sums) in sums[..height.min(rows - row)].iter().enumerate() {
                    each(row + i, column, &sums[..count]);
                }
                row += height;
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    unreachable!("other processors have no such instructions");
}
