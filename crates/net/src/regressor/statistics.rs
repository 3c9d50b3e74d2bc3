//! Group-norm statistics that can be measured on one input and reused on another.

use burn::nn::GroupNorm;
use burn::tensor::Tensor;
use snapsnap_ops::{spread_last, sum_last};

/// Means and reciprocal standard deviations of every group normalisation of one forward pass, in order of execution.
///
/// Statistics depend on how much background an image holds; freezing them separates that effect from all others.
#[derive(Debug, Clone, Default)]
pub struct Statistics {
    layers: Vec<[Tensor<2>; 2]>,
    next: Option<usize>,
}

impl Statistics {
    /// Measured during the pass, and recorded.
    pub fn measured() -> Self {
        Self::default()
    }

    /// These statistics as constants without gradients, for one pass over the same number of images.
    pub fn frozen(&self) -> Self {
        let constant = |layer: &[Tensor<2>; 2]| layer.each_ref().map(|x| x.clone().detach());
        Self { layers: self.layers.iter().map(constant).collect(), next: Some(0) }
    }

    /// Frozen statistics of all images on the host, layer by layer: means and reciprocal standard deviations.
    pub(crate) fn of_batch(&self) -> Option<Vec<[Vec<f32>; 2]>> {
        self.next?;
        let host = |x: &Tensor<2>| x.clone().into_data().try_into_vec().expect("f32");
        Some(self.layers.iter().map(|[mean, rstd]| [host(mean), host(rstd)]).collect())
    }

    /// Adds the measured statistics of a whole pass. Frozen statistics stay as they are.
    pub(crate) fn record(&mut self, layers: impl Iterator<Item = [Tensor<2>; 2]>) {
        if self.next.is_none() {
            self.layers.extend(layers);
        }
    }

    /// Means and reciprocal standard deviations `[B, groups]` of the next layer: frozen, or from `measure`.
    pub(crate) fn layer(&mut self, measure: impl FnOnce() -> [Tensor<2>; 2]) -> [Tensor<2>; 2] {
        match &mut self.next {
            Some(next) => {
                *next += 1;
                self.layers[*next - 1].clone()
            }
            None => {
                self.layers.push(measure());
                self.layers[self.layers.len() - 1].clone()
            }
        }
    }
}

/// Group normalisation of `[B, C, H, W]` with controllable statistics.
pub(crate) fn normalise(norm: &GroupNorm, x: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let groups = norm.num_groups;
    let [mean, rstd] = statistics.layer(|| {
        let n = c / groups * h * w;
        let flat = x.clone().reshape([b, groups, n]);
        let average = |x: Tensor<3>| sum_last(x) / n as f64;
        let mean = average(flat.clone());
        let variance = average((flat - spread_last(mean.clone(), n)).square());
        [mean.squeeze_dim(2), (variance + norm.epsilon).sqrt().recip().squeeze_dim(2)]
    });
    let per_channel = |x: Tensor<2>| x.reshape([b, groups, 1]).repeat_dim(2, c / groups).reshape([b, c]);
    let affine = |p: &Option<burn::module::Param<Tensor<1>>>| {
        p.as_ref().expect("the published group norms are affine").val().reshape([1, c])
    };
    let scale = per_channel(rstd) * affine(&norm.gamma);
    let shift = affine(&norm.beta) - per_channel(mean) * scale.clone();
    // Expanded, so that gradients are sums over one dimension after the other, not over all at once.
    let [scale, shift] = [scale, shift].map(|x| x.reshape([b, c, 1, 1]).expand([b, c, h, w]));
    x * scale + shift
}
