//! A frozen point predictor.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_data::sample::Stage2Item;
use snapsnap_net::config::Config;
use snapsnap_net::network::PointPredictor;

use super::maps::Maps;
use crate::TrainError;
use crate::config::TrainConfig;
use crate::networks::Networks;
use crate::points::{Prediction, predict, window};
use crate::precision::{Precision, lower};

/// A predictor without gradients.
pub(super) struct Frozen {
    pub networks: Networks,
    /// The predictor in the training's precision, on each training device.
    lowered: Vec<PointPredictor>,
    precision: Precision,
    /// Cached point maps, if configured.
    maps: Option<Maps>,
}

impl Frozen {
    /// `predictor` has no gradients and is on the first device.
    pub fn new(config: &TrainConfig, predictor: PointPredictor, devices: &[Device]) -> Self {
        let maps = config.stage2.point_map_cache.as_ref();
        let maps = maps.map(|folder| Maps::new(folder, &config.networks(), &predictor));
        let precision = config.training.precision;
        let networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
        let lowered = lower(precision, &networks).predictor.expect("there is one");
        let lowered = devices.iter().map(|device| lowered.clone().fork(&device.clone().inner())).collect();
        Self { networks, lowered, precision, maps }
    }

    /// Predicts the points of a sample's photographs on `device`. `place` is the index of the training device in a
    /// step, and `None` in a validation, which is in f32.
    pub fn predict(
        &self,
        config: &Config,
        item: &Stage2Item,
        place: Option<usize>,
        device: &Device,
    ) -> Result<Prediction, TrainError> {
        let (predictor, precision) = match (place, &self.networks.predictor) {
            (Some(place), _) => (&self.lowered[place], self.precision),
            (None, predictor) => (predictor.as_ref().expect("set in `new`"), Precision::F32),
        };
        let made = || of_sample(predictor, config, item, device);
        match &self.maps {
            Some(maps) => {
                let window = || window(config, &item.masks, item.side);
                maps.of(item, window, (device, precision), made)
            }
            None => Ok(made()),
        }
    }
}

/// A predictor's point maps of one sample.
pub(super) fn of_sample(
    predictor: &PointPredictor,
    config: &Config,
    item: &Stage2Item,
    device: &Device,
) -> Prediction {
    let side = item.side;
    let images = TensorData::new(item.images.clone(), [1, 2, 3, side, side]);
    let masks = TensorData::new(item.masks.clone(), [1, 2, side, side]);
    let (images, masks) = (Tensor::from_data(images, device), Tensor::from_data(masks, device));
    predict(predictor, config, images, &masks)
}
