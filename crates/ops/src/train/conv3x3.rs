//! 3×3 convolutions with stride 1 and padding 1 by Winograd's F(4×4, 3×3) of `wide`, on images `[B, C, H, W]`.
//!
//! The gradient of the input is the same convolution with filters turned by 180°, and with inputs and outputs
//! exchanged. The gradient of the weight is the transposed method: the products of transformed inputs and transformed
//! output gradients are summed over all tiles, and the sum is transformed back. This takes 36 instead of 144
//! multiplications per sixteen pixels and pair of channels, too.

use rayon::prelude::*;

use super::elements::channel_sums;
use super::planes::{Planes, Scatter, Transposer};
use super::{Gradients, Unfolded, Wanted};
use crate::buffers::{give, take};
use crate::wide::convolution::{Bands, Weights};
use crate::wide::transforms::{POINTS, TILE};
use crate::wide::{GROUP, pieces};

/// Floats of a block's transformed inputs and products together: 1 MiB, most of which fits a second-level cache.
const BLOCK_FLOATS: usize = 256 * 1024;

/// Up to this number of pixels of all images, the weight's gradient is summed tap by tap. If a channel is positive in a
/// few pixels only, the gradients of some taps are 0. Winograd's method would round, and AdamW scale up the rounding.
const FEW_PIXELS: usize = 1024;

/// Sizes of a convolution, and whether it reads max(x, 0) instead of its input x.
#[derive(Debug, Clone, Copy)]
pub struct Conv3x3 {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Reads max(x, 0).
    pub rectified: bool,
}

impl Conv3x3 {
    /// `x` `[B, inputs, H, W]`, `weight` `[outputs, inputs, 3, 3]`, `bias` `[outputs]` → `[B, outputs, H, W]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let filters = Weights { values: weight, strides: [9 * self.inputs, 9], turned: false };
        self.run(x, self.rectified, filters, bias, None)
    }

    /// Gradients from the output's gradient `dy` `[B, outputs, H, W]`.
    pub fn backward(&self, x: &[f32], weight: &[f32], dy: &[f32], wanted: Wanted) -> Gradients {
        let input = wanted.input.then(|| {
            let filters = Weights { values: weight, strides: [9, 9 * self.inputs], turned: true };
            let back = Self { inputs: self.outputs, outputs: self.inputs, ..*self };
            back.run(dy, false, filters, None, self.rectified.then_some(x))
        });
        if wanted.weight && self.batch * self.height * self.width <= FEW_PIXELS {
            let Self { batch, inputs, outputs, height, width, rectified } = *self;
            let direct = Unfolded { batch, inputs, outputs, height, width, stride: 1, rectified };
            let gradients = direct.backward(x, weight, dy, Wanted { input: false, ..wanted });
            Gradients { input, ..gradients }
        } else if wanted.weight {
            // The gradient of the bias is a by-product.
            let [weight, bias] = self.weight_gradient(x, dy);
            Gradients { input, weight: Some(weight), bias: wanted.bias.then_some(bias) }
        } else {
            let bias = wanted.bias.then(|| channel_sums(dy, self.batch, self.outputs));
            Gradients { input, weight: None, bias }
        }
    }

    /// Winograd's method with any filters. The result is 0 where `mask` is not positive, if there is a mask.
    fn run(
        &self,
        x: &[f32],
        rectified: bool,
        filters: Weights,
        bias: Option<&[f32]>,
        mask: Option<&[f32]>,
    ) -> Vec<f32> {
        let (plane, width) = (self.height * self.width, self.width);
        assert_eq!(x.len(), self.batch * self.inputs * plane);
        let transformed = filters.transform([self.inputs, self.outputs]);
        let mut padded = bias.unwrap_or_default().to_vec();
        padded.resize(self.outputs.next_multiple_of(GROUP), 0.0);
        let mut out = take(self.batch * self.outputs * plane);
        let (band, transposer) = (self.band_rows(), Transposer::new());
        let tasks: Vec<_> = out
            .chunks_exact_mut(self.outputs * plane)
            .zip(x.chunks_exact(self.inputs * plane))
            .enumerate()
            .flat_map(|(image, (out, x))| {
                let bands = pieces(out, plane, band * TILE * width).into_iter().enumerate();
                bands.map(move |(i, out)| (image, x, i * band, out))
            })
            .collect();
        let tiles = self.block_tiles();
        let bands = Bands { inputs: self.inputs, filters: &transformed, bias: &padded, width, tiles };
        tasks.into_par_iter().for_each(|(image, data, row, mut out)| {
            let planes = Planes { data, height: self.height, width, rectified, transposer };
            let pixels = out[0].len();
            let mut grouped = take(padded.len() * pixels);
            let mut slices: Vec<_> = grouped.chunks_exact_mut(pixels * GROUP).collect();
            bands.run(&planes, row, &mut slices);
            for (group, planes) in out.chunks_mut(GROUP).enumerate() {
                let first = (image * self.outputs + group * GROUP) * plane + row * TILE * width;
                let mask = mask.map(|mask| (&mask[first..], plane));
                let pixels = &grouped[group * pixels * GROUP..][..pixels * GROUP];
                Scatter { pixels, planes, mask }.run(transposer);
            }
            give(grouped);
        });
        give(transformed);
        out
    }

    /// Tiles per block.
    pub(super) fn block_tiles(&self) -> usize {
        (BLOCK_FLOATS / (POINTS * (self.inputs + self.outputs))).max(GROUP)
    }

    /// Rows of tiles per task.
    pub(super) fn band_rows(&self) -> usize {
        (self.block_tiles() / self.width.div_ceil(TILE)).clamp(1, self.height.div_ceil(TILE))
    }
}
