//! The Gaussians of a sample, and their targets.

use std::ops::Range;

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_data::sample::Stage2Item;
use snapsnap_net::config::Config;
use snapsnap_net::gaussians::{
    CanvasView, Chosen, assemble, photograph_colors, placed, regress, side_images,
};
use snapsnap_net::network::View;
use snapsnap_net::{Window, carve};
use snapsnap_ops::{host, mean};
use snapsnap_splat::Gaussians;

use crate::networks::Networks;
use crate::points::Prediction;

/// Steps at which the published curriculum changes from the sides to front and back, and from these to all views
/// (docs/method.md, "Losses of stage 2").
const CURRICULUM: [u64; 2] = [2000, 4000];
/// Step until which the published curriculum renders one view per step. Later it renders all.
const ONE_VIEW: u64 = 10_000;
/// Weight of the mean scale while the published curriculum trains the sides alone.
const SCALE_PENALTY: f64 = 2.0;

/// Gaussians and targets of a step.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Phase {
    /// Views whose Gaussians are rendered; second surfaces belong to the sides.
    pub views: Range<usize>,
    /// Weight of the mean scale.
    pub scale_weight: f64,
    /// Whether a step has only one target.
    pub one_view: bool,
}

impl Phase {
    pub fn new(curriculum: bool, step: u64) -> Self {
        let one_view = curriculum && step < ONE_VIEW;
        match step {
            _ if !curriculum => Self { views: 0..4, scale_weight: 0.0, one_view },
            step if step < CURRICULUM[0] => Self { views: 2..4, scale_weight: SCALE_PENALTY, one_view },
            step if step < CURRICULUM[1] => Self { views: 0..2, scale_weight: 0.0, one_view },
            _ => Self { views: 0..4, scale_weight: 0.0, one_view },
        }
    }
}

/// Gaussians of a sample in the data set's world; `None` if no pixel is valid. `noise` returns random shifts of the
/// points in metres.
pub(super) fn gaussians(
    config: &Config,
    networks: &Networks,
    item: &Stage2Item,
    prediction: Prediction,
    phase: &Phase,
    noise: Option<&mut dyn FnMut() -> f32>,
    device: &Device,
) -> Option<Gaussians> {
    let side = item.side;
    let area = side * side;
    let (mut points, mut conf, mut maps) = (Vec::new(), Vec::new(), Vec::new());
    let masks = TensorData::new(item.masks.clone(), [1, 2, side, side]);
    let masks = Tensor::from_data(masks, &prediction.maps[0].1.points.device());
    for (_, map) in prediction.pasted(&config.network, &masks) {
        points.extend(host(map.points.clone()));
        conf.extend(host(map.conf));
        maps.push(map.points);
    }
    let views = points.len() / (3 * area);
    if let Some(noise) = noise.filter(|_| networks.predictor.is_none()) {
        // Every view's points are shifted together, like the errors of predictions.
        for view in points.chunks_exact_mut(3 * area) {
            let shift = [noise(), noise(), noise()];
            view.chunks_exact_mut(3).for_each(|p| (0..3).for_each(|c| p[c] += shift[c]));
        }
    }
    let masks = [0, 1].map(|view| {
        item.masks[view * area..(view + 1) * area].iter().map(|share| *share > 0.5).collect::<Vec<_>>()
    });
    let masks = [&*masks[0], &*masks[1]];
    let can_move = views > 2 && config.network.hull_reach() > 0.0;
    let predicted = (can_move && networks.predictor.is_some()).then(|| points.clone());
    carve(&config.network, masks, &mut points, &conf);
    let valid = Chosen::new(&config.network, masks, &points, &conf).valid;
    let photos = [0, 1].map(|view| {
        let rgb = &item.images[3 * view * area..3 * (view + 1) * area];
        photograph_colors(&config.regressor, rgb, &item.masks[view * area..(view + 1) * area])
    });
    let photos = [&*photos[0], &*photos[1]];
    let sides = if views > 2 { side_images(photos, &points, &valid) } else { Vec::new() };
    let images: Vec<&[f32]> = photos.into_iter().chain(sides.iter().map(Vec::as_slice)).collect();
    let points = if networks.predictor.is_some() {
        // Gradients of the pictures reach a predictor that is trained.
        let maps = Tensor::cat(maps, 0);
        match predicted {
            Some(predicted) => shifted(maps, &predicted, &points),
            None => maps,
        }
    } else {
        // An overflow would spoil the normalisation of the whole view.
        points.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
        Tensor::<4>::from_data(TensorData::new(points, [views, side, side, 3]), device)
    };
    let mut parts = Vec::new();
    for (pair, first) in (0..views).step_by(2).enumerate().filter(|(_, v)| phase.views.contains(&(*v).min(2)))
    {
        let person = Window::around(valid[first..first + 2].iter().map(Vec::as_slice), side);
        let Some(person) = person else { continue };
        let window =
            if config.crop() { person.padded(config.regressor.margin(), side) } else { Window::whole(side) };
        let regressor = &networks.regressors[pair.min(networks.regressors.len() - 1)];
        let seen: Vec<_> = (first..first + 2)
            .map(|v| CanvasView {
                image: images[v],
                points: points.clone().narrow(0, v, 1),
                valid: &valid[v],
            })
            .collect();
        parts.extend(regress(regressor, config, pair, &seen, &window));
    }
    if parts.is_empty() {
        return None;
    }
    let (gaussians, lost) = assemble(config, parts, device);
    let to_world = item.cameras[View::Front as usize].world_to_camera.inverse();
    if gaussians.is_empty() {
        return None;
    }
    let person = match &item.restoration {
        Some(restoration) => {
            // If Gaussians were left out, the photographs of the others are not known.
            let is_known = lost == 0 && phase.views.start == 0;
            let count = |view: usize| valid[view].iter().filter(|valid| is_known && **valid).count();
            restoration.person(gaussians, [count(0), count(1)])
        }
        None => gaussians,
    };
    Some(placed(config, person.scaled(item.scale), &to_world))
}

/// Points `[V,S,S,3]` whose values `before` have become those of `now`; their gradient stays.
fn shifted(points: Tensor<4>, before: &[f32], now: &[f32]) -> Tensor<4> {
    // The difference of values that are not finite, which do not change, would be NaN.
    let shift = |(before, now): (&f32, &f32)| if now.is_finite() { now - before } else { 0.0 };
    let shifts: Vec<f32> = before.iter().zip(now).map(shift).collect();
    let shifts = TensorData::new(shifts, points.dims());
    let device = points.device();
    points + Tensor::from_data(shifts, &device)
}

/// Target pictures `[V,3,h,w]` and masks `[V,h,w]` of the views with these indices.
pub(super) fn targets(item: &Stage2Item, views: &[usize], device: &Device) -> (Tensor<4>, Tensor<3>) {
    let (side, count) = (item.target_side, views.len());
    let area = side * side;
    let pick = |values: &[f32], size: usize| -> Vec<f32> {
        views.iter().flat_map(|v| values[v * size..(v + 1) * size].iter().copied()).collect()
    };
    let pictures = TensorData::new(pick(&item.targets, 3 * area), [count, 3, side, side]);
    let masks = TensorData::new(pick(&item.target_masks, area), [count, side, side]);
    (Tensor::from_data(pictures, device), Tensor::from_data(masks, device))
}

/// Anisotropy penalty of Gaussians with `scales` `[N,3]`: the mean of max(0, ln(longest / shortest axis) − ln(limit)).
/// (A penalty on the mean scale has little effect on a few long Gaussians.)
pub fn anisotropy_penalty(scales: &Tensor<2>, limit: f64) -> Tensor<1> {
    let logs = scales.clone().clamp_min(1e-12).log();
    let ratio = logs.clone().max_dim(1) - logs.min_dim(1);
    mean((ratio - limit.ln()).clamp_min(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_curriculum_goes_from_the_sides_to_all_views() {
        let phase = |step| Phase::new(true, step);
        assert_eq!(phase(0), Phase { views: 2..4, scale_weight: 2.0, one_view: true });
        assert_eq!(phase(1999), phase(0));
        assert_eq!(phase(2000), Phase { views: 0..2, scale_weight: 0.0, one_view: true });
        assert_eq!(phase(4000), Phase { views: 0..4, scale_weight: 0.0, one_view: true });
        assert_eq!(phase(10_000), Phase { views: 0..4, scale_weight: 0.0, one_view: false });
        assert_eq!(Phase::new(false, 0), phase(10_000));
    }

    #[test]
    fn a_shift_changes_points_and_not_their_gradients() {
        let device = Device::flex().autodiff();
        let (before, now) = ([1.0, 2.0, 3.0, f32::INFINITY], [1.0, 2.5, -3.0, f32::INFINITY]);
        let points = Tensor::<4>::from_data(TensorData::new(before.to_vec(), [1, 2, 2, 1]), &device);
        let points = points.require_grad();
        let moved = shifted(points.clone(), &before, &now);
        assert_eq!(host(moved.clone()), now);
        let weights = Tensor::from_data(TensorData::new(vec![1.0_f32, 2.0, 3.0, 0.0], [1, 2, 2, 1]), &device);
        let gradient = points.grad(&(moved * weights).sum().backward()).expect("a tracked tensor");
        assert_eq!(host(gradient), [1.0, 2.0, 3.0, 0.0]);
    }

    #[test]
    fn only_anisotropy_above_the_limit_costs() {
        let device = Device::flex();
        let scales = Tensor::<2>::from_floats([[0.01, 0.01, 0.08], [0.01, 0.1, 1.0]], &device);
        let cost = host(anisotropy_penalty(&scales, 10.0))[0];
        assert!((cost - 10.0_f32.ln() / 2.0).abs() < 1e-5, "{cost}");
    }
}
