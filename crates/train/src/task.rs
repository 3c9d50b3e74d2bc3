//! What a stage of the training is to the loop that runs it.

use std::collections::BTreeMap;

use burn::tensor::Tensor;
use image::RgbImage;
use snapsnap_data::sample::Joined;

use crate::TrainError;
use crate::networks::Networks;

/// One of the summands of a loss.
#[derive(Debug, Clone)]
pub struct Part {
    /// For logs.
    pub name: &'static str,
    /// Its factor in the sum.
    pub weight: f64,
    /// Its value `[1]`.
    pub value: Tensor<1>,
}

/// When a batch is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// Steps before this one.
    pub step: u64,
    /// Batches of this step before this one.
    pub batch: u64,
    /// Number of the device among those that train.
    pub device: usize,
}

/// What a validation found.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// What the best weights are chosen by: less is better.
    pub score: f64,
    /// Figures with their units, for people.
    pub figures: Vec<(&'static str, f64)>,
}

/// A stage of the training.
pub trait Task: Sync {
    /// A sample on the host.
    type Item: Send + Sync + 'static;

    /// 1 or 2.
    const STAGE: u32;

    /// The samples of a pass over the data; every pass makes other random choices.
    fn samples(&self, pass: u64) -> Joined<Self::Item>;

    /// What a sample was made of.
    fn name(item: &Self::Item) -> &str;

    /// The loss of a batch, computed where `networks` are: on the moment's device. Empty if nothing of the batch can be
    /// trained on.
    ///
    /// # Errors
    /// [`TrainError`] if the batch cannot be used.
    fn losses(
        &self,
        networks: &Networks,
        items: Vec<Self::Item>,
        at: Moment,
    ) -> Result<Vec<Part>, TrainError>;

    /// Compares what the networks, which are not tracked and on the first device, make of people set apart; `None` if there are none.
    ///
    /// # Errors
    /// [`TrainError`] if a sample cannot be read.
    fn validate(&self, networks: &Networks) -> Result<Option<Validation>, TrainError>;

    /// A picture of what the networks, which are not tracked and on the first device, make of a few samples.
    ///
    /// # Errors
    /// [`TrainError`] if a sample cannot be read.
    fn preview(&self, networks: &Networks) -> Result<Option<RgbImage>, TrainError>;

    /// Weights to be written beside the trained ones, as checkpoints lay them out.
    fn frozen(&self, _networks: &Networks) -> BTreeMap<String, Vec<f32>> {
        BTreeMap::new()
    }
}
