//! LPIPS v0.1 on AlexNet (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"):
//! distances between features of two pictures, weighted by learned layers.

use std::path::{Path, PathBuf};

use burn::tensor::activation::relu;
use burn::tensor::module::{conv2d, max_pool2d};
use burn::tensor::ops::{ConvOptions, MaxPoolOptions};
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_net::weights::{Source, WeightsError, not_finite};

/// Least side of a picture in pixels. Of a smaller picture, no pixel is left for the third layer.
pub const MIN_SIDE: usize = 31;

/// File names of the published weights: torchvision's AlexNet and the authors' learned layers.
pub const PUBLISHED: [&str; 2] = ["alexnet-owt-7be5be79.pth", "lpips-alex-v0.1.pth"];
/// Distance between the pictures of [`Lpips::check`], from the authors' package (docs/lpips_reference.py).
const KNOWN: f64 = 0.093_218_468;

/// Shift and divisor of red, green and blue in [−1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the length of a pixel's features.
const EPSILON: f64 = 1e-10;

/// A convolution of torchvision's AlexNet.
struct Layer {
    /// Its index in `features`.
    place: usize,
    /// Outputs, inputs, side of the kernel.
    size: [usize; 3],
    stride: usize,
    padding: usize,
    /// Whether a max pooling of 3×3 pixels with stride 2 precedes it.
    pooled: bool,
}

const LAYERS: [Layer; 5] = [
    Layer { place: 0, size: [64, 3, 11], stride: 4, padding: 2, pooled: false },
    Layer { place: 3, size: [192, 64, 5], stride: 1, padding: 2, pooled: true },
    Layer { place: 6, size: [384, 192, 3], stride: 1, padding: 1, pooled: true },
    Layer { place: 8, size: [256, 384, 3], stride: 1, padding: 1, pooled: false },
    Layer { place: 10, size: [256, 256, 3], stride: 1, padding: 1, pooled: false },
];

impl Layer {
    /// Names and shapes of the layer's weight, bias and learned layer.
    fn tensors((number, Self { place, size, .. }): (usize, &Self)) -> [(String, Vec<usize>); 3] {
        let [outputs, inputs, side] = *size;
        [
            (format!("features.{place}.weight"), vec![outputs, inputs, side, side]),
            (format!("features.{place}.bias"), vec![outputs]),
            (format!("lin{number}.model.1.weight"), vec![1, outputs, 1, 1]),
        ]
    }
}

/// The network and its learned layers, without gradients of their weights.
#[derive(Debug, Clone)]
pub struct Lpips {
    layers: Vec<Parameters>,
}

#[derive(Debug, Clone)]
struct Parameters {
    /// `[D, C, k, k]`.
    weight: Tensor<4>,
    /// `[D]`.
    bias: Tensor<1>,
    /// `[1, D, 1, 1]`.
    linear: Tensor<4>,
}

impl Lpips {
    /// Reads AlexNet (`features.*` without the classifier) and the learned layers (`lin0.model.1.weight` to `lin4…`)
    /// from one or several files with the names of torchvision and the authors.
    ///
    /// # Errors
    /// [`WeightsError`] for files that cannot be read and for tensors that are missing, unknown, given twice or
    /// mis-shaped.
    pub fn load(files: &[PathBuf], device: &Device) -> Result<Self, WeightsError> {
        let sources = files.iter().map(|path| Source::open(path)).collect::<Result<Vec<_>, _>>()?;
        let wanted: Vec<_> = LAYERS.iter().enumerate().flat_map(Layer::tensors).collect();
        let (mut tensors, mut problems) = (Vec::new(), Vec::new());
        for (name, shape) in &wanted {
            let found: Vec<_> = sources.iter().filter_map(|s| Some((s, s.tensors().get(name)?))).collect();
            match found.as_slice() {
                [(source, entry)] if entry.shape == *shape => {
                    let values = source.read_f32(name)?;
                    problems.extend(not_finite(name, &values));
                    tensors.push(TensorData::new(values, shape.clone()));
                }
                [(_, entry)] => {
                    problems.push(format!("mis-shaped: {name} {:?} instead of {shape:?}", entry.shape));
                }
                [] => problems.push(format!("missing: {name} {shape:?}")),
                _ => problems.push(format!("given twice: {name}")),
            }
        }
        let is_unknown = |name: &&String| {
            !name.starts_with("classifier.") && wanted.iter().all(|(known, _)| known != *name)
        };
        let unknown = sources.iter().flat_map(|source| source.tensors().keys()).find(is_unknown);
        let of_other = |name: &String| format!("not part of AlexNet or LPIPS: {}", name.escape_debug());
        problems.extend(unknown.map(of_other));
        if !problems.is_empty() {
            return Err(refused(files, problems));
        }
        let mut tensors = tensors.into_iter();
        let mut next = || tensors.next().expect("three of each layer");
        let layers = LAYERS.map(|_| Parameters {
            weight: Tensor::from_data(next(), device),
            bias: Tensor::from_data(next(), device),
            linear: Tensor::from_data(next(), device),
        });
        Ok(Self { layers: layers.into() })
    }

    /// The published files that are missing in a folder.
    pub fn missing(folder: &Path) -> Vec<PathBuf> {
        PUBLISHED.map(|name| folder.join(name)).into_iter().filter(|file| !file.exists()).collect()
    }

    /// The published weights in a folder, checked with a known distance.
    ///
    /// # Errors
    /// [`WeightsError`] for files that cannot be read or are not the published files.
    pub fn published(folder: &Path, device: &Device) -> Result<Self, WeightsError> {
        let files = PUBLISHED.map(|name| folder.join(name));
        let network = Self::load(&files, device)?;
        if !network.is_published() {
            let found = network.check();
            let problem = format!(
                "the distance of the check pictures is {found:.6}, with published weights {KNOWN:.6}"
            );
            return Err(refused(&files, vec![problem]));
        }
        Ok(network)
    }

    /// Whether the check pictures have the distance that the published weights give. Devices change the distance far
    /// less than other weights do.
    pub fn is_published(&self) -> bool {
        (self.check() - KNOWN).abs() <= 1e-4 * KNOWN
    }

    /// Distance between two pictures of 64 × 64 pixels: noise from a formula, and the mean of this and other noise.
    fn check(&self) -> f64 {
        const SIDE: usize = 64;
        let device = self.device();
        let noise = |stream: u32| -> Tensor<4> {
            let values: Vec<f32> = (0..3 * SIDE * SIDE).map(|place| number(stream, place) as f32).collect();
            Tensor::from_data(TensorData::new(values, [1, 3, SIDE, SIDE]), &device)
        };
        let (a, b) = (noise(100), noise(101));
        let half = (a.clone() + b) * 0.5;
        f64::from(self.distance(a, half).into_scalar::<f32>())
    }

    /// Device of the weights.
    pub fn device(&self) -> Device {
        self.layers[0].weight.device()
    }

    /// Distance of each picture from its target, `[B]`. Pictures `[B, 3, H, W]` have values in [0, 1], sides of at
    /// least [`MIN_SIDE`], and the device of the network.
    ///
    /// # Panics
    /// If a picture is smaller, or has another number of channels.
    pub fn distance(&self, image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
        let [_, channels, h, w] = image.dims();
        assert!(channels == 3 && h.min(w) >= MIN_SIDE, "LPIPS of {h}×{w} pixels, {channels} channels");
        let (mut x, mut y) = (normalised(image), normalised(target));
        let of_layer = |(layer, parameters): (&Layer, &Parameters)| -> Tensor<1> {
            (x, y) = (parameters.run(layer, x.clone()), parameters.run(layer, y.clone()));
            let apart = (unit(x.clone()) - unit(y.clone())).square() * parameters.linear.clone();
            let [b, c, h, w] = apart.dims();
            apart.reshape([b, c * h * w]).sum_dim(1).squeeze_dim(1) / (h * w) as f64
        };
        let distances = LAYERS.iter().zip(&self.layers).map(of_layer);
        distances.reduce(|sum, distance| sum + distance).expect("there are layers")
    }
}

impl Parameters {
    fn run(&self, layer: &Layer, x: Tensor<4>) -> Tensor<4> {
        let x = if layer.pooled { max_pool2d(x, MaxPoolOptions::new([3, 3]).with_stride([2, 2])) } else { x };
        let options = ConvOptions::new([layer.stride; 2], [layer.padding; 2], [1, 1], 1);
        relu(conv2d(x, self.weight.clone(), Some(self.bias.clone()), options))
    }
}

/// Pictures with values in [0, 1], normalised for the network.
fn normalised(x: Tensor<4>) -> Tensor<4> {
    let of_channel = |values: [f32; 3]| {
        Tensor::<1>::from_floats(values, &x.device()).reshape([1, 3, 1, 1]).cast(x.dtype())
    };
    (x.clone() * 2.0 - 1.0 - of_channel(SHIFT)) / of_channel(SCALE)
}

/// Features `[B,C,H,W]`, scaled to length 1 at every pixel.
fn unit(x: Tensor<4>) -> Tensor<4> {
    /// Least square, so that no length is 0.
    const MIN_SQUARE: f64 = 1e-30;
    let length = x.clone().square().sum_dim(1).clamp_min(MIN_SQUARE).sqrt();
    x / (length + EPSILON)
}

/// Pseudo-random numbers in [0, 1) that the reference in Python computes alike.
fn number(stream: u32, place: usize) -> f64 {
    let mixed = (place as u32).wrapping_mul(2_654_435_761).wrapping_add(stream.wrapping_mul(40_503_121));
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519);
    f64::from(mixed ^ (mixed >> 13)) / 4_294_967_296.0
}

fn refused(files: &[PathBuf], problems: Vec<String>) -> WeightsError {
    let names: Vec<String> = files.iter().map(|path| path.display().to_string()).collect();
    WeightsError::Tensors { origin: names.join(", "), problems }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;
    use std::path::Path;

    use snapsnap_net::config::Precision;
    use snapsnap_net::weights::write_tensors;

    use crate::pictures::Picture;
    use crate::region::Region;
    use crate::score::Score;

    fn values(stream: u32, count: usize, value: impl Fn(f64) -> f64) -> Vec<f32> {
        (0..count).map(|place| value(number(stream, place)) as f32).collect()
    }

    /// Random weights, named and shaped as the published ones.
    fn tensors() -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let all = LAYERS.iter().enumerate().flat_map(Layer::tensors).enumerate();
        let filled = |(stream, (name, shape)): (usize, (String, Vec<usize>))| {
            let fan_in: usize = shape[1..].iter().product();
            let value = |u: f64| match stream % 3 {
                0 => (2.0 * u - 1.0) * (6.0 / fan_in as f64).sqrt(),
                1 => 0.1 * (u - 0.5),
                _ => u,
            };
            let values = values(stream as u32, shape.iter().product(), value);
            (name, shape, values)
        };
        all.map(filled).collect()
    }

    fn written(folder: &Path, tensors: &[(String, Vec<usize>, Vec<f32>)], name: &str) -> PathBuf {
        let path = folder.join(name);
        let names = tensors.iter().map(|(name, shape, _)| (name.clone(), shape.clone())).collect();
        let values = |i: usize| Ok(tensors[i].2.clone());
        write_tensors(&path, name, HashMap::new(), names, Precision::F32, values, &|_, _| ())
            .expect("writes");
        path
    }

    /// `EXPECTED`: distances from the authors' package (docs/lpips_reference.py).
    #[test]
    fn distances_are_the_authors_and_scores_have_them() {
        const EXPECTED: [([usize; 2], f64); 3] =
            [([64, 64], 0.382_813_364_3), ([31, 97], 0.338_810_145_9), ([256, 160], 0.364_796_519_3)];
        let (folder, device) = (tempfile::tempdir().expect("a folder"), Device::flex());
        let lpips = Lpips::load(&[written(folder.path(), &tensors(), "all")], &device).expect("loads");
        let distance = |a: &Picture, b: &Picture| {
            lpips.distance(a.tensor(&device), b.tensor(&device)).into_scalar::<f32>()
        };
        for (size @ [h, w], expected) in EXPECTED {
            let [a, b] = [100, 101].map(|stream| values(stream, 3 * h * w, |u| u));
            let half = a.iter().zip(b).map(|(a, b)| (a + b) * 0.5).collect();
            let [a, b] = [a, half].map(|values| Picture::new(values, size, "picture").expect("a picture"));
            let got = f64::from(distance(&a, &b));
            assert!((got - expected).abs() < 1e-5 * expected, "{size:?}: {got}, not {expected}");
            assert_eq!(distance(&b, &b), 0.0);
            let score = Score::new(&a, &b, &Region::all(&b), Some(&lpips)).expect("one size");
            assert_eq!(score.lpips, Some(got));
        }
    }

    #[test]
    fn weights_that_are_not_the_published_ones_are_no_lpips() {
        let folder = tempfile::tempdir().expect("a folder");
        assert_eq!(Lpips::missing(folder.path()), PUBLISHED.map(|name| folder.path().join(name)));
        // Files with the published names and other contents.
        let (network, learned) = tensors().into_iter().partition::<Vec<_>, _>(|t| t.0.starts_with('f'));
        written(folder.path(), &network, PUBLISHED[0]);
        written(folder.path(), &learned, PUBLISHED[1]);
        assert_eq!(Lpips::missing(folder.path()), Vec::<PathBuf>::new());
        let said = Lpips::published(folder.path(), &Device::flex()).expect_err("other weights").to_string();
        assert!(said.contains("the distance of the check pictures is"), "{said}");
        std::fs::write(folder.path().join(PUBLISHED[1]), []).expect("writes");
        Lpips::published(folder.path(), &Device::flex()).expect_err("an empty file");
    }

    #[test]
    fn weights_of_something_else_are_refused_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let whole = tensors();
        let mut other = whole.clone();
        other[2].1 = vec![64, 1, 1, 1];
        let more = [&whole[..], &[("features.12.weight".into(), vec![1], vec![0.0])]].concat();
        for (files, problem) in [
            (vec![written(folder.path(), &whole[1..], "less")], "missing: features.0.weight [64, 3, 11, 11]"),
            (vec![written(folder.path(), &other, "other")], "mis-shaped: lin0.model.1.weight"),
            (vec![written(folder.path(), &more, "more")], "not part of AlexNet or LPIPS: features.12.weight"),
            (vec![written(folder.path(), &whole, "twice"); 2], "given twice: features.0.weight"),
            (vec!["nowhere.pth".into()], "nowhere.pth"),
        ] {
            let said = Lpips::load(&files, &Device::flex()).expect_err("no LPIPS").to_string();
            assert!(said.contains(problem), "{said}");
        }
    }
}
