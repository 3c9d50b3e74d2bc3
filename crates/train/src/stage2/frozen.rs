//! A point predictor that stays as it is.

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

/// A predictor that is not even differentiated.
pub(super) struct Frozen {
    pub networks: Networks,
    /// The same in the precision of the training, on each device that trains.
    lowered: Vec<PointPredictor>,
    precision: Precision,
    /// What it made so far, if that is kept.
    maps: Option<Maps>,
}

impl Frozen {
    /// `predictor` is not tracked and on the first of the devices.
    pub fn new(config: &TrainConfig, predictor: PointPredictor, devices: &[Device]) -> Self {
        let maps = config.stage2.point_map_cache.as_ref();
        let maps = maps.map(|folder| Maps::new(folder, &config.networks(), &predictor));
        let precision = config.training.precision;
        let networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
        let lowered = lower(precision, &networks).predictor.expect("there is one");
        let lowered = devices.iter().map(|device| lowered.clone().fork(&device.clone().inner())).collect();
        Self { networks, lowered, precision, maps }
    }

    /// What it makes of a sample's photographs: in a step on one of the devices, which is given by its place and as it
    /// is without gradients, or, with no place, for a validation, in f32.
    pub fn predict(
        &self,
        config: &Config,
        item: &Stage2Item,
        place: Option<usize>,
        device: &Device,
    ) -> Result<Prediction, TrainError> {
        let (predictor, precision) = match (place, &self.networks.predictor) {
            (Some(place), _) => (&self.lowered[place], self.precision),
            (None, predictor) => (predictor.as_ref().expect("set when made"), Precision::F32),
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

/// What a predictor makes of a sample's photographs.
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
