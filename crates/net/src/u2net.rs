//! The network that finds a person's pixels: U²-Net small (Qin et al., "U²-Net: Going Deeper with Nested U-Structure
//! for Salient Object Detection", 2020), with its published weights. Batch norms are folded into the convolutions.

use std::iter;

use burn::module::Param;
use burn::nn::PaddingConfig2d;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_ops::{bilinear, host, layers};

use crate::weights::{Source, WeightsError};

/// Side of the network's input and output in pixels.
pub const SIDE: usize = 320;
/// Mean and standard deviation of the colours in training (ImageNet's).
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// The encoder's blocks: the number of levels, and whether levels dilate the convolutions instead of halving the size
/// (Qin et al., figure 5). The decoder has the first five blocks in reverse order.
const BLOCKS: [(usize, bool); 6] = [(7, false), (6, false), (5, false), (4, false), (4, true), (4, true)];

/// U²-Net small, 1.1 million parameters.
pub struct U2Net {
    /// In the order in which they run.
    blocks: Vec<Block>,
    /// From each level to one plane, finest level first.
    sides: Vec<Conv2d>,
    /// From all planes to one.
    fuse: Conv2d,
}

/// A residual U-block.
struct Block {
    is_dilated: bool,
    input: Conv2d,
    down: Vec<Conv2d>,
    bottom: Conv2d,
    up: Vec<Conv2d>,
}

impl U2Net {
    /// Reads the weights of `docs/u2netp_convert.py`.
    ///
    /// # Errors
    /// [`WeightsError`] for a tensor that is missing.
    ///
    /// # Panics
    /// If a tensor has another shape than the network's.
    pub fn load(source: &Source, device: &Device) -> Result<Self, WeightsError> {
        let mut rows = 0..;
        let mut next = |dilation: usize| {
            let row = rows.next().expect("endless");
            convolution(source, &format!("convolutions.{row}"), dilation, device)
        };
        let mut block = |(count, is_dilated): (usize, bool)| {
            let dilation = |level: usize| if is_dilated { 1 << level } else { 1 };
            Ok::<_, WeightsError>(Block {
                is_dilated,
                input: next(1)?,
                down: (0..count - 1).map(|level| next(dilation(level))).collect::<Result<_, _>>()?,
                bottom: next(if is_dilated { dilation(count - 1) } else { 2 })?,
                up: (0..count - 1).rev().map(|level| next(dilation(level))).collect::<Result<_, _>>()?,
            })
        };
        let decoder = BLOCKS[..5].iter().rev();
        let blocks = BLOCKS.iter().chain(decoder).map(|kind| block(*kind)).collect::<Result<_, _>>()?;
        let side = |row: usize| convolution(source, &format!("sides.{row}"), 1, device);
        Ok(Self {
            blocks,
            sides: (0..BLOCKS.len()).map(side).collect::<Result<_, _>>()?,
            fuse: convolution(source, "fuse", 1, device)?,
        })
    }

    /// Colours from 0 to 1, `[3, SIDE, SIDE]` → probability of each pixel to belong to the subject, `[SIDE, SIDE]`.
    pub fn forward(&self, rgb: &[f32], device: &Device) -> Vec<f32> {
        let planes = rgb.chunks(SIDE * SIDE).zip(iter::zip(MEAN, DEVIATION));
        let values =
            planes.flat_map(|(plane, (mean, deviation))| plane.iter().map(move |v| (v - mean) / deviation));
        let data = TensorData::new(values.collect::<Vec<f32>>(), [1, 3, SIDE, SIDE]);
        let mut x = Tensor::<4>::from_data(data, device);
        let (encoder, decoder) = self.blocks.split_at(BLOCKS.len());
        let mut kept: Vec<Tensor<4>> = Vec::new();
        for block in encoder {
            x = block.forward(if kept.is_empty() { x } else { halved(x) });
            kept.push(x.clone());
        }
        let mut levels = vec![kept.pop().expect("six blocks")];
        for block in decoder {
            let fine = kept.pop().expect("five finer levels");
            x = block.forward(joined(x, fine));
            levels.push(x.clone());
        }
        let plane =
            |(side, x): (&Conv2d, Tensor<4>)| bilinear(layers::conv2d(side, x, false), [SIDE; 2], false);
        let planes = self.sides.iter().zip(levels.into_iter().rev()).map(plane).collect();
        host(sigmoid(layers::conv2d(&self.fuse, Tensor::cat(planes, 1), false)))
    }
}

impl Block {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let input = rectified(&self.input, x);
        let mut x = input.clone();
        let mut kept = Vec::new();
        for layer in &self.down {
            let smaller = !kept.is_empty() && !self.is_dilated;
            x = rectified(layer, if smaller { halved(x) } else { x });
            kept.push(x.clone());
        }
        x = rectified(&self.bottom, x);
        for layer in &self.up {
            x = rectified(layer, joined(x, kept.pop().expect("as many levels up as down")));
        }
        x + input
    }
}

/// The channels of `coarse`, enlarged to the size of `fine`, followed by the channels of `fine`.
fn joined(coarse: Tensor<4>, fine: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = fine.dims();
    Tensor::cat(vec![bilinear(coarse, [height, width], false), fine], 1)
}

pub(crate) fn halved(x: Tensor<4>) -> Tensor<4> {
    max_pool2d(x, MaxPoolOptions::new([2, 2]))
}

fn rectified(layer: &Conv2d, x: Tensor<4>) -> Tensor<4> {
    relu(layers::conv2d(layer, x, false))
}

/// Reads a convolution. Odd kernels keep the size. A kernel with one input is a depthwise one.
pub(crate) fn convolution(
    source: &Source,
    name: &str,
    dilation: usize,
    device: &Device,
) -> Result<Conv2d, WeightsError> {
    let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
    let values = [source.read_f32(&weight)?, source.read_f32(&bias)?];
    let shape: [usize; 4] = source.tensors()[&weight].shape.clone().try_into().expect("four axes");
    let [outputs, inputs, rows, columns] = shape;
    let padding = dilation * ((rows - 1) / 2);
    let groups = if inputs == 1 { outputs } else { 1 };
    let mut layer = Conv2dConfig::new([groups * inputs, outputs], [rows, columns])
        .with_groups(groups)
        .with_dilation([dilation; 2])
        .with_padding(PaddingConfig2d::Explicit(padding, padding, padding, padding))
        .init(device);
    let [weight, bias] = values;
    layer.weight = Param::from_data(TensorData::new(weight, shape), device);
    layer.bias = Some(Param::from_data(TensorData::new(bias, [outputs]), device));
    Ok(layer)
}
