//! Points → Gaussians, for the reconstruction and for stage 2: the choice of pixels, the colours of the sides, the
//! regressor, its activations and the closed top.

use std::borrow::Cow;
use std::ops::Range;

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_ops::gather::taken;
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use crate::closed_top::Top;
use crate::config::{Config, RegressorConfig, RegressorStart};
use crate::nearest_colors::EMPTY;
pub use crate::nearest_colors::side_images;
use crate::network::View;
use crate::photograph::Photograph;
use crate::points::Points;
use crate::reconstruct::rows;
use crate::regressor::{Attributes, FEATURES, Geometry, Limits, Regressor};
use crate::steps::{Record, Step};
use crate::valid_pixels::Chosen;
use crate::window::Window;

/// The pixel to which a Gaussian belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Origin {
    /// Its view; `None` for a Gaussian that closes the top.
    pub view: Option<View>,
    /// Row-major index on the view's canvas.
    pub pixel: u32,
}

/// Everything but the points that decides the Gaussians.
pub struct Painter<'a> {
    /// The networks' config.
    pub config: &'a Config,
    /// One network for all views, or one for front and back and one for the sides.
    pub regressors: &'a [Regressor],
    /// Front and back.
    pub photographs: [&'a Photograph; 2],
    /// Views whose Gaussians are made. Second surfaces belong to the sides.
    pub views: Range<usize>,
    /// Whether the sides take colours from the photographs; otherwise the regressor gets −1.
    pub side_colors: bool,
}

/// Gaussians and intermediate results.
pub struct Painted {
    /// View after view, row by row, in the front camera's frame; then the Gaussians that close the top.
    pub gaussians: Gaussians,
    /// The pixel of each Gaussian.
    pub origins: Vec<Origin>,
    /// Per view, `[S, S]`: whether the pixel was to become a Gaussian.
    pub valid: Vec<Vec<bool>>,
    /// Pseudo images of the sides' maps `[3, S, S]` in [−1, 1], −1 where there is no point.
    pub side_images: Vec<Vec<f32>>,
    /// Pixels and Gaussians that were left out because they were not finite, or farther away than 1e30 m.
    pub lost: usize,
}

impl Painter<'_> {
    /// Makes the Gaussians on `device`. Points of the sides outside of the silhouettes move, in `points` as well.
    pub fn gaussians(&self, points: &mut Points, device: &Device, record: &mut Record) -> Painted {
        let config = self.config;
        let side = config.network.resolution;
        let area = side * side;
        let views = points.conf.len() / area;
        let masks = self.photographs.map(|photograph| photograph.valid.as_slice());
        let mut carve = |_: &mut Record| points.carve(&config.network, masks, device);
        let is_carved = views > 2 && config.network.hull_reach() > 0.0;
        let moved = if is_carved { record.timed("silhouettes", carve) } else { carve(record) };
        record.add_some(moved, |pixels| Step::MovedIntoSilhouettes { pixels });
        let Chosen { valid, lost, outside, between } = Chosen::new(config, masks, points);
        let names = View::WITH_SECOND.map(View::name);
        record.steps.extend(names.iter().zip(&valid).map(|(view, valid)| Step::Chosen {
            view,
            pixels: count(valid),
            of: area,
        }));
        record.add_some(lost, |pixels| Step::NotFinite { pixels });
        record.add_some(outside, |pixels| Step::OutsideSilhouettes { pixels });
        record.add_some(between, |pixels| Step::BetweenSurfaces { pixels });

        let colors =
            self.photographs.map(|photo| photograph_colors(&config.regressor, &photo.rgb, &photo.mask));
        let colors = [&*colors[0], &*colors[1]];
        let side_images = if views > 2 && self.side_colors {
            record.timed("side colours", |_| side_images(colors, &points.host, &valid, !config.mode.compat))
        } else {
            record.steps.push(Step::NoSideColors { as_asked: views > 2 });
            vec![vec![EMPTY; 3 * area]; views - 2]
        };
        let images = colors.into_iter().chain(side_images.iter().map(Vec::as_slice));
        let of_views = images.zip(points.host.chunks_exact(3 * area)).zip(&valid).zip(View::WITH_SECOND);
        let canvases: Vec<CanvasView> = of_views
            .map(|(((image, points), valid), view)| CanvasView { view, image, points, valid })
            .collect();
        let mut parts = self.regressed(&canvases, &points.maps, record);
        if config.network.closed_top && views > 2 && self.views.contains(&0) {
            parts.extend(record.timed("closed top", |record| {
                let top =
                    Top::new(colors, [canvases[0].points, canvases[1].points], [&valid[0], &valid[1]], side)?;
                let Top { image, points, valid } = &top;
                record.steps.push(Step::ClosedTop { gaussians: count(valid) });
                let seen = CanvasView { view: View::Front, image, points, valid };
                let part = uncorrected(&seen, config, side, device);
                let origins = part.origins.iter().map(|origin| Origin { view: None, ..*origin }).collect();
                Some(Part { origins, ..part })
            }));
        }
        let made: usize = parts.iter().map(|part| part.origins.len()).sum();
        let (gaussians, origins) = record.timed("activations", |_| assemble(parts, device));
        record.steps.push(Step::Gaussians { gaussians: origins.len() });
        record.add_some(made - origins.len(), |gaussians| Step::GaussiansNotFinite { gaussians });
        Painted { lost: lost + made - origins.len(), gaussians, origins, valid, side_images }
    }

    /// The parts of all views, pair after pair.
    fn regressed(&self, views: &[CanvasView], maps: &Tensor<4>, record: &mut Record) -> Vec<Part> {
        let (config, side) = (self.config, self.config.network.resolution);
        let names = [
            ("regressor (front, back)", "front, back"),
            ("regressor (sides)", "sides"),
            ("regressor (second surfaces)", "second surfaces"),
        ];
        let mut parts = Vec::new();
        for (pair, ((module, name), seen)) in names.into_iter().zip(views.chunks(2)).enumerate() {
            if !self.views.contains(&(2 * pair).min(2)) {
                continue;
            }
            let Some(person) = Window::around(seen.iter().map(|view| view.valid), side) else {
                record.steps.push(Step::NoRegressor { views: name });
                continue;
            };
            let window = if config.crop() {
                person.padded(config.regressor.margin(), side)
            } else {
                Window::whole(side)
            };
            record.steps.push(Step::Regressor { views: name, window: window.clone(), canvas: side, person });
            let network = &self.regressors[pair.min(self.regressors.len() - 1)];
            let maps = maps.clone().narrow(0, 2 * pair, seen.len());
            parts.extend(record.timed(module, |_| regress(network, config, pair, seen, maps, &window)));
        }
        parts
    }
}

/// One view on its square canvas of side S.
pub struct CanvasView<'a> {
    /// The view.
    pub view: View,
    /// `[3, S, S]` colours in [−1, 1], a photograph's or a side's pseudo image.
    pub image: &'a [f32],
    /// `[S, S, 3]` metres, front camera's frame.
    pub points: &'a [f32],
    /// `[S, S]`: whether a pixel becomes a Gaussian.
    pub valid: &'a [bool],
}

impl CanvasView<'_> {
    /// The pixels that become Gaussians.
    fn origins(&self) -> Vec<Origin> {
        let pixels = (0..self.valid.len()).filter(|pixel| self.valid[*pixel]);
        pixels.map(|pixel| Origin { view: Some(self.view), pixel: pixel as u32 }).collect()
    }
}

/// Features of one view's N valid pixels.
struct Part {
    features: Tensor<2>,
    points: Tensor<2>,
    geometry: Option<Geometry>,
    origins: Vec<Origin>,
}

/// Colours `[3, S, S]` in [−1, 1] of a photograph for its Gaussians. `rgb` is multiplied by the `mask` `[S, S]`, so
/// that the rim, from which the sides get their colours, fades to grey. With a geometric start, colours are divided
/// by the mask where the person covers at least half of a pixel.
pub fn photograph_colors<'a>(config: &RegressorConfig, rgb: &'a [f32], mask: &[f32]) -> Cow<'a, [f32]> {
    if config.start() == RegressorStart::Published {
        return Cow::Borrowed(rgb);
    }
    let mut colors = rgb.to_vec();
    for (i, share) in mask.iter().enumerate().filter(|(_, share)| (0.5..1.0).contains(*share)) {
        for value in colors[i..].iter_mut().step_by(mask.len()) {
            *value = (*value / share).clamp(-1.0, 1.0);
        }
    }
    Cow::Owned(colors)
}

/// Runs the regressor on a window of one batch of views: both photographs (`pair` 0), or two unseen sides. `maps`
/// `[2, S, S, 3]` are their points on the device. Views without a valid pixel have no part.
fn regress(
    network: &Regressor,
    config: &Config,
    pair: usize,
    views: &[CanvasView],
    maps: Tensor<4>,
    window: &Window,
) -> Vec<Part> {
    let is_geometric = config.regressor.start() == RegressorStart::Geometric;
    let limits = Limits::of(&config.regressor, pair);
    let (side, device) = (config.network.resolution, maps.device());
    let (h, w) = (window.rows.len(), window.columns.len());
    let colors: Vec<f32> = views.iter().flat_map(|view| window.crop(view.image, 3, side)).collect();
    let colors = Tensor::<4>::from_data(TensorData::new(colors, [views.len(), 3, h, w]), &device);
    let points = maps.narrow(1, window.rows.start, h).narrow(2, window.columns.start, w);
    let input = Tensor::cat(vec![colors, points.clone().permute([0, 3, 1, 2])], 1);
    let features = network.forward(input);
    let mut parts = Vec::new();
    for (i, view) in views.iter().enumerate() {
        let rows = window.indices(view.valid, side);
        if rows.is_empty() {
            continue;
        }
        let pick = |x: Tensor<4>, c: usize| taken(x.narrow(0, i, 1).reshape([h * w, c]), &rows);
        let geometry = is_geometric.then(|| Geometry::new(view, config, side, limits, &device));
        parts.push(Part {
            features: pick(features.clone(), FEATURES),
            points: pick(points.clone(), 3),
            geometry,
            origins: view.origins(),
        });
    }
    parts
}

/// Gaussians of the geometry alone, without a regressor, in the front camera's frame. Every valid point of views on a
/// canvas of `side`² pixels becomes a round Gaussian of its pixel's colour. σ is 0.3 times the distance of its
/// neighbours (docs/method.md, "Geometric start").
pub fn geometric(views: &[CanvasView], side: usize, device: &Device) -> Gaussians {
    let config = Config::default();
    let parts = views.iter().filter(|view| view.valid.contains(&true));
    let parts = parts.map(|view| uncorrected(view, &config, side, device)).collect();
    assemble(parts, device).0
}

/// The part of a view without corrections by a regressor, with the limits of photographs.
fn uncorrected(view: &CanvasView, config: &Config, side: usize, device: &Device) -> Part {
    let limits = Limits::of(&config.regressor, 0);
    let origins = view.origins();
    let n = origins.len();
    let points = origins.iter().flat_map(|origin| &view.points[3 * origin.pixel as usize..][..3]);
    let points = points.copied().collect::<Vec<f32>>();
    Part {
        features: Tensor::zeros([n, FEATURES], device),
        points: Tensor::from_data(TensorData::new(points, [n, 3]), device),
        geometry: Some(Geometry::new(view, config, side, limits, device)),
        origins,
    }
}

/// Activates and joins the parts: Gaussians in the front camera's frame, and their pixels. Gaussians with a feature
/// that is not finite, or with a centre beyond 1e30 m, are left out.
fn assemble(parts: Vec<Part>, device: &Device) -> (Gaussians, Vec<Origin>) {
    /// Coordinates beyond this could overflow on their way to the world frame.
    const FARTHEST: f32 = 1e30;
    if parts.is_empty() {
        return (none(device), Vec::new());
    }
    let (mut features, mut gaussians, mut origins) = (Vec::new(), Vec::new(), Vec::new());
    for part in parts {
        let Attributes { opacity, scale, rotation, color, offset } =
            Attributes::new(part.features.clone(), part.geometry);
        let (opacities, colors) = (opacity.squeeze_dim(1), color * 0.5 + 0.5);
        let made = Gaussians::new(part.points + offset, rotation, scale, opacities, colors);
        gaussians.push(made.expect("consistent by construction"));
        features.push(part.features);
        origins.extend(part.origins);
    }
    let gaussians = Gaussians::joined(&gaussians);
    let (features, means) =
        (Tensor::cat(features, 0).without_autodiff(), gaussians.means.clone().without_autodiff());
    // 0 for sound rows. The product of 0 with NaN or infinity is NaN.
    let unsound = (features * 0.0).sum_dim(1)
        + means.clone().abs().greater_elem(FARTHEST).float().sum_dim(1)
        + (means * 0.0).sum_dim(1);
    let unsound = host(unsound);
    let keep: Vec<i32> = (0..unsound.len()).filter(|i| unsound[*i] == 0.0).map(|i| i as i32).collect();
    match keep.len() {
        0 => (none(device), Vec::new()),
        kept if kept < origins.len() => {
            (rows(&gaussians, &keep), keep.iter().map(|row| origins[*row as usize]).collect())
        }
        _ => (gaussians, origins),
    }
}

fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|set| **set).count()
}

fn none(device: &Device) -> Gaussians {
    let empty = |c: usize| Tensor::<2>::zeros([0, c], device);
    Gaussians::new(empty(3), empty(4), empty(3), Tensor::zeros([0], device), empty(3))
        .expect("consistent by construction")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::random_regressors;

    /// The first limit of `regressor.color_limits` is for the photographs, the second for all surfaces of the sides.
    #[test]
    fn colours_of_photographs_and_sides_have_their_own_limits() {
        let (side, device) = (16, Device::flex());
        let mut config = Config::default();
        config.network.resolution = side;
        config.regressor.start = Some(RegressorStart::Geometric);
        config.regressor.color_limits = [0.03, 0.2];
        // Random weights for a geometric start have a last layer of zeros.
        let network = &random_regressors(&Config::default(), 5, &device)[0];
        let value = |i: usize| (i * 37 % 101) as f32 / 101.0;
        let image: Vec<f32> = (0..3 * side * side).map(|i| 0.8 * value(i) - 0.4).collect();
        let points: Vec<f32> =
            (0..side * side).flat_map(|i| [(i % side) as f32, (i / side) as f32, 300.0 + value(i)]).collect();
        let points: Vec<f32> = points.into_iter().map(|v| 0.007 * v).collect();
        let maps =
            Tensor::from_data(TensorData::new([&*points, &points].concat(), [2, side, side, 3]), &device);
        let valid = vec![true; side * side];
        for (pair, limit) in [(0, 0.03), (1, 0.2), (2, 0.2)] {
            let view = |view| CanvasView { view, image: &image, points: &points, valid: &valid };
            let views = [View::Front, View::Back].map(view);
            let parts = regress(network, &config, pair, &views, maps.clone(), &Window::whole(side));
            let (gaussians, _) = assemble(parts, &device);
            let colors = host(gaussians.colors);
            let worst = colors.chunks_exact(3).enumerate().fold(0.0_f32, |worst, (i, color)| {
                let own = [0, 1, 2].map(|c| 0.5 * image[c * side * side + i % (side * side)] + 0.5);
                (0..3).fold(worst, |worst, c| worst.max((color[c] - own[c]).abs()))
            });
            assert!(worst <= limit + 1e-6 && worst > 0.9 * limit, "pair {pair}: {worst}");
        }
    }

    #[test]
    fn straight_colours_of_rims_are_not_mixed_with_grey() {
        // Five pixels: background, less than half, half, a tenth of background, all of them the person's.
        let mask = [0.0, 0.4, 0.5, 0.9, 1.0];
        let own = [0.8, -0.6, 1.0];
        let rgb: Vec<f32> = own.iter().flat_map(|c| mask.map(|share| c * share)).collect();
        let colors = |start| {
            let config = RegressorConfig { start: Some(start), ..RegressorConfig::default() };
            photograph_colors(&config, &rgb, &mask).into_owned()
        };
        assert_eq!(colors(RegressorStart::Published), rgb);
        for (c, plane) in colors(RegressorStart::Geometric).chunks_exact(5).enumerate() {
            assert_eq!(plane[..2], rgb[5 * c..5 * c + 2]);
            assert!(plane[2..].iter().all(|value| (value - own[c]).abs() < 1e-6), "{plane:?}");
        }
        // A white pixel under a lossy mask stays a colour.
        let config = RegressorConfig { start: Some(RegressorStart::Geometric), ..RegressorConfig::default() };
        assert_eq!(*photograph_colors(&config, &[0.9, -0.9, 0.9], &[0.6]), [1.0, -1.0, 1.0]);
    }

    /// The second Gaussian has a feature, the fourth a centre that is not finite. The others keep their pixels.
    #[test]
    fn lost_gaussians_take_no_others_pixel_away() {
        let device = Device::flex();
        let tensor = |columns: usize, bad: usize| {
            let value = |i: usize| if i == bad { f32::NAN } else { 0.1 };
            let values: Vec<f32> = (0..5 * columns).map(value).collect();
            Tensor::<2>::from_data(TensorData::new(values, [5, columns]), &device)
        };
        let origins = (0..5).map(|i| Origin { view: (i != 4).then_some(View::Back), pixel: 7 * i }).collect();
        let part = Part {
            features: tensor(FEATURES, FEATURES + 2),
            points: tensor(3, 3 * 3 + 1),
            geometry: None,
            origins,
        };
        let (gaussians, kept) = assemble(vec![part], &device);
        assert_eq!(gaussians.len(), 3);
        let expected = [(Some(View::Back), 0), (Some(View::Back), 14), (None, 28)];
        assert_eq!(kept, expected.map(|(view, pixel)| Origin { view, pixel }));
    }
}
