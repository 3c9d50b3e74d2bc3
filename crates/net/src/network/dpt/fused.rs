//! The head over the wide convolutions of [`snapsnap_ops::wide`]: activations, residuals and enlargements are part of the
//! convolutions beside them, and the widest maps, those of the full picture, are never stored.

use burn::module::Param;
use burn::nn::conv::Conv2d;
use burn::tensor::{Tensor, TensorData};

use snapsnap_ops::wide::{Buffers, Conv3x3, Image, Pointwise, Source};

use super::{DptHead, Enlarge, Fusion, ResidualConvUnit};

/// Tokens `[B, N, C]` of four layers → `[B, 4, 16·rows, 16·columns]`, as [`DptHead::forward`].
pub fn forward(head: &DptHead, tokens: [Tensor<3>; 4], grid: [usize; 2]) -> Tensor<4> {
    let (device, [batch, count, _]) = (tokens[0].device(), tokens[0].dims());
    let tokens = tokens.map(|tokens| (tokens.dims()[2], tokens.into_data()));
    let pass = Pass { head, buffers: Buffers::default() };
    let mut points = Vec::new();
    for sample in 0..batch {
        points.extend(pass.run(tokens.each_ref().map(|(channels, values)| {
            let values = &slice(values)[sample * count * channels..][..count * channels];
            Image::from_pixels(values, *channels, grid, &pass.buffers)
        })));
    }
    let [height, width] = grid.map(|side| 16 * side);
    let channels = points.len() / (batch * height * width);
    Tensor::from_data(TensorData::new(points, [batch, channels, height, width]), &device)
}

struct Pass<'a> {
    head: &'a DptHead,
    buffers: Buffers,
}

impl Pass<'_> {
    /// Token maps of one sample → planes `[4, 16·rows, 16·columns]`.
    fn run(&self, [m0, m1, m2, m3]: [Image; 4]) -> Vec<f32> {
        let (branches, s, head) = (&self.head.act_postprocess, &self.head.scratch, &self.head.head);
        let l3 = self
            .conv3x3(&s.layer4_rn, self.halve(&branches.at_3.at_1, self.conv1x1(&branches.at_3.at_0, m3)));
        let path = self.fuse(&s.refinenet4, None, l3);
        let l2 = self.conv3x3(&s.layer3_rn, self.conv1x1(&branches.at_2.at_0, m2));
        let path = self.fuse(&s.refinenet3, Some(path), l2);
        let l1 = self.conv3x3(&s.layer2_rn, self.enlarge(&branches.at_1, m1));
        let path = self.fuse(&s.refinenet2, Some(path), l1);
        let l0 = self.conv3x3(&s.layer1_rn, self.enlarge(&branches.at_0, m0));
        let path = self.fuse(&s.refinenet1, Some(path), l0);
        let x = self.wide(&head.at_0).run(&Source::doubled(&path), &self.buffers);
        self.buffers.give(path.data);
        let last = self.pointwise(&head.at_4);
        let points = self.wide(&head.at_2).rectified_into(&last, &Source::doubled(&x), &self.buffers);
        self.buffers.give(x.data);
        points
    }

    /// As [`Fusion::forward`], but both `coarse` and the result still wait to be doubled.
    fn fuse(&self, fusion: &Fusion, coarse: Option<Image>, mut fine: Image) -> Image {
        if let Some(coarse) = coarse {
            self.refine(&fusion.resConfUnit1, &mut fine);
            fine.add_doubled(&coarse);
            self.buffers.give(coarse.data);
        }
        self.refine(&fusion.resConfUnit2, &mut fine);
        self.conv1x1(&fusion.out_conv, fine)
    }

    fn refine(&self, unit: &ResidualConvUnit, x: &mut Image) {
        let h = self.wide(&unit.conv1).run(&Source::rectified(x), &self.buffers);
        self.wide(&unit.conv2).add_to(x, &Source::rectified(&h), &self.buffers);
        self.buffers.give(h.data);
    }

    fn enlarge(&self, layers: &Enlarge, x: Image) -> Image {
        let x = self.conv1x1(&layers.at_0, x);
        let [inputs, outputs, stride, _] = layers.at_1.weight.dims();
        let weight = layers.at_1.weight.val().into_data();
        let bias = bias(layers.at_1.bias.as_ref(), outputs);
        let layer = Pointwise::enlarging(slice(&weight), &bias, [inputs, outputs], stride, &self.buffers);
        let places = layer.run(&x, &self.buffers);
        let out = places.shuffle(stride, outputs, &self.buffers);
        [x, places].into_iter().for_each(|image| self.buffers.give(image.data));
        out
    }

    fn halve(&self, conv: &Conv2d, x: Image) -> Image {
        let (weight, bias, channels) = parameters(conv);
        let unfolded = x.unfold(&self.buffers);
        let out =
            Pointwise::halving(slice(&weight), &bias, channels, &self.buffers).run(&unfolded, &self.buffers);
        [x, unfolded].into_iter().for_each(|image| self.buffers.give(image.data));
        out
    }

    fn conv1x1(&self, conv: &Conv2d, x: Image) -> Image {
        let out = self.pointwise(conv).run(&x, &self.buffers);
        self.buffers.give(x.data);
        out
    }

    fn conv3x3(&self, conv: &Conv2d, x: Image) -> Image {
        let out = self.wide(conv).run(&Source::plain(&x), &self.buffers);
        self.buffers.give(x.data);
        out
    }

    fn pointwise(&self, conv: &Conv2d) -> Pointwise {
        let (weight, bias, channels) = parameters(conv);
        Pointwise::new(slice(&weight), &bias, channels, &self.buffers)
    }

    fn wide(&self, conv: &Conv2d) -> Conv3x3 {
        let (weight, bias, channels) = parameters(conv);
        Conv3x3::new(slice(&weight), &bias, channels, &self.buffers)
    }
}

/// Weight, bias, inputs and outputs.
fn parameters(conv: &Conv2d) -> (TensorData, Vec<f32>, [usize; 2]) {
    let weight = conv.weight.val();
    let [outputs, inputs, ..] = weight.dims();
    (weight.into_data(), bias(conv.bias.as_ref(), outputs), [inputs, outputs])
}

/// Zeros if there is none.
fn bias(bias: Option<&Param<Tensor<1>>>, outputs: usize) -> Vec<f32> {
    bias.map_or_else(|| vec![0.0; outputs], |bias| slice(&bias.val().into_data()).to_vec())
}

/// Of parameters, a vector would be a second copy.
fn slice(data: &TensorData) -> &[f32] {
    data.as_slice().expect("all tensors here are f32")
}
