//! The backward pass: gradients of parameters and input from the gradient of the features.

use rayon::prelude::*;

use super::forward::{Sample, Saved, arranged, compose, cut, pad};
use super::layout::{Conv as Place, Network, Norm, Residual, Step};
use super::{BRANCH_SCALE, FEATURES, INPUT_CHANNELS};
use crate::buffers::Floats;
use crate::fused::{
    Backward, Branch, CHANNELS, GradientSums, Gradients, Linear, Merge, Needed, Plane, Source, Upstream, add,
    arrange, rearrange, transpose,
};

impl Network {
    /// Gradients of Σ features · `upstream` `[B, H, W, 14]`, with the parameters and the input of the forward pass: of
    /// the input `[B, H, W, 6]`, and of the parameters in the order of [`Network::names`]; `None` for unwanted ones.
    ///
    /// # Panics
    /// If lengths do not fit the forward pass.
    pub fn backward(
        &self,
        parameters: &[f32],
        input: &[f32],
        saved: Saved,
        upstream: &[f32],
        wanted: Needed,
    ) -> [Option<Vec<f32>>; 2] {
        let count = saved.0.len().max(1);
        let (inputs, features) = (input.len() / count, upstream.len() / count);
        let run = |(i, sample): (usize, Sample)| {
            let mut pass = Pass {
                network: self,
                parameters,
                wanted,
                gradients: vec![None; sample.planes.len()],
                sample,
                sums: vec![0.0; if wanted.parameters { self.parameters() } else { 0 }],
            };
            pass.run(&input[i * inputs..][..inputs], &upstream[i * features..][..features]);
            (pass.gradients.swap_remove(0), pass.sums)
        };
        let parts: Vec<_> = saved.0.into_par_iter().enumerate().map(run).collect();
        let mut sums = vec![0.0; self.parameters()];
        let mut gradient = vec![0.0; if wanted.input { input.len() } else { 0 }];
        // Added in the order of the images, for the same bits with any number of threads.
        for (i, (plane, part)) in parts.into_iter().enumerate() {
            sums.iter_mut().zip(part).for_each(|(sum, g)| *sum += g);
            if let Some(plane) = plane {
                cut::<INPUT_CHANNELS>(&plane, &mut gradient[i * inputs..][..inputs]);
            }
        }
        let parameters = wanted.parameters.then(|| sums.iter().map(|&sum| sum as f32).collect());
        [wanted.input.then_some(gradient), parameters]
    }
}

struct Pass<'a> {
    network: &'a Network,
    parameters: &'a [f32],
    sample: Sample,
    wanted: Needed,
    /// Gradients of the tape's planes, summed over the readers that are done.
    gradients: Vec<Option<Floats>>,
    /// Gradients of the parameters.
    sums: Vec<f64>,
}

impl Pass<'_> {
    fn run(&mut self, input: &[f32], upstream: &[f32]) {
        let network = self.network;
        let size = [self.sample.plane(1).height, self.sample.plane(1).width];
        assert_eq!(input.len(), size[0] * size[1] * INPUT_CHANNELS);
        assert_eq!(upstream.len(), size[0] * size[1] * FEATURES);
        self.last(&pad::<FEATURES>(upstream, size).data);
        for (i, step) in network.steps.iter().enumerate().rev() {
            let upstream = self.gradients[i + 1].take().expect("every plane has a reader");
            self.sample.planes[i + 1] = None;
            match step {
                Step::Convolve { conv, from, stride, enlarge } => {
                    if *from == 0 {
                        self.sample.planes[0] = Some(pad::<INPUT_CHANNELS>(input, size));
                    }
                    self.plain(conv, *from, *stride, *enlarge, &upstream);
                }
                Step::Residual { block, from, skip } => {
                    let hidden = self.sample.hidden[i].take().expect("one per block");
                    let inputs: Vec<usize> = [*from].into_iter().chain(*skip).collect();
                    self.residual(block, &inputs, hidden, &upstream);
                }
            }
        }
    }

    /// The last normalisation, SiLU and the two convolutions after it.
    fn last(&mut self, upstream: &[f32]) {
        let network = self.network;
        let (weights, _) = compose(&network.conv_out, &network.gs_conv, self.parameters);
        let index = network.steps.len();
        let plane = self.sample.planes[index].take().expect("the last plane");
        let gradients =
            self.normalised(&network.norm_out, &[&plane], &weights, Upstream::Scaled(upstream, 1.0));
        let maps = self.norm(&network.norm_out, &[&plane], &gradients.sums);
        if self.wanted.parameters {
            self.split(&gradients);
        }
        let mut gradient = gradients.inputs.into_iter().next().expect("one source");
        let merge =
            Merge { plane: &plane.data, map: &maps[0], shortcut: None, other: None, parameters: false };
        merge.run(&mut gradient);
        self.gradients[index] = Some(gradient);
        self.sample.planes[index] = Some(plane);
    }

    /// Gradients of the last two convolutions from the gradients of their composition.
    fn split(&mut self, gradients: &Gradients) {
        let (first, second) = (&self.network.conv_out, &self.network.gs_conv);
        let (first_weights, first_bias) = arranged(first, self.parameters);
        let (matrix, _) = arranged(second, self.parameters);
        let matrix = matrix.as_chunks::<CHANNELS>().0;
        let composed = gradients.weights.as_chunks::<CHANNELS>().0;
        // Rows of the first convolution: the input channels of every tap, and the bias.
        let rows = first_weights.as_chunks::<CHANNELS>().0.iter().chain([&first_bias]);
        let mut of_first = Vec::with_capacity(gradients.weights.len() + CHANNELS);
        let mut of_second = vec![0.0; CHANNELS * CHANNELS];
        for (row, gradient) in rows.zip(composed.iter().chain([&gradients.bias])) {
            for middle in 0..CHANNELS {
                let products = gradient.iter().zip(&matrix[middle]).map(|(g, m)| g * f64::from(*m));
                of_first.push(products.sum::<f64>());
                let out = &mut of_second[middle * CHANNELS..][..CHANNELS];
                out.iter_mut().zip(gradient).for_each(|(out, g)| *out += f64::from(row[middle]) * g);
            }
        }
        let bias: [f64; CHANNELS] = std::array::from_fn(|o| of_first[gradients.weights.len() + o]);
        self.conv(first, &of_first[..gradients.weights.len()], &bias);
        self.conv(second, &of_second, &gradients.bias);
    }

    /// A convolution without normalisation or shortcut.
    fn plain(&mut self, place: &Place, from: usize, stride: usize, enlarge: bool, upstream: &[f32]) {
        let plane = self.sample.planes[from].take().expect("a plane outlives its readers");
        let (weights, _) = arranged(place, self.parameters);
        let wanted = Needed { input: self.wanted.input || from > 0, ..self.wanted };
        let sources = &[Source { plane: &plane, affine: None }];
        let upstream = Upstream::Scaled(upstream, 1.0);
        let gradients = Backward { sources, weights: &weights, upstream, stride, enlarge, wanted }.run();
        self.conv(place, &gradients.weights, &gradients.bias);
        if let Some(mut gradient) = gradients.inputs.into_iter().next() {
            if let Some(other) = self.gradients[from].take() {
                add(&mut gradient, &other);
            }
            self.gradients[from] = Some(gradient);
        }
        self.sample.planes[from] = Some(plane);
    }

    fn residual(&mut self, block: &Residual, inputs: &[usize], hidden: Plane, upstream: &[f32]) {
        let scale = BRANCH_SCALE as f32;
        let (weights, _) = arranged(&block.conv2, self.parameters);
        let second = self.normalised(&block.norm2, &[&hidden], &weights, Upstream::Scaled(upstream, scale));
        self.conv(&block.conv2, &second.weights, &second.bias);
        let map = self.norm(&block.norm2, &[&hidden], &second.sums)[0];

        let taken =
            inputs.iter().map(|&i| self.sample.planes[i].take().expect("a plane outlives its readers"));
        let taken: Vec<Plane> = taken.collect();
        let planes: Vec<&Plane> = taken.iter().collect();
        let (weights, _) = arranged(&block.conv1, self.parameters);
        let behind = Upstream::Normalised(&second.inputs[0], &hidden.data, &map);
        let first = self.normalised(&block.norm1, &planes, &weights, behind);
        self.conv(&block.conv1, &first.weights, &first.bias);
        let maps = self.norm(&block.norm1, &planes, &first.sums);
        drop((hidden, second.inputs));

        let matrices = block
            .shortcut
            .as_ref()
            .map(|place| transpose(&arrange(&self.parameters[place.weight.clone()], place.shape)));
        let mut projected = Vec::new();
        for (k, mut gradient) in first.inputs.into_iter().enumerate() {
            let size = CHANNELS * CHANNELS;
            let projection = matrices.as_ref().map(|matrices| &matrices[k * size..(k + 1) * size]);
            let other = self.gradients[inputs[k]].take();
            let merge = Merge {
                plane: &planes[k].data,
                map: &maps[k],
                shortcut: Some(Branch { upstream, scale, projection }),
                other: other.as_deref(),
                parameters: self.wanted.parameters,
            };
            projected.extend(merge.run(&mut gradient));
            self.gradients[inputs[k]] = Some(gradient);
        }
        if let Some(place) = &block.shortcut {
            self.conv(place, &projected, &second.bias);
        }
        for (&i, plane) in inputs.iter().zip(taken) {
            self.sample.planes[i] = Some(plane);
        }
    }

    /// The backward pass of a convolution of normalised and activated planes.
    fn normalised(&self, norm: &Norm, planes: &[&Plane], weights: &[f32], upstream: Upstream) -> Gradients {
        let affines = self.network.norm(norm, self.parameters).affines(&self.sample.layers[norm.index]);
        let pairs = planes.iter().zip(affines);
        let sources: Vec<_> = pairs.map(|(&plane, affine)| Source { plane, affine: Some(affine) }).collect();
        let wanted = Needed { input: true, ..self.wanted };
        Backward { sources: &sources, weights, upstream, stride: 1, enlarge: false, wanted }.run()
    }

    /// Adds a normalisation's gradients to the sums. Returns the maps to the planes' gradients.
    fn norm(&mut self, norm: &Norm, planes: &[&Plane], sums: &[GradientSums]) -> Vec<Linear> {
        let group_norm = self.network.norm(norm, self.parameters);
        let ([gamma, beta], maps) = group_norm.backward(&self.sample.layers[norm.index], planes, sums);
        if self.wanted.parameters {
            let add = |(sum, g): (&mut f64, &f64)| *sum += g;
            self.sums[norm.gamma.clone()].iter_mut().zip(&gamma).for_each(add);
            self.sums[norm.beta.clone()].iter_mut().zip(&beta).for_each(add);
        }
        maps
    }

    /// Adds a convolution's gradients, which are in the kernels' order, to the sums.
    fn conv(&mut self, place: &Place, weights: &[f64], bias: &[f64]) {
        if self.wanted.parameters {
            rearrange(weights, place.shape, &mut self.sums[place.weight.clone()]);
            self.sums[place.bias.clone()].iter_mut().zip(bias).for_each(|(sum, g)| *sum += g);
        }
    }
}
