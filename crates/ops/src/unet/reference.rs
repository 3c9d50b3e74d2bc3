//! The network and its gradient in f64, one plain loop per operator: what the fused passes are held to.

use super::layout::{Conv, Network, Norm, Residual, Step};
use super::{BRANCH_SCALE, EPSILON, FEATURES, INPUT_CHANNELS};

/// Values `[channels, height, width]`.
#[derive(Clone)]
struct Image {
    size: [usize; 3],
    values: Vec<f64>,
}

impl Image {
    fn zeros(size: [usize; 3]) -> Self {
        Self { size, values: vec![0.0; size.iter().product()] }
    }

    fn zip(&self, other: &Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let values = self.values.iter().zip(&other.values).map(|(a, b)| f(*a, *b)).collect();
        Self { size: self.size, values }
    }

    fn map(&self, f: impl Fn(f64) -> f64) -> Self {
        self.zip(self, |x, _| f(x))
    }

    fn stack(mut self, other: &Self) -> Self {
        self.size[0] += other.size[0];
        self.values.extend(&other.values);
        self
    }

    /// The first `channels` channels and the rest.
    fn split(&self, channels: usize) -> [Self; 2] {
        let [c, h, w] = self.size;
        let (first, rest) = self.values.split_at(channels * h * w);
        [
            Self { size: [channels, h, w], values: first.to_vec() },
            Self { size: [c - channels, h, w], values: rest.to_vec() },
        ]
    }

    fn enlarge(&self) -> Self {
        let [c, h, w] = self.size;
        let mut out = Self::zeros([c, 2 * h, 2 * w]);
        for (i, value) in out.values.iter_mut().enumerate() {
            let (channel, y, x) = (i / (4 * h * w), i / (2 * w) % (2 * h), i % (2 * w));
            *value = self.values[(channel * h + y / 2) * w + x / 2];
        }
        out
    }

    fn shrink(&self) -> Self {
        let [c, h, w] = self.size;
        let mut out = Self::zeros([c, h / 2, w / 2]);
        for (i, value) in self.values.iter().enumerate() {
            let (channel, y, x) = (i / (h * w), i / w % h, i % w);
            out.values[(channel * (h / 2) + y / 2) * (w / 2) + x / 2] += value;
        }
        out
    }
}

fn silu(x: f64) -> f64 {
    x / (1.0 + (-x).exp())
}

fn slope(x: f64) -> f64 {
    let sigmoid = (1.0 + (-x).exp()).recip();
    sigmoid * (1.0 + x * (1.0 - sigmoid))
}

/// One normalisation's input, mean and reciprocal standard deviation per group.
#[derive(Clone)]
struct Normalised {
    input: Image,
    mean: Vec<f64>,
    rstd: Vec<f64>,
}

/// One image's passes.
pub struct Reference<'a> {
    network: &'a Network,
    parameters: &'a [f64],
    /// Statistics per normalisation, if they are not to be measured.
    frozen: Option<Vec<[Vec<f64>; 2]>>,
    planes: Vec<Image>,
    norms: Vec<Option<Normalised>>,
    /// Of the parameters.
    pub gradient: Vec<f64>,
}

impl<'a> Reference<'a> {
    pub fn new(network: &'a Network, parameters: &'a [f64], frozen: Option<Vec<[Vec<f64>; 2]>>) -> Self {
        let gradient = vec![0.0; parameters.len()];
        Self { network, parameters, frozen, planes: Vec::new(), norms: vec![None; 64], gradient }
    }

    /// `[h, w, 6]` → `[h, w, 14]`.
    pub fn forward(&mut self, input: &[f64], [h, w]: [usize; 2]) -> Vec<f64> {
        let mut image = Image::zeros([INPUT_CHANNELS, h, w]);
        for (i, value) in input.iter().enumerate() {
            image.values[i % INPUT_CHANNELS * h * w + i / INPUT_CHANNELS] = *value;
        }
        self.planes = vec![image];
        let network = self.network;
        for step in &network.steps {
            let out = match step {
                Step::Convolve { conv, from, stride, enlarge } => {
                    self.conv(conv, &self.read(*from, *enlarge), *stride)
                }
                Step::Residual { block, from, skip } => {
                    let x = self.gather(*from, *skip);
                    let h = self.normalise(&block.norm1, &x).map(silu);
                    let h = self.normalise(&block.norm2, &self.conv(&block.conv1, &h, 1)).map(silu);
                    let x = block.shortcut.as_ref().map_or(x.clone(), |conv| self.conv(conv, &x, 1));
                    self.conv(&block.conv2, &h, 1).zip(&x, |a, b| (a + b) * BRANCH_SCALE)
                }
            };
            self.planes.push(out);
        }
        let last = self.planes[network.steps.len()].clone();
        let out = self.normalise(&network.norm_out, &last).map(silu);
        let out = self.conv(&network.conv_out, &out, 1);
        self.planes.push(out);
        let out = self.conv(&network.gs_conv, &self.planes[network.steps.len() + 1], 1);
        (0..h * w * FEATURES).map(|i| out.values[i % FEATURES * h * w + i / FEATURES]).collect()
    }

    /// Statistics per normalisation that the last forward pass used.
    pub fn statistics(&self) -> Vec<[Vec<f64>; 2]> {
        self.norms.iter().flatten().map(|norm| [norm.mean.clone(), norm.rstd.clone()]).collect()
    }

    /// Gradient of the input `[h, w, 6]`; adds that of the parameters to `gradient`.
    pub fn backward(&mut self, upstream: &[f64]) -> Vec<f64> {
        let network = self.network;
        let [_, h, w] = self.planes[0].size;
        let mut gradient = Image::zeros([FEATURES, h, w]);
        for (i, value) in upstream.iter().enumerate() {
            gradient.values[i % FEATURES * h * w + i / FEATURES] = *value;
        }
        let mut gradients: Vec<Image> = self.planes.iter().map(|plane| Image::zeros(plane.size)).collect();
        let last = network.steps.len();
        let gradient = self.conv_back(&network.gs_conv, &self.planes[last + 1].clone(), &gradient, 1);
        gradients[last] = self.activated_back(&network.norm_out, &network.conv_out, &gradient);
        for (i, step) in network.steps.iter().enumerate().rev() {
            let upstream = gradients[i + 1].clone();
            match step {
                Step::Convolve { conv, from, stride, enlarge } => {
                    let g = self.conv_back(conv, &self.read(*from, *enlarge), &upstream, *stride);
                    let g = if *enlarge { g.shrink() } else { g };
                    gradients[*from] = gradients[*from].zip(&g, |a, b| a + b);
                }
                Step::Residual { block, from, skip } => {
                    let g = self.residual_back(block, &self.gather(*from, *skip), &upstream);
                    let [first, second] = g.split(self.planes[*from].size[0]);
                    gradients[*from] = gradients[*from].zip(&first, |a, b| a + b);
                    if let Some(skip) = skip {
                        gradients[*skip] = gradients[*skip].zip(&second, |a, b| a + b);
                    }
                }
            }
        }
        let g = &gradients[0].values;
        (0..h * w * INPUT_CHANNELS).map(|i| g[i % INPUT_CHANNELS * h * w + i / INPUT_CHANNELS]).collect()
    }

    fn residual_back(&mut self, block: &Residual, x: &Image, upstream: &Image) -> Image {
        let upstream = upstream.map(|g| g * BRANCH_SCALE);
        let g = self.activated_back(&block.norm2, &block.conv2, &upstream);
        let g = self.activated_back(&block.norm1, &block.conv1, &g);
        let shortcut = match &block.shortcut {
            Some(conv) => self.conv_back(conv, x, &upstream, 1),
            None => upstream,
        };
        g.zip(&shortcut, |a, b| a + b)
    }

    fn read(&self, from: usize, enlarge: bool) -> Image {
        if enlarge { self.planes[from].enlarge() } else { self.planes[from].clone() }
    }

    fn gather(&self, from: usize, skip: Option<usize>) -> Image {
        let x = self.planes[from].clone();
        skip.map_or(x.clone(), |skip| x.stack(&self.planes[skip]))
    }

    /// Every product of a convolution: places in output, input and weight.
    fn products(
        conv: &Conv,
        [_, h, w]: [usize; 3],
        stride: usize,
    ) -> ([usize; 3], impl Iterator<Item = [usize; 3]>) {
        let [out, inputs, taps] = conv.shape;
        let side = taps.isqrt();
        let (rows, columns) = (h.div_ceil(stride), w.div_ceil(stride));
        let places = (0..out * inputs * taps).flat_map(move |weight| {
            let (o, i, tap) = (weight / taps / inputs, weight / taps % inputs, weight % taps);
            (0..rows * columns).filter_map(move |at| {
                let (y, x) = (at / columns * stride + tap / side, at % columns * stride + tap % side);
                let (y, x) = (y.checked_sub(side / 2)?, x.checked_sub(side / 2)?);
                (y < h && x < w).then_some([o * rows * columns + at, (i * h + y) * w + x, weight])
            })
        });
        ([out, rows, columns], places)
    }

    fn conv(&self, conv: &Conv, x: &Image, stride: usize) -> Image {
        let weight = &self.parameters[conv.weight.clone()];
        let (size, products) = Self::products(conv, x.size, stride);
        let mut out = Image::zeros(size);
        for (plane, bias) in out.values.chunks_mut(size[1] * size[2]).zip(&self.parameters[conv.bias.clone()])
        {
            plane.fill(*bias);
        }
        products.for_each(|[o, i, k]| out.values[o] += x.values[i] * weight[k]);
        out
    }

    fn conv_back(&mut self, conv: &Conv, x: &Image, upstream: &Image, stride: usize) -> Image {
        let weight = &self.parameters[conv.weight.clone()];
        let (size, products) = Self::products(conv, x.size, stride);
        let mut out = Image::zeros(x.size);
        for [o, i, k] in products {
            out.values[i] += upstream.values[o] * weight[k];
            self.gradient[conv.weight.start + k] += upstream.values[o] * x.values[i];
        }
        for (o, plane) in upstream.values.chunks(size[1] * size[2]).enumerate() {
            self.gradient[conv.bias.start + o] += plane.iter().sum::<f64>();
        }
        out
    }

    fn normalise(&mut self, norm: &Norm, x: &Image) -> Image {
        let groups = self.network.groups;
        let measured = || {
            let group = |values: &[f64]| {
                let n = values.len() as f64;
                let mean = values.iter().sum::<f64>() / n;
                let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
                (mean, (variance + EPSILON).sqrt().recip())
            };
            let (mean, rstd) = x.values.chunks(x.values.len() / groups).map(group).unzip();
            [mean, rstd]
        };
        let [mean, rstd] = self.frozen.as_ref().map_or_else(measured, |frozen| frozen[norm.index].clone());
        let state = Normalised { input: x.clone(), mean, rstd };
        let out = self.scaled(norm, &state);
        self.norms[norm.index] = Some(state);
        out
    }

    /// Of place `i` of an image: its group and its channel.
    fn group(&self, size: [usize; 3], i: usize) -> [usize; 2] {
        let channel = i / (size[1] * size[2]);
        [channel * self.network.groups / size[0], channel]
    }

    fn scaled(&self, norm: &Norm, state: &Normalised) -> Image {
        let (gamma, beta) = (&self.parameters[norm.gamma.clone()], &self.parameters[norm.beta.clone()]);
        let mut out = state.input.clone();
        for (i, x) in out.values.iter_mut().enumerate() {
            let [group, channel] = self.group(state.input.size, i);
            *x = (*x - state.mean[group]) * state.rstd[group] * gamma[channel] + beta[channel];
        }
        out
    }

    /// Gradient of a normalised, activated and convolved image.
    fn activated_back(&mut self, norm: &Norm, conv: &Conv, upstream: &Image) -> Image {
        let state = self.norms[norm.index].clone().expect("after the forward pass");
        let scaled = self.scaled(norm, &state);
        let g = self.conv_back(conv, &scaled.map(silu), upstream, 1);
        let g = g.zip(&scaled, |g, z| g * slope(z));
        let (size, groups) = (state.input.size, self.network.groups);
        let unit = |i: usize| {
            let [group, _] = self.group(size, i);
            (state.input.values[i] - state.mean[group]) * state.rstd[group]
        };
        let unit: Vec<f64> = (0..g.values.len()).map(unit).collect();
        let gamma: Vec<f64> =
            (0..g.values.len()).map(|i| self.parameters[norm.gamma.start + self.group(size, i)[1]]).collect();
        let mut means = vec![[0.0; 2]; groups];
        for (i, g) in g.values.iter().enumerate() {
            let [group, channel] = self.group(size, i);
            self.gradient[norm.gamma.start + channel] += g * unit[i];
            self.gradient[norm.beta.start + channel] += g;
            means[group][0] += g * gamma[i];
            means[group][1] += g * gamma[i] * unit[i];
        }
        let members = (g.values.len() / groups) as f64;
        let measured = if self.frozen.is_some() { 0.0 } else { 1.0 };
        let mut out = Image::zeros(size);
        for (i, out) in out.values.iter_mut().enumerate() {
            let [group, _] = self.group(size, i);
            let statistics = (means[group][0] + unit[i] * means[group][1]) / members * measured;
            *out = state.rstd[group] * (g.values[i] * gamma[i] - statistics);
        }
        out
    }
}
