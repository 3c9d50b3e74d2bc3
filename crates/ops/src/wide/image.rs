//! Images with their channels in groups, and what moves pixels about.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::transforms::Lines;
use super::{Buffers, GROUP};
use snapsnap_base::bilinear::{Tap, taps};

/// An image in groups of channels; those of the last group that do not exist are 0.
#[derive(Debug)]
pub struct Image {
    /// Channels that exist.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// `[groups][height][width][16]`.
    pub data: Vec<f32>,
}

impl Image {
    /// An image of any values.
    pub(super) fn take(channels: usize, [height, width]: [usize; 2], buffers: &Buffers) -> Self {
        let data = buffers.take(channels.next_multiple_of(GROUP) * height * width);
        Self { channels, height, width, data }
    }

    /// Floats of one group.
    pub(super) fn plane(&self) -> usize {
        self.height * self.width * GROUP
    }

    pub(super) fn groups(&self) -> usize {
        self.channels.div_ceil(GROUP)
    }

    /// From pixels with their channels together, `[height, width, channels]`.
    pub fn from_pixels(pixels: &[f32], channels: usize, size: [usize; 2], buffers: &Buffers) -> Self {
        let mut image = Self::take(channels, size, buffers);
        let plane = image.plane();
        image.data.par_chunks_exact_mut(plane).enumerate().for_each(|(group, out)| {
            let count = GROUP.min(channels - group * GROUP);
            let pixels = pixels.chunks_exact(channels);
            for (out, pixel) in out.as_chunks_mut::<GROUP>().0.iter_mut().zip(pixels) {
                out[..count].copy_from_slice(&pixel[group * GROUP..][..count]);
                out[count..].fill(0.0);
            }
        });
        image
    }

    /// The inputs of a 3×3 convolution with stride 2 and padding 1, for [`super::Pointwise::halving`]: nine times the
    /// groups, tap after tap.
    pub fn unfold(&self, buffers: &Buffers) -> Self {
        let size = [self.height.div_ceil(2), self.width.div_ceil(2)];
        let groups = self.groups();
        let mut out = Self::take(9 * groups * GROUP, size, buffers);
        let plane = out.plane();
        out.data.par_chunks_exact_mut(plane).enumerate().for_each(|(i, out)| {
            let (tap, group) = (i / groups, i % groups);
            let (input, _) = self.data[group * self.plane()..][..self.plane()].as_chunks::<GROUP>();
            for (i, out) in out.as_chunks_mut::<GROUP>().0.iter_mut().enumerate() {
                // One more than the place in the image.
                let (y, x) = (2 * (i / size[1]) + tap / 3, 2 * (i % size[1]) + tap % 3);
                let inside = (1..=self.height).contains(&y) && (1..=self.width).contains(&x);
                *out = if inside { input[(y - 1) * self.width + x - 1] } else { [0.0; GROUP] };
            }
        });
        out
    }

    /// The result of a transposed convolution from that of [`super::Pointwise::enlarging`], whose groups hold one place of
    /// every `stride` × `stride` square after the other.
    pub fn shuffle(&self, stride: usize, channels: usize, buffers: &Buffers) -> Self {
        let mut out = Self::take(channels, [stride * self.height, stride * self.width], buffers);
        let (groups, plane, width) = (out.groups(), out.plane(), out.width);
        out.data.par_chunks_exact_mut(plane).enumerate().for_each(|(group, out)| {
            for (y, line) in out.chunks_exact_mut(width * GROUP).enumerate() {
                for (x, out) in line.as_chunks_mut::<GROUP>().0.iter_mut().enumerate() {
                    let place = (y % stride * stride + x % stride) * groups + group;
                    let (input, _) = self.data[place * self.plane()..].as_chunks::<GROUP>();
                    *out = input[y / stride * self.width + x / stride];
                }
            }
        });
        out
    }

    /// Adds `coarse`, bilinearly enlarged to twice its size (outermost samples coincide) and cut to this image's.
    pub fn add_doubled(&mut self, coarse: &Self) {
        let (width, plane) = (self.width, self.plane());
        let source = Source::doubled(coarse);
        let arch = Arch::new();
        self.data.par_chunks_exact_mut(plane).enumerate().for_each(|(group, out)| {
            let mut line = vec![0.0; width * GROUP];
            for (row, out) in out.chunks_exact_mut(width * GROUP).enumerate() {
                arch.dispatch(Row { source: &source, group, row: Some(row), first: 0, out: &mut line });
                out.iter_mut().zip(&line).for_each(|(out, x)| *out += x);
            }
        });
    }
}

/// What a convolution reads. Cheap changes are made on the way, which saves an image of their results.
#[derive(Debug)]
pub struct Source<'a> {
    pub(super) image: &'a Image,
    rectified: bool,
    /// Where rows and columns come from, if not from themselves.
    taps: Option<[Vec<Tap>; 2]>,
}

impl<'a> Source<'a> {
    /// The image itself.
    pub fn plain(image: &'a Image) -> Self {
        Self { image, rectified: false, taps: None }
    }

    /// max(image, 0).
    pub fn rectified(image: &'a Image) -> Self {
        Self { image, rectified: true, taps: None }
    }

    /// The image bilinearly enlarged to twice its size; the outermost samples coincide.
    pub fn doubled(image: &'a Image) -> Self {
        let taps = [image.height, image.width].map(|from| taps(from, 2 * from, true));
        Self { image, rectified: false, taps: Some(taps) }
    }

    /// Height and width.
    pub(super) fn size(&self) -> [usize; 2] {
        match &self.taps {
            Some(taps) => taps.each_ref().map(Vec::len),
            None => [self.image.height, self.image.width],
        }
    }
}

impl Lines for Source<'_> {
    fn groups(&self) -> usize {
        self.image.groups()
    }

    #[inline(always)]
    fn line<S: Simd>(&self, simd: S, group: usize, row: Option<usize>, first: isize, out: &mut [f32]) {
        Row { source: self, group, row, first, out }.with_simd(simd);
    }
}

/// [`Lines::line`] of a source.
struct Row<'a> {
    pub source: &'a Source<'a>,
    pub group: usize,
    pub row: Option<usize>,
    pub first: isize,
    pub out: &'a mut [f32],
}

impl WithSimd for Row<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { source, group, row, first, out } = self;
        let ([height, width], image) = (source.size(), source.image);
        let Some(row) = row.filter(|row| *row < height) else {
            out.fill(0.0);
            return;
        };
        let from = first.max(0) as usize;
        let (border, out) = out.split_at_mut(if first < 0 { GROUP } else { 0 });
        let (out, beyond) = out.split_at_mut((width - from).min(out.len() / GROUP) * GROUP);
        border.fill(0.0);
        beyond.fill(0.0);
        let plane = &image.data[group * image.plane()..][..image.plane()];
        let line = |row: usize| &plane[row * image.width * GROUP..][..image.width * GROUP];
        let Some([down, across]) = &source.taps else {
            let values = &line(row)[from * GROUP..][..out.len()];
            if source.rectified {
                out.iter_mut().zip(values).for_each(|(out, x)| *out = if *x > 0.0 { *x } else { 0.0 });
            } else {
                out.copy_from_slice(values);
            }
            return;
        };
        let (low, high, weight) = down[row];
        let (low, high, weight) = (line(low), line(high), simd.splat_f32s(weight));
        for (out, &(left, right, across)) in out.as_chunks_mut::<GROUP>().0.iter_mut().zip(&across[from..]) {
            let across = simd.splat_f32s(across);
            let (a, b) = (pixel::<S>(low, left), pixel::<S>(low, right));
            let (c, d) = (pixel::<S>(high, left), pixel::<S>(high, right));
            for (v, out) in S::as_mut_simd_f32s(out).0.iter_mut().enumerate() {
                let upper = simd.mul_add_e_f32s(simd.sub_f32s(b[v], a[v]), across, a[v]);
                let lower = simd.mul_add_e_f32s(simd.sub_f32s(d[v], c[v]), across, c[v]);
                *out = simd.mul_add_e_f32s(simd.sub_f32s(lower, upper), weight, upper);
            }
        }
    }
}

#[inline(always)]
fn pixel<S: Simd>(line: &[f32], x: usize) -> &[S::f32s] {
    S::as_simd_f32s(&line[x * GROUP..][..GROUP]).0
}
