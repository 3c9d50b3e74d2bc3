//! The Gaussians of a sample, their targets, and differences from the targets.

use std::ops::Range;

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_data::sample::Stage2Item;
use snapsnap_eval::similarity::ssim_gaussian;
use snapsnap_net::config::Config;
use snapsnap_net::network::View;
use snapsnap_net::painter::{Painted, Painter};
use snapsnap_net::steps::Record;
use snapsnap_net::{Points, Prediction, backing, placed};
use snapsnap_ops::mean;
use snapsnap_splat::Gaussians;

use crate::networks::Networks;

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

/// Gaussians of a sample in the data set's world; none if no pixel is valid.
pub(super) fn gaussians(
    config: &Config,
    networks: &Networks,
    item: &Stage2Item,
    prediction: Prediction,
    phase: &Phase,
    device: &Device,
) -> Gaussians {
    // As in use.
    let has_backing = !config.mode.compat && prediction.maps.len() > 2;
    let mut points = Points::new(prediction.pasted(&config.network));
    let painter = Painter {
        config,
        regressors: &networks.regressors,
        photographs: item.photographs.each_ref(),
        views: phase.views.clone(),
        side_colors: true,
    };
    let Painted { mut gaussians, mut origins, .. } =
        painter.gaussians(&mut points, device, &mut Record::default());
    if gaussians.is_empty() {
        return gaussians;
    }
    if has_backing && let Some((backing, more)) = backing(&gaussians, &origins, config) {
        gaussians = Gaussians::joined(&[gaussians, backing]);
        origins.extend(more);
    }
    let to_world = item.cameras[View::Front as usize].world_to_camera.inverse();
    let person = match &item.restoration {
        Some(restoration) => restoration.person(gaussians, &origins),
        None => gaussians,
    };
    placed(config, person, &to_world)
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

/// Mean absolute difference and mean structural similarity, each `[1]`, of pictures `[B,C,H,W]` with values in [0, 1].
pub fn photometric(image: Tensor<4>, target: Tensor<4>) -> [Tensor<1>; 2] {
    let l1 = mean((image.clone() - target.clone()).abs());
    [l1, mean(ssim_gaussian(image, target))]
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
}
