//! From point maps to Gaussians, as inference and training do it: side colours, the regressor on a window, activations.

use std::borrow::Cow;

use burn::tensor::{Device, Int, Tensor, TensorData};
use glam::DVec3;
use snapsnap_ops::host;
use snapsnap_ops::rows::taken;
use snapsnap_splat::{Camera, Gaussians, RigidTransform};

use crate::config::{Config, NetworkConfig, RegressorConfig, RegressorStart, RotationFrame};
use crate::crop::Window;
use crate::hull::Hull;
use crate::regressor::{Attributes, FEATURES, Geometry, Limits, Regressor, Statistics};
use crate::sides::{Cloud, EMPTY, is_finite};

/// One view on its square canvas of side S.
pub struct CanvasView<'a> {
    /// `[3, S, S]` colours in [−1, 1], a photograph's or a side's pseudo image.
    pub image: &'a [f32],
    /// `[1, S, S, 3]` metres, front camera's frame; tracked if the predictor is trained too.
    pub points: Tensor<4>,
    /// `[S, S]`: whether a pixel becomes a Gaussian.
    pub valid: &'a [bool],
}

/// Features of one view's N valid pixels.
pub struct Part {
    features: Tensor<2>,
    points: Tensor<2>,
    geometry: Option<Geometry>,
}

/// The pixels of each view that become Gaussians.
pub struct Chosen {
    /// `[S, S]` of every view.
    pub valid: Vec<Vec<bool>>,
    /// Pixels left out because their points are not finite.
    pub lost: usize,
    /// Pixels of the sides left out because they lie outside of the photographs' silhouettes.
    pub outside: usize,
    /// Pixels left out because their points lie between two surfaces.
    pub between: usize,
}

impl Chosen {
    /// Selects pixels of photographs by their masks `[S, S]`, and pixels of the sides by their confidences `[V, S, S]` and
    /// their points `[V, S, S, 3]`, metres, front camera's frame.
    pub fn new(config: &NetworkConfig, masks: [&[bool]; 2], points: &[f32], conf: &[f32]) -> Self {
        let (side, area) = (config.resolution, config.resolution * config.resolution);
        let views = conf.len() / area;
        let hull = config.hull_margin.filter(|_| views > 2);
        let hull = hull.map(|margin| Hull::new(masks, side, margin * side / 1024));
        let (mut lost, mut outside) = (0, 0);
        let mut keep = |view: usize, i: usize| {
            let at = view * area + i;
            let is_chosen = match masks.get(view) {
                Some(mask) => mask[i],
                None => conf[at] > config.conf_threshold,
            };
            if !is_chosen {
                return false;
            }
            let point = [points[3 * at], points[3 * at + 1], points[3 * at + 2]];
            if !is_finite(&point) {
                lost += 1;
                return false;
            }
            let is_inside = view < 2 || hull.as_ref().is_none_or(|hull| hull.contains(point));
            outside += usize::from(!is_inside);
            is_inside
        };
        let mut valid: Vec<Vec<bool>> =
            (0..views).map(|view| (0..area).map(|i| keep(view, i)).collect()).collect();
        let mut between = 0;
        if let Some(steepest) = config.steepest {
            for (view, points) in valid.iter_mut().zip(points.chunks_exact(3 * area)) {
                between += without_steep(view, points, side, steepest);
            }
        }
        Self { valid, lost, outside, between }
    }
}

/// Width in metres of a pixel of the nominal cameras at the person's distance, on a canvas of `side`² pixels.
pub(crate) fn pixel_width(side: usize) -> f32 {
    let nominal = Camera::orbit_at_yaw_degrees(0.0, side as u32);
    ((nominal.centre() * DVec3::new(1.0, 0.0, 1.0)).length() / nominal.focal.x) as f32
}

/// Takes away the valid pixels of a view whose points `[S, S, 3]`, metres, are further from a neighbour's than `steepest` times the
/// width of a pixel at the person's distance. Returns their number.
pub(crate) fn without_steep(valid: &mut [bool], points: &[f32], side: usize, steepest: f32) -> usize {
    let farthest = (steepest * pixel_width(side)).powi(2);
    let squared = |i: usize, j: usize| -> f32 {
        (0..3).map(|axis| (points[3 * i + axis] - points[3 * j + axis]).powi(2)).sum()
    };
    let mut steep = vec![false; valid.len()];
    for i in (0..valid.len()).filter(|&i| valid[i]) {
        for j in [(i % side + 1 < side).then_some(i + 1), Some(i + side)].into_iter().flatten() {
            if valid.get(j) == Some(&true) && squared(i, j) > farthest {
                (steep[i], steep[j]) = (true, true);
            }
        }
    }
    valid.iter_mut().zip(&steep).for_each(|(valid, steep)| *valid &= !steep);
    steep.into_iter().filter(|steep| *steep).count()
}

/// Colours `[3, S, S]` in [−1, 1] of a photograph for its Gaussians. The input is multiplied by the `mask` `[S, S]`, so
/// the rim, from which the sides get their colours, fades to grey. With `regressor.straight_color` it is divided by the mask
/// where the person covers at least half of a pixel.
pub fn photograph_colors<'a>(config: &RegressorConfig, rgb: &'a [f32], mask: &[f32]) -> Cow<'a, [f32]> {
    if !config.straight_color {
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

/// Pseudo images of the sides' maps `[3, S, S]`: every valid pixel has the colour of the nearest valid point of the
/// photographs `[3, S, S]`. `points` are all views' `[V, S, S, 3]`.
pub fn side_images(photos: [&[f32]; 2], points: &[f32], valid: &[Vec<bool>]) -> Vec<Vec<f32>> {
    let area = valid[0].len();
    let point = |view: usize, i: usize| -> [f32; 3] {
        let at = 3 * (view * area + i);
        [points[at], points[at + 1], points[at + 2]]
    };
    let cloud = Cloud::new((0..2).flat_map(|view| {
        let (photo, mask) = (photos[view], &valid[view]);
        (0..area).filter(|&i| mask[i]).map(move |i| (point(view, i), pixel(photo, area, i)))
    }));
    (2..valid.len()).map(|view| paint(cloud.as_ref(), |i| point(view, i), &valid[view])).collect()
}

fn paint(cloud: Option<&Cloud>, point: impl Fn(usize) -> [f32; 3], valid: &[bool]) -> Vec<f32> {
    let area = valid.len();
    let mut image = vec![EMPTY; 3 * area];
    let Some(cloud) = cloud else { return image };
    let pixels: Vec<usize> = (0..area).filter(|&i| valid[i]).collect();
    let points: Vec<[f32; 3]> = pixels.iter().map(|&i| point(i)).collect();
    for (&i, color) in pixels.iter().zip(cloud.nearest_colors(&points)) {
        for (channel, value) in color.into_iter().enumerate() {
            image[channel * area + i] = value;
        }
    }
    image
}

fn pixel(rgb: &[f32], area: usize, i: usize) -> [f32; 3] {
    [rgb[i], rgb[area + i], rgb[2 * area + i]]
}

/// The regressor on a window of some views, which are one batch: both photographs (`pair` 0), or the two unseen sides. Views
/// without a valid pixel have no part.
pub fn regress(
    network: &Regressor,
    config: &Config,
    pair: usize,
    views: &[CanvasView],
    window: &Window,
) -> Vec<Part> {
    let limits = Limits::of(&config.regressor, pair);
    let (side, device) = (config.network.resolution, views[0].points.device());
    let (h, w) = (window.rows.len(), window.columns.len());
    let (colors, points): (Vec<_>, Vec<_>) = views
        .iter()
        .map(|view| {
            let crop = TensorData::new(window.crop(view.image, 3, side), [1, 3, h, w]);
            let points =
                view.points.clone().narrow(1, window.rows.start, h).narrow(2, window.columns.start, w);
            (Tensor::<4>::from_data(crop, &device), points)
        })
        .unzip();
    let points = Tensor::cat(points, 0);
    let input = Tensor::cat(vec![Tensor::cat(colors, 0), points.clone().permute([0, 3, 1, 2])], 1);
    let features = network.forward(input, &mut Statistics::measured());
    let mut parts = Vec::new();
    for (i, view) in views.iter().enumerate() {
        let rows = window.indices(view.valid, side);
        if rows.is_empty() {
            continue;
        }
        let pick = |x: Tensor<4>, c: usize| taken(x.narrow(0, i, 1).reshape([h * w, c]), &rows);
        let geometry = Geometry::is_needed(&config.regressor)
            .then(|| Geometry::new(view.image, &view.points, view.valid, side, limits));
        parts.push(Part {
            features: pick(features.clone(), FEATURES),
            points: pick(points.clone(), 3),
            geometry,
        });
    }
    parts
}

/// Gaussians of the geometry alone, without a regressor, front camera's frame. Every valid point of some views becomes
/// a round Gaussian of its pixel's colour. σ is 0.3 times the distance of its neighbours
/// (docs/method.md, "Geometric start").
pub fn geometric(views: &[CanvasView], device: &Device) -> Gaussians {
    let regressor = RegressorConfig { start: Some(RegressorStart::Geometric), ..RegressorConfig::default() };
    let limits = Limits::of(&regressor, 0);
    let config = Config { regressor, ..Config::default() };
    let parts = views.iter().filter(|view| view.valid.contains(&true));
    let parts = parts.map(|view| uncorrected(view, limits)).collect();
    assemble(&config, parts, device).0
}

/// The part of a view to which no regressor adds anything.
pub fn uncorrected(view: &CanvasView, limits: Limits) -> Part {
    let side = view.points.dims()[1];
    let rows = Window::whole(side).indices(view.valid, side);
    Part {
        features: Tensor::zeros([rows.len(), FEATURES], &view.points.device()),
        points: taken(view.points.clone().reshape([side * side, 3]), &rows),
        geometry: Some(Geometry::new(view.image, &view.points, view.valid, side, limits)),
    }
}

/// Activates and joins the parts: Gaussians in the front camera's frame, and the number of those left out because a
/// feature is not finite or a centre lies beyond 1e30 m.
pub fn assemble(config: &Config, parts: Vec<Part>, device: &Device) -> (Gaussians, usize) {
    /// Coordinates beyond this could overflow on their way to the world frame.
    const FARTHEST: f32 = 1e30;
    if parts.is_empty() {
        return (none(device), 0);
    }
    let (mut features, mut points, mut attributes) = (Vec::new(), Vec::new(), Vec::new());
    for part in parts {
        attributes.push(Attributes::new(&config.regressor, part.features.clone(), part.geometry));
        features.push(part.features);
        points.push(part.points);
    }
    let (features, attributes) = (Tensor::cat(features, 0), Attributes::joined(attributes));
    let means = Tensor::cat(points, 0) + attributes.offset;
    let (raw, centres) = (host(features), host(means.clone()));
    let rows = raw.chunks_exact(FEATURES).zip(centres.chunks_exact(3)).enumerate();
    let sound = |raw: &[f32], centre: &[f32]| {
        raw.iter().all(|v| v.is_finite()) && centre.iter().all(|v| v.abs() <= FARTHEST)
    };
    let keep: Vec<i64> =
        rows.filter(|(_, (raw, centre))| sound(raw, centre)).map(|(i, _)| i as i64).collect();
    let (n, kept) = (means.dims()[0], keep.len());
    if kept == 0 {
        return (none(device), n);
    }
    let index = Tensor::<1, Int>::from_data(TensorData::new(keep, [kept]), &means.device());
    let pick = |x: Tensor<2>| if kept < n { x.select(0, index.clone()) } else { x };
    let gaussians = Gaussians::new(
        pick(means),
        pick(attributes.rotation),
        pick(attributes.scale),
        pick(attributes.opacity).squeeze_dim(1),
        pick(attributes.color) * 0.5 + 0.5,
    );
    (gaussians.expect("consistent by construction"), n - kept)
}

fn none(device: &Device) -> Gaussians {
    let empty = |c: usize| Tensor::<2>::zeros([0, c], device);
    Gaussians::new(empty(3), empty(4), empty(3), Tensor::zeros([0], device), empty(3))
        .expect("consistent by construction")
}

/// Gaussians of the front camera's frame in the frame that `camera_to_world` leads to.
pub fn placed(config: &Config, gaussians: Gaussians, camera_to_world: &RigidTransform) -> Gaussians {
    match config.rotation_frame() {
        RotationFrame::Camera => gaussians.transformed(camera_to_world),
        RotationFrame::World => gaussians.with_means_transformed(camera_to_world),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::random_regressors;

    /// A wall at two metres, half of which is a metre closer. The pixels along the step lie between both.
    #[test]
    fn points_between_two_surfaces_are_left_out() {
        let side = 8;
        let point = |i: usize| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            [0.3 * x, 0.3 * y, if x < 4.0 { 1.0 } else { 2.0 }]
        };
        let points: Vec<f32> = (0..64).flat_map(point).collect();
        // A pixel is 31 cm wide there; the step is 3.4 times as long as that, from a row's end to the next it is 7 times.
        for (steepest, step) in [(3.0, true), (4.0, false)] {
            let mut valid = vec![true; 64];
            valid[3] = false;
            let lost = without_steep(&mut valid, &points, side, steepest);
            let kept = |i: usize| i != 3 && !(step && i > 7 && matches!(i % side, 3 | 4));
            assert_eq!(valid, (0..64).map(kept).collect::<Vec<_>>());
            assert_eq!(lost, if step { 14 } else { 0 });
        }
    }

    /// The first limit of `regressor.color_limits` is the photographs', the second that of all surfaces of the sides.
    #[test]
    fn colours_of_photographs_and_sides_have_their_own_limits() {
        let (side, device) = (16, Device::flex());
        let mut config = Config::default();
        config.network.resolution = side;
        config.regressor.start = Some(RegressorStart::Geometric);
        config.regressor.color_limits = Some([0.03, 0.2]);
        // The published start has no layer of zeros.
        let mut published = config.clone();
        (published.regressor.start, published.regressor.color_limits) = (None, None);
        let network = &random_regressors(&published, 5, &device)[0];
        let value = |i: usize| (i * 37 % 101) as f32 / 101.0;
        let image: Vec<f32> = (0..3 * side * side).map(|i| 0.8 * value(i) - 0.4).collect();
        let points: Vec<f32> =
            (0..side * side).flat_map(|i| [(i % side) as f32, (i / side) as f32, 300.0 + value(i)]).collect();
        let points = Tensor::from_data(TensorData::new(points, [1, side, side, 3]), &device) * 0.007;
        let valid = vec![true; side * side];
        for (pair, limit) in [(0, 0.03), (1, 0.2), (2, 0.2)] {
            let view = || CanvasView { image: &image, points: points.clone(), valid: &valid };
            let parts = regress(network, &config, pair, &[view(), view()], &Window::whole(side));
            let (gaussians, _) = assemble(&config, parts, &device);
            let colors = host(gaussians.colors);
            let worst = colors.chunks_exact(3).enumerate().fold(0.0_f32, |worst, (i, color)| {
                let own = pixel(&image, side * side, i % (side * side)).map(|c| 0.5 * c + 0.5);
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
        let colors = |straight_color| {
            let config = RegressorConfig { straight_color, ..RegressorConfig::default() };
            photograph_colors(&config, &rgb, &mask).into_owned()
        };
        assert_eq!(colors(false), rgb);
        for (c, plane) in colors(true).chunks_exact(5).enumerate() {
            assert_eq!(plane[..2], rgb[5 * c..5 * c + 2]);
            assert!(plane[2..].iter().all(|value| (value - own[c]).abs() < 1e-6), "{plane:?}");
        }
        // A white pixel under a lossy mask stays a colour.
        let config = RegressorConfig { straight_color: true, ..RegressorConfig::default() };
        assert_eq!(*photograph_colors(&config, &[0.9, -0.9, 0.9], &[0.6]), [1.0, -1.0, 1.0]);
    }
}
