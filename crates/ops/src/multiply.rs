//! Matrix products on one thread, in f32 by the gemm crate or in bf16 by [`crate::bf16`]. Callers divide the work among
//! threads by sizes alone, so that every element is one sum in one order.

use rayon::prelude::*;

use crate::bf16::{self, PANEL, SLACK, Source};
use crate::buffers::Words;

/// A matrix in f32: values, and their (column, row) strides in elements.
pub type Matrix<'a> = (&'a [f32], [usize; 2]);

/// Right factor `[k, n]` of products.
pub enum Right<'a> {
    /// In f32, not packed.
    Plain(Matrix<'a>),
    /// In bf16, packed by [`Source::pack_right`].
    Packed(Words),
}

impl<'a> Right<'a> {
    /// The factor in bf16 if `in_bf16` is set and the processor has the instructions, else in f32.
    pub fn new(in_bf16: bool, [k, n]: [usize; 2], matrix: Matrix<'a>) -> Self {
        if in_bf16 && bf16::is_there() { Self::packed([k, n], matrix) } else { Self::Plain(matrix) }
    }

    pub(crate) fn packed([depth, columns]: [usize; 2], (values, [stride, inner]): Matrix) -> Self {
        /// Words per task.
        const PIECE: usize = 32 * 1024;
        let source = Source { values, stride, inner, count: columns, depth };
        let panel = source.blocks() * bf16::PAIRS * PANEL;
        let mut words = Words::new(source.words_right());
        let panels = words.par_chunks_exact_mut(panel).with_min_len(PIECE.div_ceil(panel)).enumerate();
        panels.for_each(|(i, out)| {
            let (values, count) = (&values[i * PANEL * stride..], (columns - i * PANEL).min(PANEL));
            Source { values, count, ..source }.pack_right(out.as_chunks_mut().0);
        });
        Self::Packed(words)
    }
}

/// Writes the product lhs `[m, k]` · rhs `[k, n]` to `out` `[m, n]`, or adds the product to the values that are there.
/// `size`: m, n, k.
pub fn product(size: [usize; 3], lhs: Matrix, rhs: &Right, out: &mut [f32], add: bool) {
    match rhs {
        Right::Plain(rhs) => in_f32(size, lhs, *rhs, out, add),
        Right::Packed(words) => product_in_bf16(size, lhs, words, out, add),
    }
}

fn product_in_bf16([m, n, k]: [usize; 3], lhs: Matrix, rhs: &[u32], out: &mut [f32], add: bool) {
    /// Words of the left factor that are packed at once: 128 KiB, which leaves second-level cache for a panel.
    const WORDS: usize = 32 * 1024;
    let ((values, [inner, row]), blocks) = (lhs, k.div_ceil(bf16::BLOCK));
    let most = (WORDS / (blocks * bf16::PAIRS)).next_multiple_of(4 * bf16::PAIRS);
    for first in (0..m).step_by(most) {
        let values = &values[first * row..];
        let source = Source { values, stride: row, inner, count: most.min(m - first), depth: k };
        let packed = source.packed_rows();
        let mut words = Words::new((blocks * packed + SLACK) * bf16::PAIRS);
        let (rows, _) = words.as_chunks_mut();
        source.pack_left(&mut rows[..blocks * packed]);
        bf16::product(&source, rows, rhs.as_chunks::<PANEL>().0, n, |row, column, sums| {
            let out = &mut out[(first + row) * n + column..][..sums.len()];
            match add {
                true => out.iter_mut().zip(sums).for_each(|(out, sum)| *out += sum),
                false => out.copy_from_slice(sums),
            }
        });
    }
}

fn in_f32([m, n, k]: [usize; 3], (lhs, ls): Matrix, (rhs, rs): Matrix, out: &mut [f32], add: bool) {
    let last =
        |rows: usize, columns: usize, [column, row]: [usize; 2]| (rows - 1) * row + (columns - 1) * column;
    assert!(m > 0 && n > 0 && k > 0);
    assert!(last(m, k, ls) < lhs.len() && last(k, n, rs) < rhs.len() && m * n <= out.len());
    let [[lc, lr], [rc, rr]] = [ls, rs].map(|strides| strides.map(|stride| stride as isize));
    let (lhs, rhs, out, row) = (lhs.as_ptr(), rhs.as_ptr(), out.as_mut_ptr(), n as isize);
    let (keep, alone) = (if add { 1.0 } else { 0.0 }, gemm::Parallelism::None);
    // SAFETY: the assertions above bound every element that the strides reach; `out` is borrowed mutably.
    #[allow(unsafe_code, reason = "the matrix product of the gemm crate takes pointers")]
    unsafe {
        gemm::gemm(
            m, n, k, out, 1, row, add, lhs, lc, lr, rhs, rc, rr, keep, 1.0, false, false, false, alone,
        );
    }
}
