//! Layers that are one matrix product for all pixels: 1×1 convolutions, and with a rearrangement before or after it,
//! 3×3 convolutions with stride 2 and transposed convolutions whose kernel is as large as their stride.

use pulp::Arch;
use rayon::prelude::*;

use super::image::Image;
use super::product::{Left, PANEL, Product, Right, pack};
use super::{Buffers, GROUP, pieces};

/// Pixels per task: a multiple of the kernel's rows, and few enough that their channels stay in the second-level cache.
const PIXELS: usize = 192;

/// A matrix for all pixels.
#[derive(Debug)]
pub struct Pointwise {
    inputs: usize,
    outputs: usize,
    /// `[panels][inputs][32]`.
    panels: Vec<f32>,
    bias: Vec<f32>,
}

impl Pointwise {
    /// A 1×1 convolution: `weights` `[outputs, inputs]`, `bias` `[outputs]`.
    pub fn new(weights: &[f32], bias: &[f32], [inputs, outputs]: [usize; 2], buffers: &Buffers) -> Self {
        let rows = padded(inputs, |i| i);
        let columns = padded(outputs, |o| o * inputs);
        Self::pack(weights, &rows, &columns, bias.iter().copied(), buffers)
    }

    /// A 3×3 convolution with stride 2 and padding 1 of an unfolded image ([`Image::unfold`]): `weights`
    /// `[outputs, inputs, 3, 3]`, `bias` `[outputs]`.
    pub fn halving(weights: &[f32], bias: &[f32], [inputs, outputs]: [usize; 2], buffers: &Buffers) -> Self {
        let rows: Vec<_> = (0..9).flat_map(|tap| padded(inputs, move |i| 9 * i + tap)).collect();
        let columns = padded(outputs, |o| 9 * o * inputs);
        Self::pack(weights, &rows, &columns, bias.iter().copied(), buffers)
    }

    /// A transposed convolution whose kernel is as large as its stride, before [`Image::shuffle`]: `weights`
    /// `[inputs, outputs, stride, stride]`, `bias` `[outputs]`.
    pub fn enlarging(
        weights: &[f32],
        bias: &[f32],
        [inputs, outputs]: [usize; 2],
        stride: usize,
        buffers: &Buffers,
    ) -> Self {
        let places = stride * stride;
        let rows = padded(inputs, |i| i * outputs * places);
        let columns: Vec<_> =
            (0..places).flat_map(|place| padded(outputs, move |o| o * places + place)).collect();
        let absent = outputs.next_multiple_of(GROUP) - outputs;
        let bias = (0..places).flat_map(|_| bias.iter().copied().chain(std::iter::repeat_n(0.0, absent)));
        Self::pack(weights, &rows, &columns, bias, buffers)
    }

    fn pack(
        weights: &[f32],
        rows: &[Option<usize>],
        columns: &[Option<usize>],
        bias: impl Iterator<Item = f32>,
        buffers: &Buffers,
    ) -> Self {
        let width = columns.len().next_multiple_of(PANEL);
        let mut panels = buffers.take(width * rows.len());
        pack(weights, rows, columns, &mut panels);
        let mut bias: Vec<f32> = bias.collect();
        let outputs = bias.len();
        bias.resize(width, 0.0);
        Self { inputs: rows.len(), outputs, panels, bias }
    }

    /// Inputs `[inputs, H, W]` → `[outputs, H, W]`. The layer's memory goes back to `buffers`.
    pub fn run(self, image: &Image, buffers: &Buffers) -> Image {
        let mut out = Image::take(self.outputs, [image.height, image.width], buffers);
        let plane = out.plane();
        pieces(&mut out.data, plane, PIXELS * GROUP).into_par_iter().enumerate().for_each(|(i, mut out)| {
            self.pixels(&image.data[i * PIXELS * GROUP..], plane, &mut out);
        });
        buffers.give(self.panels);
        out
    }

    /// The first pixels of groups that are `stride` floats apart, as many as `out` holds per group.
    pub(super) fn pixels(&self, values: &[f32], stride: usize, out: &mut [&mut [f32]]) {
        let left = Left { values, stride, groups: self.inputs / GROUP, rows: out[0].len() / GROUP };
        let right = Right { values: &self.panels, stride: self.inputs * PANEL };
        Arch::new().dispatch(Product { left, right, bias: Some(&self.bias), out });
    }

    /// Outputs, absent ones of the last group included.
    pub(super) fn width(&self) -> usize {
        self.outputs.next_multiple_of(GROUP)
    }

    pub(super) fn outputs(&self) -> usize {
        self.outputs
    }
}

/// Places of `count` channels, and none for those that complete the last group.
fn padded(count: usize, place: impl Fn(usize) -> usize) -> Vec<Option<usize>> {
    (0..count.next_multiple_of(GROUP)).map(|i| (i < count).then(|| place(i))).collect()
}
