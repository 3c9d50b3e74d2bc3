//! A frozen point predictor.

use snapsnap_net::network::PointPredictor;

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
