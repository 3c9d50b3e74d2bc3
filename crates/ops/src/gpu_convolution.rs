//! Burn's convolution with a faster gradient of the weight, for GPUs. Without autotuning, Burn computes this gradient
//! as a convolution whose kernel is the whole image: one thread per weight, with a loop over all pixels of all images.
//! Here it is im2col and a matrix product: `[D, pixels]` times `[pixels, taps · C]`.

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Dispatch, ExtensionType, Flex, TensorMetadata, backend_extension};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{DType, FloatDType, Shape, Slice, Tensor};

use crate::op::One;

/// Most pixels that one matrix product sums over. Several products run at once, and their results are added.
const PIXELS: usize = 512;
/// Most values in one im2col matrix: 128 MB, the size that every WebGPU binding can hold.
const VALUES: usize = 1 << 25;

/// An image `[B, C, H, W]` and a weight `[D, C, K, K]`.
#[derive(ExtensionType, Clone, Debug)]
pub struct Operands<B: Backend> {
    x: FloatTensor<B>,
    weight: FloatTensor<B>,
}

/// Backends with the operation.
#[cfg_attr(feature = "gpu", backend_extension(Cube, Flex, Autodiff))]
#[cfg_attr(not(feature = "gpu"), backend_extension(Flex, Autodiff))]
pub trait ConvolutionBackend: Backend {
    /// A convolution with zero padding of half a kernel: an image `[B, D, ⌈H / stride⌉, ⌈W / stride⌉]`.
    fn convolve(#[extension_type] operands: Operands<Self>, stride: usize) -> One<Self> {
        One { tensor: forward::<Self>(operands.x, operands.weight, stride) }
    }
}

#[cfg(feature = "gpu")]
impl ConvolutionBackend for burn_cubecl::CubeBackend {}
impl ConvolutionBackend for Flex {}

#[derive(Debug)]
struct ConvolutionBackward;

impl<B: Backend> Backward<B, 2> for ConvolutionBackward {
    /// Image, weight and stride.
    type State = (NodeId, NodeId, usize);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let (x, weight, stride) = ops.state;
        let [x, weight] = [x, weight].map(|node| checkpointer.retrieve_node_output::<FloatTensor<B>>(node));
        let [of_image, of_weight] = ops.parents;
        if let Some(parent) = of_weight {
            let gradient = weight_gradient::<B>(x.clone(), upstream.clone(), &weight.shape(), stride, VALUES);
            grads.register::<B>(parent.id, gradient);
        }
        if let Some(parent) = of_image {
            let options = options(weight.shape()[2], stride);
            grads.register::<B>(parent.id, B::conv2d_x_backward(x, weight, upstream, options));
        }
    }
}

impl<B: ConvolutionBackend, C: CheckpointStrategy> ConvolutionBackend for Autodiff<B, C> {
    fn convolve(Operands { x, weight }: Operands<Self>, stride: usize) -> One<Self> {
        let prepared = ConvolutionBackward.prepare::<C>([x.node(), weight.node()]).compute_bound().stateful();
        let tensor = match prepared {
            OpsKind::Tracked(mut prepared) => {
                let kept = (prepared.checkpoint(&x), prepared.checkpoint(&weight), stride);
                prepared.finish(kept, forward::<B>(x.into_primitive(), weight.into_primitive(), stride))
            }
            OpsKind::UnTracked(prepared) => {
                prepared.finish(forward::<B>(x.into_primitive(), weight.into_primitive(), stride))
            }
        };
        One { tensor }
    }
}

/// The convolution of an image `[B, C, H, W]` with a weight `[D, C, K, K]`, K odd, and zero padding of K / 2.
pub fn convolve(x: Tensor<4>, weight: Tensor<4>, stride: usize) -> Tensor<4> {
    let operands = Operands { x: x.into_dispatch(), weight: weight.into_dispatch() };
    Tensor::from_dispatch(<Dispatch as ConvolutionBackend>::convolve(operands, stride).tensor)
}

fn forward<B: Backend>(x: FloatTensor<B>, weight: FloatTensor<B>, stride: usize) -> FloatTensor<B> {
    let options = options(weight.shape()[2], stride);
    B::conv2d(x, weight, None, options)
}

fn options(side: usize, stride: usize) -> ConvOptions<2> {
    ConvOptions::new([stride; 2], [side / 2; 2], [1, 1], 1)
}

/// The gradient of the weight `[D, C, K, K]`. The im2col matrices hold about `values` values at once, at most.
fn weight_gradient<B: Backend>(
    x: FloatTensor<B>,
    upstream: FloatTensor<B>,
    shape: &Shape,
    stride: usize,
    values: usize,
) -> FloatTensor<B> {
    let [outputs, inputs, side, _] = shape.dims();
    let [batch, _, height, width] = upstream.shape().dims();
    let (device, dtype) = (upstream.device(), upstream.dtype());
    let (image, upstream) = (with_margin::<B>(x, side / 2), B::float_permute(upstream, &[0, 2, 3, 1]));
    let taps = side * side * inputs;
    // `unit` lines make one product. A band of lines is a multiple of `unit`, or shorter than `unit`.
    let unit = (PIXELS / width).clamp(1, height);
    let band = (values / (batch * width * taps)).clamp(1, height);
    let band = if band > unit { band - band % unit } else { band };
    // Values per image: the im2col matrix of a band or its products, whichever is larger.
    let of_image = (band * width * taps).max(band.div_ceil(unit) * outputs * taps);
    let images = (values / of_image).clamp(1, batch);
    // Sums of many values need more than 16 bits.
    let wide = if matches!(dtype, DType::F16 | DType::BF16) { FloatDType::F32 } else { dtype.into() };
    let mut sum = B::float_zeros(Shape::new([1, outputs, taps]), &device, wide);
    for (start, first) in (0..batch)
        .step_by(images)
        .flat_map(|start| (0..height).step_by(band).map(move |first| (start, first)))
    {
        let (count, lines) = (images.min(batch - start), band.min(height - first));
        let image = B::float_slice(image.clone(), &[part(start, count, 1), full(), full(), full()]);
        let rows = taps_of::<B>(&image, side, stride, [first, lines, width]);
        let place = [part(start, count, 1), part(first, lines, 1), full(), full()];
        let upstream = B::float_slice(upstream.clone(), &place);
        let all = count * lines;
        let joined = (1..=all).rev().find(|n| all % n == 0 && n * width <= PIXELS).unwrap_or(1);
        let [products, pixels] = [all / joined, joined * width];
        let rows = B::float_reshape(rows, Shape::new([products, pixels, taps]));
        let upstream = B::float_reshape(upstream, Shape::new([products, pixels, outputs]));
        let added = B::float_sum_dim(B::float_matmul(B::float_swap_dims(upstream, 1, 2), rows), 0);
        sum = B::float_add(sum, B::float_cast(added, wide));
    }
    let sum = B::float_cast(B::float_reshape(sum, Shape::new([outputs, side, side, inputs])), dtype.into());
    B::float_permute(sum, &[0, 3, 1, 2])
}

/// An image `[B, C, H, W]` as `[B, H, W, C]` with zero padding.
fn with_margin<B: Backend>(x: FloatTensor<B>, margin: usize) -> FloatTensor<B> {
    let [batch, channels, height, width] = x.shape().dims();
    let image = B::float_permute(x, &[0, 2, 3, 1]);
    if margin == 0 {
        return image;
    }
    let (device, dtype) = (image.device(), image.dtype().into());
    let shape = Shape::new([batch, height + 2 * margin, width + 2 * margin, channels]);
    let inner = [full(), part(margin, height, 1), part(margin, width, 1), full()];
    B::float_slice_assign(B::float_zeros(shape, &device, dtype), &inner, image)
}

/// The im2col matrix `[B, lines, columns, taps · C]` of a padded image, for `lines` output lines from `first` on.
fn taps_of<B: Backend>(
    image: &FloatTensor<B>,
    side: usize,
    stride: usize,
    [first, lines, columns]: [usize; 3],
) -> FloatTensor<B> {
    let tap = |tap: usize| {
        let row = part(first * stride + tap / side, lines, stride);
        B::float_slice(image.clone(), &[full(), row, part(tap % side, columns, stride), full()])
    };
    B::float_cat((0..side * side).map(tap).collect(), 3)
}

fn full() -> Slice {
    Slice::from(..)
}

/// `count` indices from `start` on, `step` apart.
fn part(start: usize, count: usize, step: usize) -> Slice {
    Slice::new(start as isize, Some((start + (count - 1) * step + 1) as isize), step as isize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{random, relative_error, tensor, values};

    #[test]
    fn convolutions_and_their_gradients_equal_burns() {
        let cases = [
            ([1, 1, 1, 1, 1], 3, 1),
            ([2, 3, 5, 7, 9], 3, 1),
            ([2, 5, 3, 8, 6], 3, 2),
            ([1, 2, 4, 7, 5], 3, 2),
            ([3, 4, 2, 5, 6], 1, 1),
            ([1, 3, 2, 53, 61], 3, 1), // more lines than one product covers
            ([2, 2, 2, 48, 90], 3, 1),
        ];
        for (seed, ([batch, inputs, outputs, height, width], side, stride)) in (1..).step_by(3).zip(cases) {
            let x = tensor([batch, inputs, height, width], seed, FloatDType::F64).require_grad();
            let weight = tensor([outputs, inputs, side, side], seed + 1, FloatDType::F64).require_grad();
            let results = [
                convolve(x.clone(), weight.clone(), stride),
                burn::tensor::module::conv2d(x.clone(), weight.clone(), None, options(side, stride)),
            ];
            let [ours, burns] = results.map(|y| {
                let upstream = tensor(y.dims(), seed + 2, FloatDType::F64);
                let gradients = (y.clone() * upstream).sum().backward();
                let of = |x: &Tensor<4>| values(x.grad(&gradients).expect("tracked"));
                [values(y), of(&x), of(&weight)]
            });
            for (what, (ours, burns)) in ["result", "image", "weight"].iter().zip(ours.iter().zip(&burns)) {
                let error = relative_error(ours, burns);
                assert!(error < 1e-11, "{what} of {batch}×{inputs}→{outputs} at {height}×{width}: {error:e}");
            }
        }
    }

    /// Bands of lines and parts of a batch, the last ones smaller, give the gradient of a single product.
    #[test]
    fn parts_add_up() {
        let shape = Shape::new([3, 2, 3, 3]);
        for (height, width, stride) in [(53, 61, 1), (31, 90, 2), (9, 700, 1)] {
            let x = random([3, 2, height, width], 1).cast(FloatDType::F64);
            let upstream = random([3, 3, height.div_ceil(stride), width.div_ceil(stride)], 2);
            let upstream = upstream.cast(FloatDType::F64);
            let gradient = |limit: usize| {
                let (x, upstream) = (x.clone().into_dispatch(), upstream.clone().into_dispatch());
                let gradient = weight_gradient::<Dispatch>(x, upstream, &shape, stride, limit);
                values(Tensor::<4>::from_dispatch(gradient))
            };
            let whole = gradient(usize::MAX);
            for limit in [1, 20 * width * 18, 35 * width * 18, 2 * height * width * 18] {
                let error = relative_error(&gradient(limit), &whole);
                assert!(error < 1e-11, "{height}×{width}, at most {limit}: {error:e}");
            }
        }
    }
}
