//! The transposes of Winograd's transforms, and the sum over tiles between them, for the gradient of filters:
//! dg = Gᵀ · Σ (A·dy·Aᵀ ∘ Bᵀ·x·B) · G, with the matrices of `winograd::transforms`.

use pulp::{Simd, WithSimd};

use crate::winograd::GROUP;
use crate::winograd::planes::Planes;
use crate::winograd::transforms::{Block, P, P2, POINTS, Q, Q2, SPAN, TILE, spread};

/// A · d for four values d.
#[inline(always)]
fn gradient_points<S: Simd>(simd: S, d: [S::f32s; TILE]) -> [S::f32s; SPAN] {
    let times = |a: f32, b, c| simd.mul_add_e_f32s(simd.splat_f32s(a), b, c);
    let (even_p, even_q) = (times(P2, d[2], d[0]), times(Q2, d[2], d[0]));
    let (odd_p, odd_q) = (times(P2, d[3], d[1]), times(Q2, d[3], d[1]));
    [
        d[0],
        times(P, odd_p, even_p),
        times(-P, odd_p, even_p),
        times(Q, odd_q, even_q),
        times(-Q, odd_q, even_q),
        d[3],
    ]
}

/// Gᵀ · s for six values s.
#[inline(always)]
fn taps<S: Simd>(simd: S, s: [S::f32s; SPAN]) -> [S::f32s; 3] {
    let times = |a: f32, b, c| simd.mul_add_e_f32s(simd.splat_f32s(a), b, c);
    let scaled = |a: f32, b| simd.mul_f32s(simd.splat_f32s(a), b);
    let (at_zero, at_p, at_q) = (1.0 / (P2 * Q2), 0.5 / (P2 * (P2 - Q2)), 0.5 / (Q2 * (Q2 - P2)));
    let (sum_p, difference_p) =
        (scaled(at_p, simd.add_f32s(s[1], s[2])), scaled(at_p, simd.sub_f32s(s[1], s[2])));
    let (sum_q, difference_q) =
        (scaled(at_q, simd.add_f32s(s[3], s[4])), scaled(at_q, simd.sub_f32s(s[3], s[4])));
    [
        times(at_zero, s[0], simd.add_f32s(sum_p, sum_q)),
        times(P, difference_p, scaled(Q, difference_q)),
        times(P2, sum_p, times(Q2, sum_q, s[5])),
    ]
}

/// A·dy·Aᵀ of every tile of a block: `[36][groups][stride][16]`.
pub struct OutputGradients<'a> {
    pub source: &'a Planes<'a>,
    pub block: Block,
    /// Tiles from one group to the next, at least as many as in the block.
    pub stride: usize,
    /// Room for six rows of the block's pixels in one group.
    pub lines: &'a mut [f32],
    pub out: &'a mut [f32],
    /// Sums of dy per channel, in whole groups, to which the block's sums are added.
    pub sums: &'a mut [f64],
}

impl WithSimd for OutputGradients<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { source, block, stride, lines, out, sums } = self;
        let (groups, length) = (source.groups(), block.columns * TILE * GROUP);
        let lines = &mut lines[..SPAN * length];
        for (group, tile_row) in (0..groups).flat_map(|group| (0..block.rows).map(move |row| (group, row))) {
            for (i, out) in lines.chunks_exact_mut(length).take(TILE).enumerate() {
                let row = TILE * (block.row + tile_row) + i;
                source.read(simd, group, Some(row), (TILE * block.column) as isize, out);
                let mut sum = [0.0; GROUP];
                for pixel in out.as_chunks::<GROUP>().0 {
                    sum.iter_mut().zip(pixel).for_each(|(sum, x)| *sum += x);
                }
                for (total, sum) in sums[group * GROUP..].iter_mut().zip(sum) {
                    *total += f64::from(sum);
                }
            }
            let planes = out.chunks_exact_mut(stride * GROUP).skip(group).step_by(groups);
            spread(
                simd,
                lines,
                block.columns,
                tile_row,
                planes,
                #[inline(always)]
                |d| gradient_points::<S>(simd, d),
            );
        }
    }
}

/// out `[16·left groups, 16·right groups]` = leftᵀ · right, summed over tiles.
pub struct Accumulate<'a> {
    /// `[groups][stride][16]`.
    pub left: &'a [f32],
    /// `[groups][stride][16]`.
    pub right: &'a [f32],
    /// Tiles from one group to the next.
    pub stride: usize,
    pub tiles: usize,
    /// Adds the product to the values of `out`.
    pub add: bool,
    pub out: &'a mut [f32],
}

impl WithSimd for Accumulate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors and rows of a block of the result: as many as there are registers beside those for the factors.
        match S::F32_LANES {
            16 => blocks::<S, 1, 2, 8>(simd, self),
            8 => blocks::<S, 2, 2, 4>(simd, self),
            4 => blocks::<S, 4, 4, 2>(simd, self),
            _ => blocks::<S, 16, 16, 1>(simd, self),
        }
    }
}

/// NARROW vectors are one group. WIDE vectors are one or two groups.
#[inline(always)]
fn blocks<S: Simd, const NARROW: usize, const WIDE: usize, const ROWS: usize>(simd: S, mut sum: Accumulate) {
    let count = sum.right.len() / (sum.stride * GROUP);
    let wide = WIDE / NARROW;
    for rows in (0..sum.left.len() / sum.stride).step_by(ROWS) {
        let mut column = 0;
        while column < count {
            if column + wide <= count {
                block::<S, NARROW, WIDE, ROWS>(simd, &mut sum, rows, column, count);
                column += wide;
            } else {
                block::<S, NARROW, NARROW, ROWS>(simd, &mut sum, rows, column, count);
                column += 1;
            }
        }
    }
}

/// ROWS rows from `row` on and VECTORS vectors of columns from group `column` on.
#[inline(always)]
fn block<S: Simd, const NARROW: usize, const VECTORS: usize, const ROWS: usize>(
    simd: S,
    sum: &mut Accumulate,
    row: usize,
    column: usize,
    count: usize,
) {
    let group = |values, group: usize| -> &[[f32; GROUP]] {
        let values: &[f32] = values;
        &values[group * sum.stride * GROUP..].as_chunks().0[..sum.tiles]
    };
    let (left, first) = (group(sum.left, row / GROUP), row % GROUP);
    let right = [group(sum.right, column), group(sum.right, column + VECTORS / NARROW - 1)];
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
    for ((left, a), b) in left.iter().zip(right[0]).zip(right[1]) {
        let left: &[f32; ROWS] = left[first..].first_chunk().expect("blocks of rows divide a group");
        let (a, b) = (S::as_simd_f32s(a).0, S::as_simd_f32s(b).0);
        let mut values = [simd.splat_f32s(0.0); VECTORS];
        for v in 0..VECTORS {
            values[v] = if v < NARROW { a[v] } else { b[v - NARROW] };
        }
        for (sums, left) in sums.iter_mut().zip(left) {
            let left = simd.splat_f32s(*left);
            for v in 0..VECTORS {
                sums[v] = simd.mul_add_e_f32s(left, values[v], sums[v]);
            }
        }
    }
    for (r, sums) in sums.iter().enumerate() {
        let out = &mut sum.out[((row + r) * count + column) * GROUP..][..VECTORS * S::F32_LANES];
        for (out, value) in S::as_mut_simd_f32s(out).0.iter_mut().zip(sums) {
            *out = if sum.add { simd.add_f32s(*out, *value) } else { *value };
        }
    }
}

/// Gᵀ·s·G of one output's sums, `[inputs, 3, 3]`.
pub struct Taps<'a> {
    /// Every part's sums of this output, `[inputs in whole groups]` per point. The sums of two points begin `stride`
    /// floats apart.
    pub parts: &'a [&'a [f32]],
    pub stride: usize,
    pub out: &'a mut [f32],
}

impl WithSimd for Taps<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let zero = simd.splat_f32s(0.0);
        for (group, out) in self.out.chunks_mut(9 * GROUP).enumerate() {
            let mut result = [[0.0; GROUP]; 9];
            for v in 0..GROUP / S::F32_LANES {
                let mut points = [zero; POINTS];
                for part in self.parts {
                    for (i, point) in points.iter_mut().enumerate() {
                        let values =
                            &part[i * self.stride + group * GROUP + v * S::F32_LANES..][..S::F32_LANES];
                        *point = simd.add_f32s(*point, S::as_simd_f32s(values).0[0]);
                    }
                }
                let mut half = [[zero; 3]; SPAN];
                for (half, row) in half.iter_mut().zip(points.as_chunks::<SPAN>().0) {
                    *half = taps::<S>(simd, *row);
                }
                for x in 0..3 {
                    let mut column = [zero; SPAN];
                    for y in 0..SPAN {
                        column[y] = half[y][x];
                    }
                    for (y, value) in taps::<S>(simd, column).into_iter().enumerate() {
                        S::as_mut_simd_f32s(&mut result[3 * y + x]).0[v] = value;
                    }
                }
            }
            for (i, out) in out.as_chunks_mut::<9>().0.iter_mut().enumerate() {
                *out = std::array::from_fn(|tap| result[tap][i]);
            }
        }
    }
}
