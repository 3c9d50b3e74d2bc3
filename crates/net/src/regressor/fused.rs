//! The regressor over the fused convolutions of [`snapsnap_ops::conv`].

use burn::nn::GroupNorm;
use burn::nn::conv::Conv2d;
use burn::tensor::{Tensor, TensorData};

use snapsnap_ops::conv::{Affine, CHANNELS, Conv, Moments, Plane, Shortcut, Source};
use snapsnap_ops::host;

use super::statistics::Statistics;
use super::unet::{BRANCH_SCALE, ResBlock, UNet};

/// Input `[B, 6, H, W]` → features `[B, H, W, 14]`: `unet`, then the 1×1 convolution `last`.
pub fn regress(unet: &UNet, last: &Conv2d, input: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
    let ([b, channels, h, w], device) = (input.dims(), input.device());
    let features_count = last.weight.dims()[0];
    let values = host(input);
    let mut features: Vec<f32> = Vec::with_capacity(b * h * w * features_count);
    let mut layers: Vec<[Vec<f32>; 2]> = Vec::new();
    for sample in 0..b {
        let mut pass = Pass { frozen: statistics.of_sample(sample), layers: Vec::new() };
        let planar = &values[sample * channels * h * w..(sample + 1) * channels * h * w];
        let out = pass.run(unet, last, interleave(planar, channels, [h, w]));
        features.extend(out.data.as_chunks::<CHANNELS>().0.iter().flat_map(|pixel| &pixel[..features_count]));
        layers.resize_with(pass.layers.len(), Default::default);
        for (all, [mean, rstd]) in layers.iter_mut().zip(pass.layers) {
            all[0].extend(mean);
            all[1].extend(rstd);
        }
    }
    statistics.record(layers.into_iter().map(|layer| {
        layer.map(|values| {
            let groups = values.len() / b;
            Tensor::from_data(TensorData::new(values, [b, groups]), &device)
        })
    }));
    Tensor::from_data(TensorData::new(features, [b, h, w, features_count]), &device)
}

/// `[channels, h, w]` → plane, the other channels 0.
fn interleave(planar: &[f32], channels: usize, [height, width]: [usize; 2]) -> Plane {
    let mut data = vec![0.0; height * width * CHANNELS];
    for c in 0..channels {
        for (pixel, value) in data.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(&planar[c * height * width..])
        {
            pixel[c] = *value;
        }
    }
    Plane { height, width, data, moments: Moments::default() }
}

/// A PyTorch convolution weight `[out, in, k, k]` as `[source][k][k][16][16]`, absent channels 0.
fn arrange(conv: &Conv2d) -> (Vec<f32>, [f32; CHANNELS]) {
    let weight = conv.weight.val();
    let [out, inputs, kh, kw] = weight.dims();
    let values = host(weight);
    let taps = kh * kw;
    let mut arranged = vec![0.0; inputs.div_ceil(CHANNELS) * taps * CHANNELS * CHANNELS];
    for (o, i, tap) in (0..out).flat_map(|o| (0..inputs).flat_map(move |i| (0..taps).map(move |t| (o, i, t))))
    {
        let at = ((i / CHANNELS * taps + tap) * CHANNELS + i % CHANNELS) * CHANNELS + o;
        arranged[at] = values[(o * inputs + i) * taps + tap];
    }
    let mut bias = [0.0; CHANNELS];
    bias[..out].copy_from_slice(&host(conv.bias.as_ref().expect("all of them have a bias").val()));
    (arranged, bias)
}

struct Pass {
    /// Statistics to use instead of measured ones.
    frozen: Option<Vec<[Vec<f32>; 2]>>,
    /// Mean and reciprocal standard deviation of every group, layer after layer.
    layers: Vec<[Vec<f32>; 2]>,
}

impl Pass {
    fn run(&mut self, net: &UNet, last: &Conv2d, input: Plane) -> Plane {
        let mut x = plain(&net.conv_in, &input, 1, false);
        drop(input);
        let mut skips = Vec::new();
        for block in &net.down_blocks {
            for res in &block.nets {
                let next = self.residual(res, &[&x]);
                skips.push(std::mem::replace(&mut x, next));
            }
            if let Some(down) = &block.downsample {
                let next = plain(down, &x, 2, false);
                skips.push(std::mem::replace(&mut x, next));
            }
        }
        skips.push(x.clone());
        for res in &net.mid_block.nets {
            x = self.residual(res, &[&x]);
        }
        for block in &net.up_blocks {
            for res in &block.nets {
                let skip = skips.pop().expect("as many skips as up blocks consume");
                x = self.residual(res, &[&x, &skip]);
            }
            if let Some(up) = &block.upsample {
                x = plain(up, &x, 1, true);
            }
        }
        let affine = self.normalise(&net.norm_out, &[&x]);
        let (weights, bias) = compose(&net.conv_out, last);
        Conv {
            sources: &[Source { plane: &x, affine: Some(affine[0]) }],
            weights: &weights,
            bias,
            stride: 1,
            enlarge: false,
            shortcut: Shortcut::None,
            scale: 1.0,
        }
        .run()
    }

    fn residual(&mut self, block: &ResBlock, inputs: &[&Plane]) -> Plane {
        let affines = self.normalise(&block.norm1, inputs);
        let sources: Vec<_> = inputs
            .iter()
            .zip(affines)
            .map(|(plane, affine)| Source { plane, affine: Some(affine) })
            .collect();
        let (weights, bias) = arrange(&block.conv1);
        let (stride, enlarge) = (1, false);
        let shortcut = Shortcut::None;
        let hidden =
            Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut, scale: 1.0 }.run();

        let affine = self.normalise(&block.norm2, &[&hidden])[0];
        let (weights, mut bias) = arrange(&block.conv2);
        let projection = block.shortcut.as_ref().map(arrange);
        let shortcut = match &projection {
            Some((weights, added)) => {
                bias.iter_mut().zip(added).for_each(|(b, a)| *b += a);
                Shortcut::Project(inputs, weights)
            }
            None => Shortcut::Identity(inputs[0]),
        };
        let sources = [Source { plane: &hidden, affine: Some(affine) }];
        let scale = BRANCH_SCALE as f32;
        Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut, scale }.run()
    }

    /// The group normalisation of the stacked planes as one affine map per plane.
    fn normalise(&mut self, norm: &GroupNorm, planes: &[&Plane]) -> Vec<Affine> {
        let per_group = planes.len() * CHANNELS / norm.num_groups;
        let channel = |i: usize| {
            let moments = &planes[i / CHANNELS].moments;
            (moments.mean[i % CHANNELS], moments.squares[i % CHANNELS])
        };
        let count = planes[0].moments.count;
        let layer = match &self.frozen {
            Some(frozen) => frozen[self.layers.len()].clone(),
            None => {
                let group = |g: usize| {
                    let members = || (g * per_group..(g + 1) * per_group).map(channel);
                    let mean = members().map(|(mean, _)| mean).sum::<f64>() / per_group as f64;
                    let squares: f64 =
                        members().map(|(m, squares)| squares + count * (m - mean).powi(2)).sum();
                    let variance = squares / (count * per_group as f64);
                    (mean as f32, (variance + norm.epsilon).sqrt().recip() as f32)
                };
                let (mean, rstd) = (0..norm.num_groups).map(group).unzip();
                [mean, rstd]
            }
        };
        let affine = |p: &Option<burn::module::Param<Tensor<1>>>| {
            host(p.as_ref().expect("the published group norms are affine").val())
        };
        let (gamma, beta) = (affine(&norm.gamma), affine(&norm.beta));
        let affine = |plane: usize| {
            let index = |c: usize| plane * CHANNELS + c;
            let scale: [f32; CHANNELS] =
                std::array::from_fn(|c| layer[1][index(c) / per_group] * gamma[index(c)]);
            let shift = std::array::from_fn(|c| beta[index(c)] - layer[0][index(c) / per_group] * scale[c]);
            [scale, shift]
        };
        let affines = (0..planes.len()).map(affine).collect();
        self.layers.push(layer);
        affines
    }
}

/// A convolution without normalisation or shortcut.
fn plain(conv: &Conv2d, plane: &Plane, stride: usize, enlarge: bool) -> Plane {
    let (weights, bias) = arrange(conv);
    let sources = [Source { plane, affine: None }];
    Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut: Shortcut::None, scale: 1.0 }
        .run()
}

/// A 3×3 convolution followed by a 1×1 convolution, as one: nothing lies between the two.
fn compose(first: &Conv2d, second: &Conv2d) -> (Vec<f32>, [f32; CHANNELS]) {
    let ((first, first_bias), (second, second_bias)) = (arrange(first), arrange(second));
    let (matrix, _) = second.as_chunks::<CHANNELS>();
    let apply = |x: &[f32; CHANNELS]| -> [f32; CHANNELS] {
        let sum = |o: usize| (0..CHANNELS).map(|i| f64::from(x[i]) * f64::from(matrix[i][o])).sum::<f64>();
        std::array::from_fn(|o| sum(o) as f32)
    };
    let weights = first.as_chunks::<CHANNELS>().0.iter().flat_map(apply).collect();
    let bias = apply(&first_bias);
    (weights, std::array::from_fn(|o| bias[o] + second_bias[o]))
}
