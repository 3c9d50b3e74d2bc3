//! The interface between a stage of the training and the training loop.

use std::collections::BTreeMap;

use burn::tensor::Tensor;
use image::RgbImage;
use snapsnap_net::Window;

use crate::Result;
use crate::data::Data;
use crate::networks::Networks;
use crate::ranks::Ranks;

/// A part of a loss.
#[derive(Debug, Clone)]
pub struct Part {
    /// Name in logs.
    pub name: &'static str,
    /// Its weight in the sum.
    pub weight: f64,
    /// Its value `[1]`.
    pub value: Tensor<1>,
}

/// Place of a batch in the training.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Moment {
    /// Number of earlier steps.
    pub step: u64,
    /// Number of samples of the batch that lower ranks have.
    pub first: usize,
    /// The box around the people of the whole batch, as [`Task::extent`] finds it.
    pub extent: Option<Window>,
}

/// Result of a validation.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// Score by which the best weights are chosen. Lower is better.
    pub score: f64,
    /// Named figures for logs.
    pub figures: Vec<(&'static str, f64)>,
}

/// A stage of the training.
pub trait Task: Sync {
    /// A sample on the host.
    type Item: Clone + Send + Sync + 'static;

    /// 1 or 2.
    const STAGE: u32;

    /// Samples of the training and of its validations.
    fn data(&self) -> &Data<Self::Item>;

    /// Name of a sample: its data set, subject and view.
    fn name(item: &Self::Item) -> &str;

    /// The box around the people in these samples' photographs, if the networks need it for a whole batch.
    fn extent(&self, _items: &[Self::Item]) -> Option<Window> {
        None
    }

    /// Parts of the loss of a batch, or of one rank's share of it. The loss of a whole batch is the mean of its shares'
    /// losses, weighted with their numbers of samples. Empty if no sample shows a person.
    ///
    /// # Errors
    /// [`TrainError`](crate::TrainError) if the batch cannot be used.
    fn losses(&self, networks: &Networks, items: Vec<Self::Item>, at: Moment) -> Result<Vec<Part>>;

    /// Compares predictions for held-out people with the ground truth; `None` without such people. `networks` have no
    /// gradients. Ranks share the samples, and all get the same result.
    ///
    /// # Errors
    /// [`TrainError`](crate::TrainError) if a sample cannot be read.
    fn validate(&self, _networks: &Networks, _ranks: &Ranks) -> Result<Option<Validation>> {
        Ok(None)
    }

    /// A picture of the predictions for a few samples. `networks` are as in [`Self::validate`].
    ///
    /// # Errors
    /// [`TrainError`](crate::TrainError) if a sample cannot be read.
    fn preview(&self, _networks: &Networks) -> Result<Option<RgbImage>> {
        Ok(None)
    }

    /// Frozen weights that are written beside the trained ones, in the layout of checkpoints.
    fn frozen(&self) -> BTreeMap<String, Vec<f32>> {
        BTreeMap::new()
    }
}
