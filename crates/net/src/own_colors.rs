//! The photographs' colours in their own views (docs/method.md, "Own colours"). Gaussians mix with their neighbours, so
//! that pictures from the photographs' cameras are softer than the photographs. One correction of the colours makes
//! these pictures sharp.

use burn::tensor::{Tensor, TensorData};
use glam::Vec3;
use snapsnap_ops::host;
use snapsnap_splat::{RenderOptions, render};

use crate::config::Config;
use crate::network::{View, nominal_camera};
use crate::photograph::Photograph;
use crate::steps::Step;
use crate::{Reconstruction, pixel_width};

/// Share of a difference that a correction removes.
const SHARE: f32 = 0.5;
/// Least share of the person in a pixel, in the photograph and in the render, whose difference counts.
const INSIDE: f32 = 0.98;
/// Pixel widths within which a pixel's depth is the depth of its own Gaussian. Otherwise another one hides it.
const NEAR: f32 = 4.0;

impl Reconstruction {
    /// Adds a share of the difference between photograph and render to the colour of each pixel's own Gaussian, where
    /// the Gaussian is visible, and lowers its opacity by the same share of the background in the pixel, so that outlines
    /// are soft. Gaussians without a photograph stay as they are, and so does a view that cannot be rendered.
    pub fn restore_own_colors(&mut self, config: &Config, photographs: [&Photograph; 2]) {
        let side = config.network.resolution;
        let near = NEAR * pixel_width(side);
        let means = host(self.gaussians.means.clone());
        let mut colors = host(self.gaussians.colors.clone());
        let mut opacities = host(self.gaussians.opacities.clone());
        let mut restored = 0;
        for (view, photograph) in [View::Front, View::Back].into_iter().zip(photographs) {
            let camera = nominal_camera(view, config.network.pair_degrees, side);
            let options = RenderOptions { depth: true, ..RenderOptions::inria() };
            let Ok(seen) = render(&self.gaussians, &[camera], &options) else { continue };
            let (color, alpha) = (host(seen.color), host(seen.alpha));
            let depth = seen.depth.map(host).unwrap_or_default();
            let away = camera.world_to_camera;
            for (i, origin) in self.origins.iter().enumerate().filter(|(_, origin)| origin.view == Some(view))
            {
                let pixel = origin.pixel as usize;
                let mean = Vec3::from_slice(&means[3 * i..]).as_dvec3();
                let is_seen = (depth[pixel] / alpha[pixel] - away.apply(mean).z as f32).abs() <= near;
                opacities[i] *= 1.0 - SHARE * (1.0 - photograph.mask[pixel]);
                if !is_seen || photograph.mask[pixel].min(alpha[pixel]) < INSIDE {
                    continue;
                }
                for c in 0..3 {
                    let target = 0.5 + 0.5 * photograph.rgb[c * side * side + pixel];
                    let value = &mut colors[3 * i + c];
                    *value = (*value + SHARE * (target - color[3 * pixel + c])).clamp(0.0, 1.0);
                }
                restored += 1;
            }
        }
        let (n, device) = (self.origins.len(), self.gaussians.device());
        self.gaussians.colors = Tensor::from_data(TensorData::new(colors, [n, 3]), &device);
        self.gaussians.opacities = Tensor::from_data(TensorData::new(opacities, [n]), &device);
        self.steps.push(Step::OwnColors { gaussians: restored });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backing::tests::{SIDE, config, wall};
    use crate::painter::Origin;

    /// Mean absolute error of the front's render inside the wall.
    fn error(made: &Reconstruction, photograph: &Photograph) -> f32 {
        let camera = nominal_camera(View::Front, config().network.pair_degrees, SIDE);
        let seen = render(&made.gaussians, &[camera], &RenderOptions::inria()).expect("a wall");
        let color = host(seen.color);
        let pixels: Vec<usize> =
            (7..21).flat_map(|row| (11..25).map(move |column| row * SIDE + column)).collect();
        let off = |pixel: &usize| (color[3 * pixel] - 0.5 - 0.5 * photograph.rgb[*pixel]).abs();
        pixels.iter().map(off).sum::<f32>() / pixels.len() as f32
    }

    #[test]
    fn own_views_are_sharper_and_hidden_gaussians_keep_their_colours() {
        let mut made = wall(0.0);
        // The wall stands where each pixel sees its own Gaussian, and has a pattern of 3×3 pixels.
        let camera = nominal_camera(View::Front, config().network.pair_degrees, SIDE);
        let [fx, cx, cy] =
            [camera.focal.x, camera.principal_point.x, camera.principal_point.y].map(|x| x as f32);
        let at = |origin: &Origin, depth: f32| {
            let [x, y] = [origin.pixel as usize % SIDE, origin.pixel as usize / SIDE].map(|x| x as f32 + 0.5);
            [(x - cx) * depth / fx, (y - cy) * depth / fx, depth]
        };
        let is_bright = |pixel: usize| (pixel % SIDE / 3 + pixel / SIDE / 3).is_multiple_of(2);
        let pattern = |pixel: usize| if is_bright(pixel) { 0.7_f32 } else { 0.3 };
        let n = made.origins.len();
        // One Gaussian in the middle lies behind the wall.
        let hidden = n / 2;
        let depth = |i: usize| if i == hidden { 3.0 } else { 2.0 };
        let rows = |values: Vec<f32>| {
            let columns = values.len() / n;
            Tensor::<2>::from_data(TensorData::new(values, [n, columns]), &made.gaussians.device())
        };
        let means = made.origins.iter().enumerate().flat_map(|(i, origin)| at(origin, depth(i))).collect();
        let colors = made.origins.iter().flat_map(|origin| [pattern(origin.pixel as usize); 3]).collect();
        let (means, colors) = (rows(means), rows(colors));
        made.gaussians.means = means;
        made.gaussians.colors = colors;
        let rgb: Vec<f32> = (0..3 * SIDE * SIDE).map(|i| 2.0 * pattern(i % (SIDE * SIDE)) - 1.0).collect();
        let mut photograph = Photograph::new(rgb, vec![1.0; SIDE * SIDE]);
        let rim = made.origins[0].pixel as usize;
        photograph.mask[rim] = 0.6;

        let before = (error(&made, &photograph), host(made.gaussians.colors.clone()));
        made.restore_own_colors(&config(), [&photograph, &photograph]);
        let after = error(&made, &photograph);
        assert!(before.0 > 0.02 && after < 0.8 * before.0, "{} {after}", before.0);
        let opacities = host(made.gaussians.opacities.clone());
        assert!((opacities[0] - 0.8).abs() < 1e-6 && opacities[1..].iter().all(|opacity| *opacity == 1.0));
        let colors = host(made.gaussians.colors.clone());
        assert_eq!(colors[3 * hidden..][..3], before.1[3 * hidden..][..3]);
        assert!(colors.iter().all(|value| (0.0..=1.0).contains(value)));
        assert!(matches!(made.steps.last(), Some(Step::OwnColors { gaussians }) if *gaussians > 200));
    }
}
