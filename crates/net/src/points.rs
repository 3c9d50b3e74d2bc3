//! The points of a pair of photographs, on the device and on the host.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_ops::host;

use crate::config::NetworkConfig;
use crate::hull::carve;
use crate::network::{PointMap, View};

/// The points of all views of one pair of photographs on the canvas, on the device and on the host.
#[derive(Debug, Clone)]
pub struct Points {
    /// `[V, S, S, 3]` metres, front camera's frame; tracked if the predictor is trained.
    pub maps: Tensor<4>,
    /// The values of `maps`.
    pub host: Vec<f32>,
    /// Confidences `[V, S, S]`.
    pub conf: Vec<f32>,
}

impl Points {
    /// Joins the maps of all views on the whole canvas, a batch of one.
    pub fn new(maps: Vec<(View, PointMap)>) -> Self {
        let (points, conf): (Vec<_>, Vec<_>) =
            maps.into_iter().map(|(_, map)| (map.points, map.conf)).unzip();
        let maps = Tensor::cat(points, 0);
        Self { host: host(maps.clone()), conf: host(Tensor::cat(conf, 0)), maps }
    }

    /// Moves points of the sides into the photographs' silhouettes, by their masks `[S, S]`, and brings the maps to
    /// `device`. Tracked maps keep their gradients. In other maps, values that are not finite become 0, since one of
    /// them would spoil the normalisation of a whole view. Returns the number of points that moved.
    pub(crate) fn carve(&mut self, config: &NetworkConfig, masks: [&[bool]; 2], device: &Device) -> usize {
        let is_tracked = self.maps.device().is_autodiff();
        let before = if is_tracked { self.host.clone() } else { Vec::new() };
        let moved = carve(config, masks, &mut self.host, &self.conf);
        if is_tracked {
            if moved > 0 {
                self.maps = shifted(self.maps.clone(), &before, &self.host);
            }
            return moved;
        }
        let is_finite = self.host.iter().all(|v| v.is_finite());
        if moved > 0 || !is_finite || self.maps.device() != *device {
            let usable = self.host.iter().map(|v| if v.is_finite() { *v } else { 0.0 }).collect::<Vec<_>>();
            self.maps = Tensor::from_data(TensorData::new(usable, self.maps.dims()), device);
        }
        moved
    }
}

/// Changes points `[V,S,S,3]` from the values `before` to the values `now`. Gradients pass unchanged.
fn shifted(points: Tensor<4>, before: &[f32], now: &[f32]) -> Tensor<4> {
    // Values that are not finite do not change; their difference would be NaN.
    let shift = |(before, now): (&f32, &f32)| if now.is_finite() { now - before } else { 0.0 };
    let shifts: Vec<f32> = before.iter().zip(now).map(shift).collect();
    let shifts = TensorData::new(shifts, points.dims());
    let device = points.device();
    points + Tensor::from_data(shifts, &device)
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
