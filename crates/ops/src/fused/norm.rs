//! Group normalisation between the passes: affine maps from moments, and gradients from sums over gradients.

use super::{Affine, CHANNELS, GradientSums, Plane};

/// Groups of neighbouring channels of every normalisation.
pub const GROUPS: usize = 16;
/// Added to every (biased) variance.
const EPSILON: f64 = 1e-5;

/// Mean and reciprocal standard deviation of every group.
pub type GroupStatistics = [Vec<f32>; 2];

/// Slope, curve and shift per channel. slope·g + curve·x + shift is the gradient of the plane x, where g is the
/// gradient of the normalised plane before SiLU.
pub type Linear = [[f32; CHANNELS]; 3];

/// Group normalisation of one or two stacked planes.
#[derive(Debug, Clone, Copy)]
pub struct GroupNorm<'a> {
    /// Factor per channel.
    pub gamma: &'a [f32],
    /// Summand per channel.
    pub beta: &'a [f32],
}

impl GroupNorm<'_> {
    fn per_group(&self) -> usize {
        self.gamma.len() / GROUPS
    }

    /// Statistics of the stacked planes, from the planes' moments.
    pub fn measure(&self, planes: &[&Plane]) -> GroupStatistics {
        let per_group = self.per_group();
        let channel = |i: usize| {
            let moments = &planes[i / CHANNELS].moments;
            (moments.mean[i % CHANNELS], moments.squares[i % CHANNELS])
        };
        let count = planes[0].moments.count;
        let group = |g: usize| {
            let members = || (g * per_group..(g + 1) * per_group).map(channel);
            let mean = members().map(|(mean, _)| mean).sum::<f64>() / per_group as f64;
            let squares: f64 = members().map(|(m, squares)| squares + count * (m - mean).powi(2)).sum();
            let variance = squares / (count * per_group as f64);
            (mean as f32, (variance + EPSILON).sqrt().recip() as f32)
        };
        let (mean, rstd) = (0..GROUPS).map(group).unzip();
        [mean, rstd]
    }

    /// Normalisation, factor and summand as one map per plane.
    pub fn affines(&self, [mean, rstd]: &GroupStatistics) -> Vec<Affine> {
        let per_group = self.per_group();
        let affine = |plane: usize| {
            let index = |c: usize| plane * CHANNELS + c;
            let scale: [f32; CHANNELS] =
                std::array::from_fn(|c| rstd[index(c) / per_group] * self.gamma[index(c)]);
            let shift = std::array::from_fn(|c| self.beta[index(c)] - mean[index(c) / per_group] * scale[c]);
            [scale, shift]
        };
        (0..self.gamma.len() / CHANNELS).map(affine).collect()
    }

    /// The backward pass from the sums over each plane's gradient: the gradients of factors and summands, and per plane
    /// the map from the gradient of the result to the plane's gradient, to which the statistics add.
    pub fn backward(
        &self,
        [mean, rstd]: &GroupStatistics,
        planes: &[&Plane],
        sums: &[GradientSums],
    ) -> ([Vec<f64>; 2], Vec<Linear>) {
        let per_group = self.per_group();
        let channels = self.gamma.len();
        let beta: Vec<f64> = (0..channels).map(|i| sums[i / CHANNELS][0][i % CHANNELS]).collect();
        // Σ g·x̂. The sums are about the plane's own mean, which can differ from the group's mean.
        let gamma: Vec<f64> = (0..channels)
            .map(|i| {
                let (plane, c, g) = (i / CHANNELS, i % CHANNELS, i / per_group);
                let distance = planes[plane].centre(c) - f64::from(mean[g]);
                let [gradient, product] = &sums[plane];
                f64::from(rstd[g]) * (product[c] + distance * gradient[c])
            })
            .collect();
        let members = planes[0].moments.count * per_group as f64;
        let group_mean = |values: &[f64], g: usize| {
            let terms = (g * per_group..(g + 1) * per_group).map(|i| f64::from(self.gamma[i]) * values[i]);
            terms.sum::<f64>() / members
        };
        let groups: Vec<[f64; 2]> =
            (0..GROUPS).map(|g| [group_mean(&beta, g), group_mean(&gamma, g)]).collect();
        // ∂x = rstd·(γ·g − mean(γ·g) − x̂·mean(γ·g·x̂)) with x̂ = rstd·(x − mean).
        let map = |plane: usize| -> Linear {
            let coefficients: [[f32; 3]; CHANNELS] = std::array::from_fn(|c| {
                let i = plane * CHANNELS + c;
                let g = i / per_group;
                let rstd = f64::from(rstd[g]);
                let curve = -rstd * rstd * groups[g][1];
                let shift = -rstd * groups[g][0] - curve * f64::from(mean[g]);
                [rstd * f64::from(self.gamma[i]), curve, shift].map(|x| x as f32)
            });
            std::array::from_fn(|part| coefficients.map(|channel| channel[part]))
        };
        ([gamma, beta], (0..planes.len()).map(map).collect())
    }
}
