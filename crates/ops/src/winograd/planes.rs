//! Conversion between images `[C, H, W]` and the groups of 16 adjacent channels that the transforms read. Blocks of
//! 16 × 16 values are transposed in registers, so no image is stored a second time.

use pulp::{Simd, WithSimd};

use super::GROUP;

/// The values of 16 pixels in 16 channels.
type Square = [[f32; GROUP]; GROUP];

/// The transpose of a square, by shuffles where vectors have 16 values.
#[inline(always)]
#[cfg_attr(not(target_arch = "x86_64"), allow(unused_variables))]
fn transposed<S: Simd>(simd: S, square: Square) -> Square {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = (&simd as &dyn std::any::Any).downcast_ref::<pulp::x86::V4>() {
        return shuffled(simd.avx512f, square);
    }
    std::array::from_fn(|i| std::array::from_fn(|j| square[j][i]))
}

/// [`transposed`] in four rounds of shuffles: of values, of pairs of values, of quarters and of halves.
///
/// Loops, because closures of `array::from_fn` are not compiled for the target's features.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub fn shuffled(f: pulp::core_arch::x86::Avx512f, square: Square) -> Square {
    use std::arch::x86_64::{__m512, __m512d};
    let mut rows: [__m512; GROUP] = pulp::cast(square);
    for i in (0..GROUP).step_by(2) {
        let (a, b) = (rows[i], rows[i + 1]);
        (rows[i], rows[i + 1]) = (f._mm512_unpacklo_ps(a, b), f._mm512_unpackhi_ps(a, b));
    }
    // Afterwards quarter q of row 4·i + j holds column 4·q + j of rows 4·i … 4·i + 3.
    let mut pairs: [__m512d; GROUP] = pulp::cast(rows);
    for i in (0..GROUP).step_by(4) {
        let [a, b, c, d] = [pairs[i], pairs[i + 1], pairs[i + 2], pairs[i + 3]];
        (pairs[i], pairs[i + 1]) = (f._mm512_unpacklo_pd(a, c), f._mm512_unpackhi_pd(a, c));
        (pairs[i + 2], pairs[i + 3]) = (f._mm512_unpacklo_pd(b, d), f._mm512_unpackhi_pd(b, d));
    }
    let mut rows: [__m512; GROUP] = pulp::cast(pairs);
    for distance in [4, 8] {
        for i in 0..GROUP {
            if i & distance == 0 {
                let (a, b) = (rows[i], rows[i + distance]);
                rows[i] = f._mm512_shuffle_f32x4::<0x88>(a, b);
                rows[i + distance] = f._mm512_shuffle_f32x4::<0xdd>(a, b);
            }
        }
    }
    pulp::cast(rows)
}

/// max(x, 0) of every value.
#[inline(always)]
fn rectify(square: &mut Square) {
    for x in square.as_flattened_mut() {
        *x = if *x > 0.0 { *x } else { 0.0 };
    }
}

/// One image `[channels, height, width]`, read in groups of 16 channels.
#[derive(Debug, Clone, Copy)]
pub struct Planes<'a> {
    pub data: &'a [f32],
    pub height: usize,
    pub width: usize,
    /// Reads max(image, 0).
    pub rectified: bool,
}

impl Planes<'_> {
    fn channels(&self) -> usize {
        self.data.len() / (self.height * self.width)
    }

    /// Groups of channels.
    pub fn groups(&self) -> usize {
        self.channels().div_ceil(GROUP)
    }

    /// Writes a part of a row of one group to `out` `[columns][16]`, from column `first` on, where −1 is the border.
    /// Pixels outside of the image are 0. `None` is a row outside of the image.
    pub fn read<S: Simd>(&self, simd: S, group: usize, row: Option<usize>, first: isize, out: &mut [f32]) {
        let Some(row) = row.filter(|row| *row < self.height) else {
            out.fill(0.0);
            return;
        };
        let from = first.max(0) as usize;
        let (border, out) = out.split_at_mut(if first < 0 { GROUP } else { 0 });
        let (out, beyond) = out.split_at_mut((self.width - from).min(out.len() / GROUP) * GROUP);
        border.fill(0.0);
        beyond.fill(0.0);
        let plane = self.height * self.width;
        let data = &self.data[group * GROUP * plane + row * self.width + from..];
        let channels = GROUP.min(self.channels() - group * GROUP);
        let pixels = out.as_chunks_mut().0;
        simd.vectorize(Gather { data, plane, channels, rectified: self.rectified, pixels });
    }
}

/// Makes the channels of each pixel adjacent, for up to 16 planes that begin `plane` floats apart.
struct Gather<'a> {
    data: &'a [f32],
    plane: usize,
    channels: usize,
    rectified: bool,
    pixels: &'a mut [[f32; GROUP]],
}

impl WithSimd for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { data, plane, channels, rectified, pixels } = self;
        let (squares, rest) = pixels.as_chunks_mut::<GROUP>();
        let mut done = 0;
        if channels == GROUP && !squares.is_empty() {
            // Sixteen load instructions are sixteen streams that the processor prefetches.
            let mut planes = [data; GROUP];
            for (c, values) in planes.iter_mut().enumerate() {
                *values = &data[c * plane..][..squares.len() * GROUP];
            }
            for (i, out) in squares.iter_mut().enumerate() {
                let mut square = [[0.0; GROUP]; GROUP];
                for c in 0..GROUP {
                    square[c] = planes[c].as_chunks().0[i];
                }
                if rectified {
                    rectify(&mut square);
                }
                *out = transposed(simd, square);
            }
            done = squares.len();
        }
        let ragged = squares.iter_mut().map(<[_; GROUP]>::as_mut_slice).skip(done);
        for (i, out) in (done..).zip(ragged.chain([rest])) {
            let mut square = [[0.0; GROUP]; GROUP];
            for (c, row) in square.iter_mut().enumerate().take(channels) {
                row[..out.len()].copy_from_slice(&data[c * plane + i * GROUP..][..out.len()]);
            }
            if rectified {
                rectify(&mut square);
            }
            out.copy_from_slice(&transposed(simd, square)[..out.len()]);
        }
    }
}

/// Writes pixels with adjacent channels to up to 16 planes.
pub struct Scatter<'a, 'b> {
    /// `[pixels][16]`.
    pub pixels: &'a [f32],
    /// The same pixels of every channel.
    pub planes: &'a mut [&'b mut [f32]],
    /// Planes and the number of floats between them. Where they are not positive, 0 is written.
    pub mask: Option<(&'a [f32], usize)>,
}

impl WithSimd for Scatter<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { pixels, planes, mask } = self;
        let (squares, rest) = pixels.as_chunks::<GROUP>().0.as_chunks::<GROUP>();
        let whole = squares.len() * GROUP;
        let mut done = 0;
        if let Ok(planes) = <&mut [&mut [f32]; GROUP]>::try_from(&mut *planes) {
            let mut out: [&mut [[f32; GROUP]]; GROUP] = Default::default();
            for (out, plane) in out.iter_mut().zip(planes) {
                *out = &mut plane.as_chunks_mut().0[..squares.len()];
            }
            let mut signs = [&[[1.0; GROUP]][..0]; GROUP];
            if let Some((mask, stride)) = mask {
                for (c, signs) in signs.iter_mut().enumerate() {
                    *signs = mask[c * stride..][..whole].as_chunks().0;
                }
            }
            for (i, square) in squares.iter().enumerate() {
                let mut square = transposed(simd, *square);
                if mask.is_some() {
                    let mut given = [[0.0; GROUP]; GROUP];
                    for c in 0..GROUP {
                        given[c] = signs[c][i];
                    }
                    keep_positive(square.as_flattened_mut(), given.as_flattened());
                }
                for c in 0..GROUP {
                    out[c][i] = square[c];
                }
            }
            done = squares.len();
        }
        let ragged = squares.iter().map(<[_; GROUP]>::as_slice).skip(done);
        for (i, pixels) in (done..).zip(ragged.chain([rest])) {
            let mut square = [[0.0; GROUP]; GROUP];
            square[..pixels.len()].copy_from_slice(pixels);
            let square = transposed(simd, square);
            let at = i * GROUP..i * GROUP + pixels.len();
            for (c, (plane, mut row)) in planes.iter_mut().zip(square).enumerate() {
                if let Some((mask, stride)) = mask {
                    keep_positive(&mut row, &mask[c * stride..][at.clone()]);
                }
                plane[at.clone()].copy_from_slice(&row[..pixels.len()]);
            }
        }
    }
}

/// values = 0 where x is not positive.
#[inline(always)]
pub fn keep_positive(values: &mut [f32], x: &[f32]) {
    for (value, x) in values.iter_mut().zip(x) {
        *value = if *x > 0.0 { *value } else { 0.0 };
    }
}
