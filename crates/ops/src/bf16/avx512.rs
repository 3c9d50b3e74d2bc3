//! Packing and the kernel for AVX-512 with instructions for bf16.

#![allow(unsafe_code, reason = "functions for processors that have these instructions")]

use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_cvtepu16_epi32, _mm512_cvtne2ps_pbh, _mm512_cvtneps_pbh,
    _mm512_dpbf16_ps, _mm512_or_si512, _mm512_set1_epi32, _mm512_setzero_ps, _mm512_setzero_si512,
    _mm512_slli_epi32,
};

use pulp::cast;
use pulp::core_arch::x86::Avx512f;

use super::{BLOCK, Columns, PAIRS, PANEL, Row, Source, Sums};
use crate::winograd::planes::shuffled;

/// Whether this processor has the instructions of all functions of this file.
#[inline]
pub fn is_there() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512bf16")
}

#[inline]
fn check() {
    assert!(is_there(), "this processor computes in bf16");
}

/// Sums of the first `rows` (4, 8 or 12) rows. The blocks of the left factor begin `packed` rows apart.
pub fn block(left: &[Row], packed: usize, rows: usize, columns: usize, panel: &[Columns], sums: &mut Sums) {
    check();
    // SAFETY: the processor has the instructions.
    unsafe {
        match (rows, columns > PAIRS) {
            (12, true) => kernel::<12, 2>(left, packed, panel, sums),
            (12, false) => kernel::<12, 1>(left, packed, panel, sums),
            (8, true) => kernel::<8, 2>(left, packed, panel, sums),
            (8, false) => kernel::<8, 1>(left, packed, panel, sums),
            (_, true) => kernel::<4, 2>(left, packed, panel, sums),
            (_, false) => kernel::<4, 1>(left, packed, panel, sums),
        }
    }
}

/// See [`Source::pack_left`].
pub fn pack_left(source: &Source, out: &mut [Row]) {
    check();
    // SAFETY: the processor has the instructions.
    unsafe { left(source, out) }
}

/// See [`Source::pack_right`].
pub fn pack_right(source: &Source, out: &mut [Columns]) {
    check();
    // SAFETY: the processor has the instructions.
    unsafe { right(source, out) }
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn kernel<const ROWS: usize, const VECTORS: usize>(
    left: &[Row],
    packed: usize,
    panel: &[Columns],
    out: &mut Sums,
) {
    let mut sums = [[_mm512_setzero_ps(); VECTORS]; ROWS];
    for (block, panel) in panel.as_chunks::<PAIRS>().0.iter().enumerate() {
        let rows: &[Row; ROWS] = left[block * packed..].first_chunk().expect("the block lies inside");
        for (pair, columns) in panel.iter().enumerate() {
            let mut right: [__m512bh; VECTORS] = [cast(_mm512_setzero_si512()); VECTORS];
            for (right, columns) in right.iter_mut().zip(columns.as_chunks::<PAIRS>().0) {
                *right = cast(*columns);
            }
            for (sums, row) in sums.iter_mut().zip(rows) {
                let value = cast(_mm512_set1_epi32(row[pair].cast_signed()));
                for (sum, right) in sums.iter_mut().zip(right) {
                    *sum = _mm512_dpbf16_ps(*sum, value, right);
                }
            }
        }
    }
    for (out, sums) in out.iter_mut().zip(sums) {
        for (out, sum) in out.as_chunks_mut::<PAIRS>().0.iter_mut().zip(sums) {
            *out = cast(sum);
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn left(source: &Source, out: &mut [Row]) {
    for (block, out) in out.chunks_exact_mut(source.packed_rows()).enumerate() {
        for (i, out) in out.as_chunks_mut::<PAIRS>().0.iter_mut().enumerate() {
            let square = square(source, i * PAIRS, block * BLOCK, true);
            out.iter_mut().zip(square).for_each(|(out, row)| *out = cast(row));
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn right(source: &Source, out: &mut [Columns]) {
    let blocks = source.blocks();
    for (i, out) in out.as_chunks_mut::<PAIRS>().0.iter_mut().enumerate() {
        let (panel, block) = (i / blocks, i % blocks);
        for half in 0..PANEL / PAIRS {
            let square = square(source, panel * PANEL + half * PAIRS, block * BLOCK, false);
            for (out, row) in out.iter_mut().zip(square) {
                out.as_chunks_mut::<PAIRS>().0[half] = cast(row);
            }
        }
    }
}

/// 16 rows (or columns) from `first` on by 16 pairs of k from `k` on: `[row][pair]` if `by_row`, else `[pair][row]`.
/// Values outside of the source are 0.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn square(source: &Source, first: usize, k: usize, by_row: bool) -> [__m512i; PAIRS] {
    let Source { stride, inner, count, depth, .. } = *source;
    let (count, depth) = (count.saturating_sub(first).min(PAIRS), depth - k);
    let values = &source.values[(first * stride + k * inner).min(source.values.len())..];
    let mut square = [_mm512_setzero_si512(); PAIRS];
    // The contiguous dimension is read in vectors.
    let along_rows = inner != 1 && stride == 1;
    for (i, out) in square.iter_mut().enumerate() {
        if along_rows {
            let line = |k: usize| line(values, k * inner, 1, if k < depth { count } else { 0 });
            *out = interleaved(line(2 * i), line(2 * i + 1));
        } else if i < count {
            let line =
                |k: usize| line(values, i * stride + k * inner, inner, depth.saturating_sub(k).min(PAIRS));
            *out = consecutive(line(0), line(PAIRS));
        }
    }
    if along_rows == by_row {
        let simd = Avx512f::try_new().expect("this processor computes in bf16");
        square = cast(shuffled(simd, cast(square)));
    }
    square
}

/// 16 floats: `count` values that lie `step` apart, then zeros.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn line(values: &[f32], start: usize, step: usize, count: usize) -> __m512 {
    if step == 1 && count == PAIRS {
        let values: &[f32; PAIRS] = values[start..].first_chunk().expect("the line lies inside");
        return cast(*values);
    }
    let mut line = [0.0; PAIRS];
    if count > 0 {
        let values = values[start..].iter().step_by(step);
        line[..count].iter_mut().zip(values).for_each(|(line, x)| *line = *x);
    }
    cast(line)
}

/// Words of the pairs (a₀, b₀), (a₁, b₁) …
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn interleaved(a: __m512, b: __m512) -> __m512i {
    let [a, b] = [cast(_mm512_cvtneps_pbh(a)), cast(_mm512_cvtneps_pbh(b))];
    let [a, b] = [_mm512_cvtepu16_epi32(a), _mm512_cvtepu16_epi32(b)];
    _mm512_or_si512(a, _mm512_slli_epi32::<16>(b))
}

/// Words of the pairs (a₀, a₁), … (b₀, b₁), …
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
fn consecutive(a: __m512, b: __m512) -> __m512i {
    cast(_mm512_cvtne2ps_pbh(b, a))
}
