//! A frozen point predictor.

use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_data::sample::Stage2Item;
use snapsnap_net::Prediction;
use snapsnap_net::config::Config;
use snapsnap_net::network::PointPredictor;
use snapsnap_net::steps::Record;

use crate::config::TrainConfig;
use crate::networks::Networks;
use crate::precision::lower;

/// A predictor without gradients.
pub(super) struct Frozen {
    pub networks: Networks,
    /// The predictor in the training's precision.
    lowered: PointPredictor,
}

impl Frozen {
    /// `predictor` has no gradients.
    pub fn new(config: &TrainConfig, predictor: PointPredictor) -> Self {
        let networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
        let lowered = lower(config.training.precision, &networks).predictor.expect("there is one");
        Self { networks, lowered }
    }

    /// The predictor of a step, or of a validation, which is in f32.
    pub fn predictor(&self, is_step: bool) -> &PointPredictor {
        if is_step { &self.lowered } else { self.networks.predictor.as_ref().expect("set in `new`") }
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
    let images = item.photographs.each_ref().map(|photo| &*photo.rgb).concat();
    let images = Tensor::from_data(TensorData::new(images, [1, 2, 3, side, side]), device);
    let masks = item.photographs.each_ref().map(|photo| &*photo.mask).concat();
    let masks = Tensor::from_data(TensorData::new(masks, [1, 2, side, side]), device);
    Prediction::new(predictor, config, images, &masks, None, &mut Record::default())
}
