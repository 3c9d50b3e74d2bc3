//! Activations of the regressor's 14 channels (docs/method.md, "Attributes").

use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use glam::Vec3;
use snapsnap_splat::RigidTransform;

use crate::config::{Config, RegressorConfig};
use crate::network::nominal_camera;
use crate::painter::CanvasView;

/// Gaussian attributes of N pixels.
#[derive(Debug, Clone)]
pub struct Attributes {
    /// `[N, 1]` in (0, 1).
    pub opacity: Tensor<2>,
    /// Standard deviations `[N, 3]`, metres.
    pub scale: Tensor<2>,
    /// Unit quaternions `[N, 4]` (w, x, y, z).
    pub rotation: Tensor<2>,
    /// `[N, 3]`, −1 black, 1 white. Corrected pixel colours may lie outside of this range.
    pub color: Tensor<2>,
    /// Offsets from the point map `[N, 3]`, metres, front camera's axes.
    pub offset: Tensor<2>,
}

/// Attributes of N Gaussians before the corrections of the network.
#[derive(Debug, Clone)]
pub struct Geometry {
    /// Distance of neighbouring points `[N, 1]`, metres.
    pub spacing: Tensor<2>,
    /// Colours of the pixels `[N, 3]` in [−1, 1].
    pub colors: Tensor<2>,
    /// Limits of the network's corrections.
    pub limits: Limits,
}

/// Limits of the attributes of a view's Gaussians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Largest correction of a colour in [−1, 1].
    pub color: f64,
    /// Least opacity.
    pub opacity: f64,
}

impl Limits {
    /// The limits of both photographs (`pair` 0) or of the sides.
    pub fn of(config: &RegressorConfig, pair: usize) -> Self {
        let pair = pair.min(1);
        // Colours are in [−1, 1].
        Self { color: 2.0 * config.color_limits[pair], opacity: config.least_opacities[pair] }
    }
}

/// Initial standard deviation of a Gaussian over the distance of its neighbours. (Rendered at right angles, true
/// points reach 23.3 dB with 0.2 and 22.3 dB with 0.4. The smaller value shows holes in close views.)
const START_SCALE: f64 = 0.3;
/// Initial opacity, as the logit of 0.9.
const START_OPACITY: f64 = 2.197_224_577_336_219;
/// The network changes the logarithm of a scale by at most this value.
const LOG_SCALE: f64 = 2.0;
/// Largest distance between neighbouring points, in pixel widths. Points farther apart are on different limbs.
const MOST_SPACING: f32 = 3.0;

impl Geometry {
    /// The geometry of a view's valid pixels, row by row, on a canvas of `side`² pixels.
    pub fn new(view: &CanvasView, config: &Config, side: usize, limits: Limits, device: &Device) -> Self {
        let CanvasView { view, image, points, valid } = *view;
        let camera = nominal_camera(view, config.network.pair_degrees, side);
        let RigidTransform { rotation, translation } = camera.world_to_camera;
        let depth = |point: Vec3| (rotation.row(2).dot(point.as_dvec3()) + translation.z) as f32;
        let point = |i: usize| Vec3::from_slice(&points[3 * i..]);
        let (mut spacing, mut colors) = (Vec::new(), Vec::new());
        for i in (0..side * side).filter(|i| valid[*i]) {
            let (here, row, column) = (point(i), i / side, i % side);
            let footprint = (depth(here).abs() / camera.focal.x as f32).clamp(1e-5, 1.0);
            let beside = [
                (column > 0, i.wrapping_sub(1)),
                (column + 1 < side, i + 1),
                (row > 0, i.wrapping_sub(side)),
                (row + 1 < side, i + side),
            ];
            let near = beside.into_iter().filter(|(inside, j)| *inside && valid[*j]);
            let near = near.map(|(_, j)| here.distance(point(j))).filter(|d| *d <= MOST_SPACING * footprint);
            let (sum, count) = near.fold((0.0, 0), |(sum, count), d| (sum + d, count + 1));
            spacing.push(if count > 0 { (sum / count as f32).max(0.5 * footprint) } else { footprint });
            colors.extend([0, 1, 2].map(|c| image[c * side * side + i]));
        }
        let n = spacing.len();
        Self {
            spacing: Tensor::from_data(TensorData::new(spacing, [n, 1]), device),
            colors: Tensor::from_data(TensorData::new(colors, [n, 3]), device),
            limits,
        }
    }
}

impl Attributes {
    /// Attributes of features `[N, 14]`, opacity, scale, rotation, colour and offset: corrections of the `geometry`, or,
    /// without one, activated as in the published code.
    pub fn new(features: Tensor<2>, geometry: Option<Geometry>) -> Self {
        let part = |from: usize, width: usize| features.clone().narrow(1, from, width);
        let Some(Geometry { spacing, colors, limits }) = geometry else {
            return Self {
                opacity: sigmoid(part(0, 1)),
                scale: sharp_softplus(part(1, 3)),
                rotation: unit(part(4, 4)),
                color: part(8, 3).tanh(),
                offset: part(11, 3) * 0.001,
            };
        };
        let upright = Tensor::from_data([[1.0, 0.0, 0.0, 0.0]], &features.device());
        Self {
            opacity: sigmoid(part(0, 1) + START_OPACITY) * (1.0 - limits.opacity) + limits.opacity,
            scale: (part(1, 3).tanh() * LOG_SCALE).exp() * (spacing.clone() * START_SCALE),
            rotation: unit(part(4, 4) + upright),
            // Small corrections are the same for every limit.
            color: colors + (part(8, 3) / limits.color).tanh() * limits.color,
            offset: part(11, 3) * spacing,
        }
    }
}

/// 0.001·ln(1 + e^(100·x)) without overflow, as 0.1·max(x, 0) + 0.001·ln(1 + e^(−100·|x|)).
/// PyTorch's softplus switches to the straight line above 100·x = 20, where the two differ by 2e-9 of 20.
fn sharp_softplus(x: Tensor<2>) -> Tensor<2> {
    x.clone().clamp_min(0.0) * 0.1 + (x.abs() * -100.0).exp().log1p() * 0.001
}

/// Rows scaled to length one; a row shorter than 1e-12 is divided by that instead (PyTorch's `normalize`).
fn unit(x: Tensor<2>) -> Tensor<2> {
    const MIN_NORM: f64 = 1e-12;
    // Scaled by the largest component first, so that squares neither overflow nor vanish.
    let largest = x.clone().abs().max_dim(1).clamp_min(f64::from(f32::MIN_POSITIVE));
    let norm = (x.clone() / largest.clone()).square().sum_dim(1).sqrt() * largest;
    x / norm.clamp_min(MIN_NORM)
}

#[cfg(test)]
mod tests {
    use snapsnap_ops::host;

    use super::*;

    /// The published scale at 0 is 6.931e-4 (docs/method.md, "Check values").
    #[test]
    fn softplus_has_its_published_value_and_stays_finite_at_the_extremes() {
        let device = Device::flex();
        let got = host(sharp_softplus(Tensor::from_data([[0.0, 0.3, -0.05, 1e30, -1e30]], &device)));
        let expected = [0.001 * std::f32::consts::LN_2, 0.03, 0.001 * (-5.0_f32).exp().ln_1p(), 1e29, 0.0];
        for (g, e) in got.iter().zip(expected) {
            assert!((g - e).abs() <= 1e-6 * e.abs().max(1e-3), "{got:?}");
        }
    }

    /// Attributes of one Gaussian on a pixel of the colour (0.5, −0.25, 1). All features but one are 0.
    fn attributes(channel: usize, feature: f32, limits: Limits) -> Attributes {
        let device = Device::flex();
        let mut features = [0.0; 14];
        features[channel] = feature;
        let geometry = Geometry {
            spacing: Tensor::from_data([[0.01]], &device),
            colors: Tensor::from_data([[0.5, -0.25, 1.0]], &device),
            limits,
        };
        Attributes::new(Tensor::from_data([features], &device), Some(geometry))
    }

    /// Without corrections, colours are the pixels'. A small correction is the same for any limit. A large correction
    /// ends at the limit.
    #[test]
    fn corrections_of_colours_end_at_their_limit() {
        for limit in [0.06, 0.2, 1.0] {
            let colors = |feature| host(attributes(8, feature, Limits { color: limit, opacity: 0.0 }).color);
            assert_eq!(colors(0.0), [0.5, -0.25, 1.0]);
            let color = |feature| colors(feature)[0];
            assert!((color(0.01) - 0.51).abs() < 1e-4, "{limit}");
            for sign in [-1.0, 1.0] {
                assert!((color(sign * 30.0) - 0.5 - sign * limit as f32).abs() < 1e-6, "{limit}");
            }
        }
    }

    #[test]
    fn opacities_end_at_their_least_value() {
        for (feature, least, expected) in
            [(0.0, 0.0, 0.9), (0.0, 0.8, 0.98), (-40.0, 0.8, 0.8), (40.0, 0.8, 1.0), (-40.0, 1.0, 1.0)]
        {
            let opacity = host(attributes(0, feature, Limits { color: 1.0, opacity: least }).opacity)[0];
            assert!((opacity - expected).abs() < 1e-6, "{feature}, {least}");
        }
    }

    #[test]
    fn quaternions_are_unit_even_when_huge_tiny_or_zero() {
        let device = Device::flex();
        let rows =
            Tensor::from_data([[3.0, 0.0, -4.0, 0.0], [1e30, 1e30, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], &device);
        let got = host(unit(rows));
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let expected = [0.6, 0.0, -0.8, 0.0, half, half, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert!(got.iter().zip(expected).all(|(g, e)| (g - e).abs() < 1e-6), "{got:?}");
    }
}
