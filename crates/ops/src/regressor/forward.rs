//! The forward pass: features from the input, and the tape for the backward pass.

use rayon::prelude::*;

use super::layout::{Conv as Place, Network, Norm, Residual, Step};
use super::{BRANCH_SCALE, FEATURES, INPUT_CHANNELS};
use crate::buffers::Floats;
use crate::fused::{Affine, CHANNELS, Conv, GroupStatistics, Moments, Plane, Shortcut, Source, arrange};

/// Pixels that are copied at once.
const TASK: usize = 4096;

/// The tape without the input: as many values per image as 16 planes of full size, with 64 bytes per pixel each.
#[derive(Debug, Clone)]
pub struct Saved(pub(super) Vec<Sample>);

/// One image's part of the tape.
#[derive(Debug, Clone, Default)]
pub(super) struct Sample {
    /// Plane i + 1 is the output of step i. Plane 0, the input, stays empty.
    pub planes: Vec<Option<Plane>>,
    /// The plane between the two convolutions of a residual block, by the block's step.
    pub hidden: Vec<Option<Plane>>,
    /// Statistics per normalisation.
    pub layers: Vec<GroupStatistics>,
}

impl Sample {
    pub fn plane(&self, index: usize) -> &Plane {
        self.planes[index].as_ref().expect("a plane outlives its readers")
    }
}

impl Network {
    /// The features `[B, H, W, 14]`, before activation, of `input` `[B, H, W, 6]`, H and W multiples of 4, with
    /// `parameters` in the order of [`Network::names`]. `keep`: the tape for [`Network::backward`] is kept. Without
    /// `keep`, planes are released after their last reader, and images are computed one after another.
    ///
    /// # Panics
    /// If lengths and sizes do not fit.
    pub fn forward(
        &self,
        parameters: &[f32],
        input: &[f32],
        [b, h, w]: [usize; 3],
        keep: bool,
    ) -> (Vec<f32>, Option<Saved>) {
        assert!(h % 4 == 0 && w % 4 == 0, "regressor input {h}×{w}: both sides must be multiples of 4");
        assert_eq!(parameters.len(), self.parameters());
        assert_eq!(input.len(), b * h * w * INPUT_CHANNELS);
        let mut features = vec![0.0; b * h * w * FEATURES];
        let last_readers = if keep { Vec::new() } else { self.last_readers() };
        let run = |(input, features): (&[f32], &mut [f32])| {
            let sample = Sample::default();
            let mut pass = Pass { network: self, parameters, sample, last_readers: &last_readers };
            let out = pass.run(pad::<INPUT_CHANNELS>(input, [h, w]));
            cut::<FEATURES>(&out.data, features);
            pass.sample
        };
        let [inputs, outputs] = [INPUT_CHANNELS, FEATURES].map(|channels| h * w * channels);
        let samples: Vec<Sample> = if keep {
            input.par_chunks_exact(inputs).zip(features.par_chunks_exact_mut(outputs)).map(run).collect()
        } else {
            input.chunks_exact(inputs).zip(features.chunks_exact_mut(outputs)).map(run).collect()
        };
        (features, keep.then_some(Saved(samples)))
    }
}

/// `[h, w, N]` → plane with 0 in the other channels.
pub(super) fn pad<const N: usize>(values: &[f32], [height, width]: [usize; 2]) -> Plane {
    let mut data = Floats::new(height * width * CHANNELS);
    let pixels = data.as_chunks_mut::<CHANNELS>().0.par_iter_mut().zip(values.as_chunks::<N>().0);
    pixels.with_min_len(TASK).for_each(|(pixel, values)| {
        *pixel = std::array::from_fn(|c| if c < N { values[c] } else { 0.0 });
    });
    Plane { height, width, data, moments: Moments::default() }
}

/// The first channels of a plane, `[h, w, N]`.
pub(super) fn cut<const N: usize>(plane: &[f32], out: &mut [f32]) {
    let pixels = out.as_chunks_mut::<N>().0.par_iter_mut().zip(plane.as_chunks::<CHANNELS>().0);
    pixels.with_min_len(TASK).for_each(|(out, pixel)| out.copy_from_slice(&pixel[..N]));
}

/// Weight and bias in the kernels' order.
pub(super) fn arranged(place: &Place, parameters: &[f32]) -> (Vec<f32>, [f32; CHANNELS]) {
    let mut bias = [0.0; CHANNELS];
    bias[..place.shape[0]].copy_from_slice(&parameters[place.bias.clone()]);
    (arrange(&parameters[place.weight.clone()], place.shape), bias)
}

/// A 3×3 convolution and the 1×1 convolution that follows it directly, as one convolution.
pub(super) fn compose(first: &Place, second: &Place, parameters: &[f32]) -> (Vec<f32>, [f32; CHANNELS]) {
    let (first, first_bias) = arranged(first, parameters);
    let (second, second_bias) = arranged(second, parameters);
    let (matrix, _) = second.as_chunks::<CHANNELS>();
    let apply = |x: &[f32; CHANNELS]| -> [f32; CHANNELS] {
        let sum = |o: usize| (0..CHANNELS).map(|i| f64::from(x[i]) * f64::from(matrix[i][o])).sum::<f64>();
        std::array::from_fn(|o| sum(o) as f32)
    };
    let weights = first.as_chunks::<CHANNELS>().0.iter().flat_map(apply).collect();
    let bias = apply(&first_bias);
    (weights, std::array::from_fn(|o| bias[o] + second_bias[o]))
}

struct Pass<'a> {
    network: &'a Network,
    parameters: &'a [f32],
    sample: Sample,
    /// The last step that reads each plane; empty if planes are kept.
    last_readers: &'a [usize],
}

impl Pass<'_> {
    /// Releases the planes that no step after `step` reads.
    fn release(&mut self, step: usize) {
        for (plane, last) in self.sample.planes.iter_mut().zip(self.last_readers) {
            if *last <= step {
                *plane = None;
            }
        }
    }

    fn run(&mut self, input: Plane) -> Plane {
        self.sample.planes.push(Some(input));
        for (i, step) in self.network.steps.iter().enumerate() {
            let (plane, hidden) = match step {
                Step::Convolve { conv, from, stride, enlarge } => {
                    (self.plain(conv, *from, *stride, *enlarge), None)
                }
                Step::Residual { block, from, skip } => {
                    let inputs: Vec<usize> = [*from].into_iter().chain(*skip).collect();
                    let hidden = self.first(block, &inputs);
                    (self.second(block, &inputs, &hidden), Some(hidden))
                }
            };
            self.sample.planes.push(Some(plane));
            if self.last_readers.is_empty() {
                self.sample.hidden.push(hidden);
            } else {
                self.release(i);
            }
            // The caller has the input, so the tape does not keep it.
            self.sample.planes[0] = None;
        }
        let last = self.network.steps.len();
        let affine = self.normalise(&self.network.norm_out, &[last], None)[0];
        let (weights, bias) = compose(&self.network.conv_out, &self.network.gs_conv, self.parameters);
        let sources = [Source { plane: self.sample.plane(last), affine: Some(affine) }];
        let (stride, enlarge, shortcut) = (1, false, Shortcut::None);
        let out =
            Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut, scale: 1.0 }.run();
        self.release(last);
        out
    }

    /// A convolution without normalisation or shortcut.
    fn plain(&self, conv: &Place, from: usize, stride: usize, enlarge: bool) -> Plane {
        let (weights, bias) = arranged(conv, self.parameters);
        let sources = [Source { plane: self.sample.plane(from), affine: None }];
        let shortcut = Shortcut::None;
        Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut, scale: 1.0 }.run()
    }

    /// The first convolution of a residual block.
    fn first(&mut self, block: &Residual, inputs: &[usize]) -> Plane {
        let affines = self.normalise(&block.norm1, inputs, None);
        let source = |(&i, affine)| Source { plane: self.sample.plane(i), affine: Some(affine) };
        let sources: Vec<_> = inputs.iter().zip(affines).map(source).collect();
        let (weights, bias) = arranged(&block.conv1, self.parameters);
        let (stride, enlarge, shortcut) = (1, false, Shortcut::None);
        Conv { sources: &sources, weights: &weights, bias, stride, enlarge, shortcut, scale: 1.0 }.run()
    }

    /// The second convolution of a residual block, and its shortcut.
    fn second(&mut self, block: &Residual, inputs: &[usize], hidden: &Plane) -> Plane {
        let affine = self.normalise(&block.norm2, &[], Some(hidden))[0];
        let (weights, mut bias) = arranged(&block.conv2, self.parameters);
        let projection = block.shortcut.as_ref().map(|conv| arranged(conv, self.parameters));
        let planes: Vec<_> = inputs.iter().map(|&i| self.sample.plane(i)).collect();
        let shortcut = match &projection {
            Some((weights, added)) => {
                bias.iter_mut().zip(added).for_each(|(b, a)| *b += a);
                Shortcut::Project(&planes, weights)
            }
            None => Shortcut::Identity(planes[0]),
        };
        let sources = [Source { plane: hidden, affine: Some(affine) }];
        let scale = BRANCH_SCALE as f32;
        Conv { sources: &sources, weights: &weights, bias, stride: 1, enlarge: false, shortcut, scale }.run()
    }

    /// Affine maps of the group normalisation of planes of the tape and of `hidden`, which is not on the tape yet.
    fn normalise(&mut self, norm: &Norm, inputs: &[usize], hidden: Option<&Plane>) -> Vec<Affine> {
        let planes: Vec<_> = inputs.iter().map(|&i| self.sample.plane(i)).chain(hidden).collect();
        let group_norm = self.network.norm(norm, self.parameters);
        let layer = group_norm.measure(&planes);
        let affines = group_norm.affines(&layer);
        self.sample.layers.push(layer);
        affines
    }
}
