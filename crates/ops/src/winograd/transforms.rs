//! The three transforms of Winograd's F(4×4, 3×3) (Lavin and Gray, "Fast Algorithms for Convolutional Neural
//! Networks"): filters, tiles of inputs and tiles of products.
//!
//! The points are 0, ±⅝, ±3⁄2 and ∞, which are exact in binary. With the usual points 0, ±1, ±2, ∞ the transforms
//! magnify rounding errors twice as much (compare Alam, Anderson, Barabasz and Gregg, "Winograd Convolution for Deep
//! Neural Networks: Efficient Point Selection").

use pulp::{Simd, WithSimd};

use super::GROUP;
use super::planes::Planes;
use super::product::PANEL;
use crate::vectors::vectorized;

/// Rows and columns of a tile's outputs.
pub const TILE: usize = 4;
/// Rows and columns of a tile's inputs.
pub const SPAN: usize = 6;
/// Products per tile and pair of channels.
pub const POINTS: usize = SPAN * SPAN;

/// The positive finite points.
pub const P: f32 = 0.625;
pub const Q: f32 = 1.5;
pub const P2: f32 = P * P;
pub const Q2: f32 = Q * Q;

/// A rectangle of tiles, with its place and size in tiles.
#[derive(Clone, Copy)]
pub struct Block {
    pub row: usize,
    pub column: usize,
    pub rows: usize,
    pub columns: usize,
}

impl Block {
    pub fn tiles(&self) -> usize {
        self.rows * self.columns
    }
}

/// Bᵀ · d for six values d.
#[inline(always)]
fn input_points<S: Simd>(simd: S, d: [S::f32s; SPAN]) -> [S::f32s; SPAN] {
    let times = |a: f32, b, c| simd.mul_add_e_f32s(simd.splat_f32s(a), b, c);
    let end = |a, b, c| times(P2 * Q2, a, times(-P2 - Q2, b, c));
    let (even_p, odd_p) = (times(-Q2, d[2], d[4]), times(-Q2, d[1], d[3]));
    let (even_q, odd_q) = (times(-P2, d[2], d[4]), times(-P2, d[1], d[3]));
    [
        end(d[0], d[2], d[4]),
        times(P, odd_p, even_p),
        times(-P, odd_p, even_p),
        times(Q, odd_q, even_q),
        times(-Q, odd_q, even_q),
        end(d[1], d[3], d[5]),
    ]
}

/// G · (a, b, c) for the 32 filters of a panel.
#[inline(always)]
fn filter_points(a: &[f32; PANEL], b: &[f32; PANEL], c: &[f32; PANEL]) -> [[f32; PANEL]; SPAN] {
    let (at_zero, at_p, at_q) = (1.0 / (P2 * Q2), 0.5 / (P2 * (P2 - Q2)), 0.5 / (Q2 * (Q2 - P2)));
    let mut out = [[0.0; PANEL]; SPAN];
    for i in 0..PANEL {
        let (even_p, odd_p) = ((a[i] + P2 * c[i]) * at_p, P * b[i] * at_p);
        let (even_q, odd_q) = ((a[i] + Q2 * c[i]) * at_q, Q * b[i] * at_q);
        out[0][i] = a[i] * at_zero;
        out[1][i] = even_p + odd_p;
        out[2][i] = even_p - odd_p;
        out[3][i] = even_q + odd_q;
        out[4][i] = even_q - odd_q;
        out[5][i] = c[i];
    }
    out
}

/// Aᵀ · m for six values m.
#[inline(always)]
fn outputs<S: Simd>(simd: S, m: [S::f32s; SPAN]) -> [S::f32s; TILE] {
    let times = |a: f32, b, c| simd.mul_add_e_f32s(simd.splat_f32s(a), b, c);
    let scaled = |a: f32, b| simd.mul_f32s(simd.splat_f32s(a), b);
    let (sum_p, difference_p) = (simd.add_f32s(m[1], m[2]), simd.sub_f32s(m[1], m[2]));
    let (sum_q, difference_q) = (simd.add_f32s(m[3], m[4]), simd.sub_f32s(m[3], m[4]));
    [
        simd.add_f32s(m[0], simd.add_f32s(sum_p, sum_q)),
        times(P, difference_p, scaled(Q, difference_q)),
        times(P2, sum_p, scaled(Q2, sum_q)),
        times(P2 * P, difference_p, times(Q2 * Q, difference_q, m[5])),
    ]
}

/// G·g·Gᵀ of up to 32 filters: `[36][inputs in whole groups][32]`. `weights` begin with the first filter's first tap.
/// `strides`: floats from one filter to the next, and from one input to the next. `turned`: by 180°, for the gradient
/// of a convolution's input.
pub fn filters(
    weights: &[f32],
    [outputs, inputs]: [usize; 2],
    strides: [usize; 2],
    turned: bool,
    out: &mut [f32],
) {
    let rows = inputs.next_multiple_of(GROUP);
    let (out, _) = out.as_chunks_mut::<PANEL>();
    vectorized!(move || {
        for k in 0..rows {
            let mut g = [[0.0; PANEL]; 9];
            if k < inputs {
                for o in 0..outputs {
                    let filter = &weights[o * strides[0] + k * strides[1]..];
                    let filter: &[f32; 9] = filter.first_chunk().expect("nine taps");
                    for tap in 0..9 {
                        g[tap][o] = filter[if turned { 8 - tap } else { tap }];
                    }
                }
            }
            let columns = [
                filter_points(&g[0], &g[3], &g[6]),
                filter_points(&g[1], &g[4], &g[7]),
                filter_points(&g[2], &g[5], &g[8]),
            ];
            for y in 0..SPAN {
                let row = filter_points(&columns[0][y], &columns[1][y], &columns[2][y]);
                for (x, values) in row.iter().enumerate() {
                    out[(SPAN * y + x) * rows + k] = *values;
                }
            }
        }
    });
}

/// Bᵀ·d·B of every tile of a block: `[36][groups][stride][16]`.
pub struct Inputs<'a> {
    pub source: &'a Planes<'a>,
    pub block: Block,
    /// Tiles from one group to the next, at least as many as in the block.
    pub stride: usize,
    /// Room for [`lines`] floats.
    pub lines: &'a mut [f32],
    pub out: &'a mut [f32],
}

/// Floats of the six input rows that a row of `columns` tiles reads.
pub fn lines(columns: usize) -> usize {
    SPAN * (TILE * columns + SPAN - TILE) * GROUP
}

impl WithSimd for Inputs<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { source, block, stride, lines, out } = self;
        let (groups, length) = (source.groups(), lines.len() / SPAN);
        // The input rows and columns of a tile begin one before its outputs.
        let first = (TILE * block.column) as isize - 1;
        for (group, tile_row) in (0..groups).flat_map(|group| (0..block.rows).map(move |row| (group, row))) {
            for (i, out) in lines.chunks_exact_mut(length).enumerate() {
                let row = (TILE * (block.row + tile_row) + i).checked_sub(1);
                source.read(simd, group, row, first, out);
            }
            let planes = out.chunks_exact_mut(stride * GROUP).skip(group).step_by(groups);
            spread(
                simd,
                lines,
                block.columns,
                tile_row,
                planes,
                #[inline(always)]
                |d| input_points::<S>(simd, d),
            );
        }
    }
}

/// Transforms N rows of `lines` into six, in place, and then N columns of each tile into six, for the 36 `planes`
/// `[stride][16]` of one group. `points` transforms N values; unless it is inlined, every vector instruction is a call.
#[inline(always)]
pub fn spread<'a, S: Simd, const N: usize>(
    simd: S,
    lines: &mut [f32],
    columns: usize,
    tile_row: usize,
    mut planes: impl Iterator<Item = &'a mut [f32]>,
    points: impl Fn([S::f32s; N]) -> [S::f32s; SPAN],
) {
    let (length, vectors) = (lines.len() / SPAN, GROUP / S::F32_LANES);
    let mut rows: [&mut [S::f32s]; SPAN] = [(); SPAN].map(|()| Default::default());
    for (row, line) in rows.iter_mut().zip(lines.chunks_exact_mut(length)) {
        *row = S::as_mut_simd_f32s(line).0;
    }
    for i in 0..rows[0].len() {
        let mut d = [simd.splat_f32s(0.0); N];
        for y in 0..N {
            d[y] = rows[y][i];
        }
        let d = points(d);
        for y in 0..SPAN {
            rows[y][i] = d[y];
        }
    }
    for line in lines.chunks_exact(length) {
        let mut row: [&mut [[f32; GROUP]]; SPAN] = Default::default();
        for (row, plane) in row.iter_mut().zip(planes.by_ref()) {
            *row = &mut plane.as_chunks_mut().0[tile_row * columns..][..columns];
        }
        for t in 0..columns {
            let (tile, _) = S::as_simd_f32s(&line[t * TILE * GROUP..][..N * GROUP]);
            for v in 0..vectors {
                let mut d = [simd.splat_f32s(0.0); N];
                for x in 0..N {
                    d[x] = tile[x * vectors + v];
                }
                let d = points(d);
                for x in 0..SPAN {
                    S::as_mut_simd_f32s(&mut row[x][t]).0[v] = d[x];
                }
            }
        }
    }
}

/// Aᵀ·m·A + bias of every tile of a block.
pub struct Outputs<'a, 'b> {
    /// `[36][groups][stride][16]`.
    pub products: &'a [f32],
    pub block: Block,
    /// Tiles from one group to the next.
    pub stride: usize,
    /// One value per channel, in whole groups.
    pub bias: &'a [f32],
    /// Pixels per row of the image.
    pub width: usize,
    /// Rows of the image from the block's first row on, `[rows][width][16]` per group. Tiles may overhang the rows.
    pub out: &'a mut [&'b mut [f32]],
}

impl WithSimd for Outputs<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { products, block, stride, bias, width, out } = self;
        let (groups, vectors) = (out.len(), GROUP / S::F32_LANES);
        let zero = simd.splat_f32s(0.0);
        for (group, out) in out.iter_mut().enumerate() {
            let (bias, _) = S::as_simd_f32s(&bias[group * GROUP..][..GROUP]);
            let (out, _) = S::as_mut_simd_f32s(out);
            let height = out.len() / (width * vectors);
            let mut points: [&[[f32; GROUP]]; POINTS] = [&[]; POINTS];
            let planes = products.chunks_exact(stride * GROUP).skip(group).step_by(groups);
            for (points, plane) in points.iter_mut().zip(planes) {
                *points = &plane.as_chunks().0[..block.tiles()];
            }
            for (row, column) in
                (0..block.rows).flat_map(|row| (0..block.columns).map(move |column| (row, column)))
            {
                let t = row * block.columns + column;
                let (top, left) = (TILE * row, TILE * (block.column + column));
                let [rows, columns] = [TILE.min(height - top), TILE.min(width - left)];
                for v in 0..vectors {
                    let mut half = [[zero; TILE]; SPAN];
                    for y in 0..SPAN {
                        let mut m = [zero; SPAN];
                        for x in 0..SPAN {
                            m[x] = S::as_simd_f32s(&points[SPAN * y + x][t]).0[v];
                        }
                        half[y] = outputs::<S>(simd, m);
                    }
                    let mut tile = [[zero; TILE]; TILE];
                    for x in 0..TILE {
                        let mut m = [zero; SPAN];
                        for y in 0..SPAN {
                            m[y] = half[y][x];
                        }
                        tile[x] = outputs::<S>(simd, m);
                    }
                    for y in 0..rows {
                        let line = &mut out[((top + y) * width + left) * vectors..][..columns * vectors];
                        for x in 0..columns {
                            line[x * vectors + v] = simd.add_f32s(tile[x][y], bias[v]);
                        }
                    }
                }
            }
        }
    }
}
