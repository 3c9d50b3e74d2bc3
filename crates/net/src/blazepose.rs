//! The network that finds a person's joints and pixels: BlazePose, the full model (Bazarevsky et al., "BlazePose:
//! On-device Real-time Body Pose Tracking", 2020), with its published weights.

use std::cell::RefCell;

use burn::nn::PaddingConfig2d;
use burn::nn::conv::Conv2d;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_ops::{bilinear, host, layers};

use Block::{Halved, Residual, Wider};

use crate::u2net::{convolution, halved};
use crate::weights::{Source, WeightsError};

/// Side of the network's input and of its mask in pixels.
pub const SIDE: usize = 256;
/// Number of convolutions.
const CONVOLUTIONS: usize = 94;
/// The encoder's inverted residual blocks after the first one (Sandler et al., "MobileNetV2", 2018).
const BLOCKS: [Block; 14] = [
    Halved, Residual, Halved, Residual, Halved, Residual, Residual, Wider, Residual, Residual, Halved,
    Residual, Residual, Residual,
];
/// Blocks of the landmarks' branch, and the blocks among them that halve the size.
const BRANCH: usize = 11;
const HALVED: [usize; 2] = [0, 5];

#[derive(Clone, Copy, PartialEq, Eq)]
enum Block {
    /// Halves the size. The block's input goes to the mask's branch as well.
    Halved,
    /// Adds its input.
    Residual,
    /// Has more channels than its input.
    Wider,
}

/// BlazePose, 3.0 million parameters.
pub struct BlazePose {
    /// In the order of the published graph.
    convolutions: Vec<Conv2d>,
}

/// What the network sees in a square picture.
#[derive(Debug, Clone)]
pub struct Pose {
    /// 33 joints, and six points that describe where the body is: column and row in pixels of the input, depth in the
    /// same unit (negative towards the camera), and the logits of visible and of present. 0 nose, 7 and
    /// 8 ears, 11 and 12 shoulders, 13 and 14 elbows, 15 and 16 wrists, 17 to 22 hands, 23 and 24 hips, 25 and 26 knees,
    /// 27 and 28 ankles, 29 and 30 heels, 31 and 32 toes. Odd numbers are on the person's left.
    pub landmarks: Vec<[f32; 5]>,
    /// Probability that the picture shows a person.
    pub presence: f32,
    /// Probability of each pixel to belong to the person, `[SIDE, SIDE]`.
    pub mask: Vec<f32>,
}

impl BlazePose {
    /// Reads the weights of `docs/blazepose_convert.py`.
    ///
    /// # Errors
    /// [`WeightsError`] for a tensor that is missing.
    ///
    /// # Panics
    /// If a tensor has another shape than the network's.
    pub fn load(source: &Source, device: &Device) -> Result<Self, WeightsError> {
        let layer = |row: usize| convolution(source, &format!("convolutions.{row}"), 1, device);
        let mut convolutions = (0..CONVOLUTIONS).map(layer).collect::<Result<Vec<_>, _>>()?;
        let mut row = 0;
        convolutions[row].stride = [2; 2];
        row += 3;
        for block in BLOCKS {
            if block == Halved {
                convolutions[row + 3].stride = [2; 2];
            }
            row += if block == Halved { 5 } else { 3 };
        }
        // Both layers before the branches, the mask's branch, and the first two layers of the landmarks' branch.
        row += 2 + 13 + 2;
        for block in HALVED {
            let layer = &mut convolutions[row + 2 * block];
            layer.stride = [2; 2];
            // TensorFlow's padding of even sizes: after the last row and column only.
            layer.padding = PaddingConfig2d::Explicit(0, 0, 1, 1);
        }
        Ok(Self { convolutions })
    }

    /// Colours from 0 to 1, `[3, SIDE, SIDE]` → joints and pixels of the person.
    pub fn forward(&self, rgb: &[f32], device: &Device) -> Pose {
        let rows = RefCell::new(self.convolutions.iter());
        let plain = |x: Tensor<4>| {
            let layer = rows.borrow_mut().next().expect("a layer of the graph");
            layers::conv2d(layer, x, false)
        };
        let rectified = |x: Tensor<4>| clipped(plain(x));
        let twice = |x: Tensor<4>| rectified(rectified(x));
        let data = TensorData::new(rgb.to_vec(), [1, 3, SIDE, SIDE]);
        let mut x = plain(twice(Tensor::from_data(data, device)));
        let mut finer = Vec::new();
        for block in BLOCKS {
            let wide = rectified(x.clone());
            if block == Halved {
                finer.push(twice(x.clone()));
            }
            let narrow = plain(rectified(wide));
            x = if block == Residual { narrow + x } else { narrow };
        }
        x = twice(x);

        let mut y = twice(x.clone());
        let finest = finer.remove(0);
        for part in finer.into_iter().rev() {
            y = doubled(y) + part;
        }
        y = doubled(twice(y)) + finest;
        for is_doubled in [false, true] {
            if is_doubled {
                y = doubled(y);
            }
            for _ in 0..2 {
                let part = rectified(y.clone());
                y = clipped(y + plain(part));
            }
        }
        let mask = sigmoid(plain(y));

        x = twice(x);
        for block in 0..BRANCH {
            let part = rectified(x.clone());
            let before = if HALVED.contains(&block) { halved(x) } else { x };
            x = clipped(before + plain(part));
        }
        let values = host(plain(x.clone()));
        Pose {
            landmarks: values.as_chunks::<5>().0.to_vec(),
            presence: host(sigmoid(plain(x)))[0],
            mask: host(mask),
        }
    }
}

/// A rectifier that is also limited from above.
fn clipped(x: Tensor<4>) -> Tensor<4> {
    x.clamp(0.0, 6.0)
}

fn doubled(x: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = x.dims();
    bilinear(x, [2 * height, 2 * width], false)
}
