//! Mean lengths of an image's vectors, and of differences between the vectors of two pixels, in one operator. Burn's
//! operators would keep a dozen images for the gradient of each mean.

use burn::tensor::Tensor;
use rayon::prelude::*;

use crate::device::has_kernels;
use crate::op::{self, Given, InputGradients, Kept, Kernel};

/// Vectors whose squared length is smaller have no gradient: their direction is noise.
const MIN_SQUARE: f64 = 1e-24;

/// For every offset (rows, columns), the mean length of the difference between the vectors `[B,H,W,3]` of two pixels
/// at this offset → `[B, offsets]`. Offset (0, 0) gives the mean length of the vectors themselves. `weight` `[B,H,W]`
/// is 1 or 0. Only pairs of two pixels with weight 1 count; without a pair the mean is 0. Vectors of weight 0 may be
/// NaN. Every offset must be smaller than the image.
pub fn mean_lengths(vectors: Tensor<4>, weight: Tensor<3>, offsets: &[[usize; 2]]) -> Tensor<2> {
    let [batch, height, width, channels] = vectors.dims();
    assert!(channels == 3 && weight.dims() == [batch, height, width], "one weight per vector of three");
    assert!(
        offsets.iter().all(|[down, across]| *down < height && *across < width),
        "offsets reach beyond the image"
    );
    if !has_kernels(&vectors) {
        return plain(vectors, &weight, offsets);
    }
    let kernel = MeanLengths { batch, height, width, offsets: offsets.to_vec() };
    op::run(kernel, [batch, offsets.len()], vectors, Some(weight), None::<Tensor<1>>)
}

/// [`mean_lengths`] in Burn's operators.
fn plain(vectors: Tensor<4>, weight: &Tensor<3>, offsets: &[[usize; 2]]) -> Tensor<2> {
    let [_, height, width, _] = vectors.dims();
    let nowhere = weight.clone().lower_equal_elem(0.0).unsqueeze_dim::<4>(3).expand(vectors.dims());
    let vectors = vectors.mask_fill(nowhere, 0.0);
    let mean = |&[down, across]: &[usize; 2]| {
        let (rows, columns) = (height - down, width - across);
        let vector = |from: [usize; 2]| vectors.clone().narrow(1, from[0], rows).narrow(2, from[1], columns);
        let weight = |from: [usize; 2]| weight.clone().narrow(1, from[0], rows).narrow(2, from[1], columns);
        let (vectors, weight) = match [down, across] {
            [0, 0] => (vector([0, 0]), weight([0, 0])),
            offset => (vector(offset) - vector([0, 0]), weight(offset) * weight([0, 0])),
        };
        let length = vectors.square().sum_dim(3).clamp_min(MIN_SQUARE).sqrt().squeeze_dim::<3>(3);
        // One dimension after the other: a GPU uses one thread per sum of a step.
        let sum = |values: Tensor<3>| values.sum_dim(2).sum_dim(1).squeeze_dim::<2>(2);
        sum(length * weight.clone()) / sum(weight).clamp_min(1.0)
    };
    Tensor::cat(offsets.iter().map(mean).collect(), 1)
}

#[derive(Debug)]
struct MeanLengths {
    batch: usize,
    height: usize,
    width: usize,
    offsets: Vec<[usize; 2]>,
}

impl MeanLengths {
    /// Calls `each` for every pair at an offset whose first pixel is in row `row` of a sample, with the indices of the
    /// two pixels in the sample and the difference. For offset (0, 0) it gets equal indices and the vector itself.
    #[inline(always)]
    fn pairs(
        &self,
        vectors: &[f32],
        weight: &[f32],
        [down, across]: [usize; 2],
        row: usize,
        mut each: impl FnMut(usize, usize, [f32; 3]),
    ) {
        if row + down >= self.height {
            return;
        }
        let apart = down * self.width + across;
        let first = row * self.width;
        for pixel in first..first + self.width - across {
            let other = pixel + apart;
            if weight[pixel] > 0.0 && weight[other] > 0.0 {
                let at = |pixel: usize| [0, 1, 2].map(|axis| vectors[3 * pixel + axis]);
                let ([x, y, z], from) = (at(other), if apart == 0 { [0.0; 3] } else { at(pixel) });
                each(pixel, other, [x - from[0], y - from[1], z - from[2]]);
            }
        }
    }

    fn area(&self) -> usize {
        self.height * self.width
    }
}

impl Kernel for MeanLengths {
    fn forward(&self, [vectors, weight, _]: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let (area, count) = (self.area(), self.offsets.len());
        // Sums of lengths and numbers of pairs, row by row.
        let mut rows = vec![[0.0_f64; 2]; self.batch * self.height * count];
        rows.par_chunks_exact_mut(count).enumerate().for_each(|(line, sums)| {
            let (sample, row) = (line / self.height, line % self.height);
            let (vectors, weight) = (&vectors[3 * sample * area..], &weight[sample * area..]);
            for (offset, sum) in self.offsets.iter().zip(sums) {
                self.pairs(vectors, weight, *offset, row, |_, _, vector| {
                    let square = square(vector);
                    // `f64::max` would drop NaN.
                    let square = if square < MIN_SQUARE { MIN_SQUARE } else { square };
                    sum[0] += square.sqrt();
                    sum[1] += 1.0;
                });
            }
        });
        let mut sums = vec![[0.0; 2]; self.batch * count];
        for (rows, sums) in rows.chunks_exact(self.height * count).zip(sums.chunks_exact_mut(count)) {
            for row in rows.chunks_exact(count) {
                row.iter().zip(&mut *sums).for_each(|(part, sum)| (0..2).for_each(|i| sum[i] += part[i]));
            }
        }
        let means = sums.iter().map(|[length, pairs]| (length / pairs.max(1.0)) as f32).collect();
        let pairs: Vec<f64> = sums.into_iter().map(|[_, pairs]| pairs).collect();
        (means, keep.then(|| Box::new(pairs) as _))
    }

    fn backward(&self, given: Given) -> InputGradients {
        let Given { inputs: [vectors, weight, _], kept, upstream, wanted } = given;
        if !wanted[0] {
            return [None, None, None];
        }
        let (area, count) = (self.area(), self.offsets.len());
        let pairs = kept.and_then(|kept| kept.downcast::<Vec<f64>>().ok()).expect("kept by the forward pass");
        let mut gradient = vec![0.0; 3 * self.batch * area];
        gradient.par_chunks_exact_mut(3 * area).enumerate().for_each(|(sample, gradient)| {
            let (vectors, weight) = (&vectors[3 * sample * area..], &weight[sample * area..]);
            for (i, offset) in self.offsets.iter().enumerate() {
                let at = sample * count + i;
                let share = f64::from(upstream[at]) / pairs[at].max(1.0);
                for row in 0..self.height {
                    self.pairs(vectors, weight, *offset, row, |pixel, other, vector| {
                        let square = square(vector);
                        if square < MIN_SQUARE {
                            return;
                        }
                        let factor = (share / square.sqrt()) as f32;
                        for (axis, value) in vector.into_iter().enumerate() {
                            gradient[3 * other + axis] += factor * value;
                            if other != pixel {
                                gradient[3 * pixel + axis] -= factor * value;
                            }
                        }
                    });
                }
            }
        });
        [Some(gradient), None, None]
    }
}

fn square(vector: [f32; 3]) -> f64 {
    vector.map(|x| f64::from(x).powi(2)).iter().sum()
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, FloatDType, TensorData};

    use super::*;
    use crate::testing::{assert_equal, tensor, uniform, values};

    /// With a vector of length 0, and NaN where the weight is 0.
    #[test]
    fn mean_lengths_and_their_gradients_equal_their_composition_in_f64() {
        let shape @ [batch, height, width, _] = [3, 7, 11, 3];
        let area = height * width;
        let offsets = [[0, 0], [1, 0], [0, 1], [4, 0], [0, 8], [2, 3]];
        let mut weight: Vec<f32> =
            uniform(batch * area, 1).iter().map(|x| f32::from(u8::from(*x > -0.5))).collect();
        // The last sample has no pixel.
        weight[2 * area..].fill(0.0);
        weight[5] = 1.0;
        let mut given = uniform(3 * batch * area, 2);
        for (vector, weight) in given.chunks_exact_mut(3).zip(&weight) {
            if *weight == 0.0 {
                vector.fill(f32::NAN);
            }
        }
        given[15..18].fill(0.0);
        let device = Device::flex().autodiff();
        let run = |float: FloatDType, of: &dyn Fn(Tensor<4>, Tensor<3>) -> Tensor<2>| {
            let tracked = TensorData::new(given.clone(), shape);
            let vectors = Tensor::<4>::from_data(tracked, &device).cast(float).require_grad();
            let weight = TensorData::new(weight.clone(), [batch, height, width]);
            let means = of(vectors.clone(), Tensor::<3>::from_data(weight, &device).cast(float));
            let upstream = tensor([batch, offsets.len()], 3, float);
            let gradients = (means.clone() * upstream).sum().backward();
            [values(means), values(vectors.grad(&gradients).expect("tracked"))]
        };
        let ours = run(FloatDType::F32, &|vectors, weight| mean_lengths(vectors, weight, &offsets));
        let in_f64 = run(FloatDType::F64, &|vectors, weight| plain(vectors, &weight, &offsets));
        assert_eq!(ours[0][2 * offsets.len()..], [0.0; 6]);
        assert_equal("means", &ours[0], &in_f64[0]);
        assert_equal("gradients", &ours[1], &in_f64[1]);
    }

    /// A prediction of NaN makes the loss NaN, so that the step is skipped.
    #[test]
    fn nan_that_counts_stays() {
        let vectors = Tensor::<4>::full([1, 2, 2, 3], f32::NAN, &Device::flex());
        let weight = Tensor::ones([1, 2, 2], &Device::flex());
        let mean = mean_lengths(vectors.clone(), weight.clone(), &[[0, 0]]).into_scalar::<f32>();
        let composed = plain(vectors, &weight, &[[0, 0]]).into_scalar::<f32>();
        assert!(mean.is_nan() && composed.is_nan(), "{mean} {composed}");
    }
}
