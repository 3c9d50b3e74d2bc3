//! The samples of a training and of its validations.

use std::sync::Arc;

use burn::data::dataset::Dataset;
use burn::data::dataset::transform::ComposedDataset;
use serde::Serialize;
use serde::de::DeserializeOwned;
use snapsnap_base::FileError;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::sample::{Augment, SampleConfig, Stage};

use crate::config::TrainConfig;
use crate::ranks::Ranks;
use crate::{Result, TrainError};

/// The samples of a training and of its validations, from all data sets.
pub struct Data<I> {
    pub(crate) folders: Vec<Arc<Folder>>,
    training: Vec<Stage<I>>,
    /// Samples that are the same in every validation, from the data sets with the configured split.
    validation: ComposedDataset<Stage<I>>,
    /// Number of samples of a validation.
    pub count: usize,
}

impl<I: Clone + Send + Sync + 'static> Data<I> {
    /// `new` makes the samples of one data set. `samples` is the config of the training's samples.
    pub(crate) fn new(
        folders: &[Arc<Folder>],
        config: &TrainConfig,
        samples: &SampleConfig,
        new: impl Fn(Arc<Folder>, Option<Split>, SampleConfig) -> Result<Stage<I>, FileError>,
    ) -> Result<Self> {
        let mut training = Vec::new();
        for folder in folders {
            let (there, needed) = (folder.description().resolution as usize, config.network.resolution);
            if there != needed {
                let root = folder.root().display();
                let message = format!("{root}: has views of {there}² pixels, network.resolution is {needed}");
                return Err(TrainError::Unsuitable(message));
            }
            // Some data sets have people of the validation alone.
            let splits = folder.splits();
            if splits.contains(&Some(Split::Train)) || !splits.contains(&Some(Split::Val)) {
                training.push(new(folder.clone(), Some(Split::Train), samples.clone())?);
            }
        }
        if training.is_empty() {
            return Err(TrainError::Unsuitable("no data set has people of the split train".into()));
        }
        let wanted = Some(Split::Val);
        let wished = config.training.validation_samples;
        let (mut there, mut people) = (Vec::new(), 0);
        for folder in folders.iter().filter(|folder| wished > 0 && folder.splits().contains(&wanted)) {
            let count = folder.subjects(wanted)?.len();
            people += count;
            there.extend((count > 0).then_some(folder));
        }
        // Photographs without augmentation, and enough samples of each person.
        let fixed = SampleConfig {
            repeat: wished.div_ceil(people.max(1)).max(1),
            augment: Augment::none(),
            seed: 0,
            ..config.samples()
        };
        let sets = there.into_iter().map(|folder| new(folder.clone(), wanted, fixed.clone()));
        let validation = ComposedDataset::new(sets.collect::<Result<_, _>>()?);
        let count = wished.min(validation.len());
        Ok(Self { folders: folders.to_vec(), training, validation, count })
    }

    /// The samples of a pass over the data. Each pass has its own random choices.
    pub fn pass(&self, pass: u64) -> ComposedDataset<Stage<I>> {
        ComposedDataset::new(self.training.iter().map(|set| set.with_epoch(pass)).collect())
    }

    /// Calls `add` for this rank's share of the validation's samples. Returns the sums of all ranks, on all ranks. If a
    /// sample of any rank fails, all ranks get an error.
    pub(crate) fn validated<S: Clone + Default + Serialize + DeserializeOwned>(
        &self,
        ranks: &Ranks,
        mut add: impl FnMut(&mut S, I) -> Result<()>,
    ) -> Result<Vec<S>> {
        let mut sum = S::default();
        let mut share = ranks.share(self.count);
        let failed = share.try_for_each(|place| add(&mut sum, self.validated_item(place, self.count)?)).err();
        ranks.agree(failed)?;
        Ok(ranks.gather(&sum))
    }

    /// At most `count` samples of the validation, spread over all data sets.
    pub(crate) fn validation(&self, count: usize) -> impl Iterator<Item = Result<I>> {
        let count = count.min(self.count);
        (0..count).map(move |place| self.validated_item(place, count))
    }

    /// One of `count` samples that are spread over all data sets.
    fn validated_item(&self, place: usize, count: usize) -> Result<I> {
        let item = self.validation.get(place * self.validation.len() / count);
        item.map_err(|e| TrainError::Unsuitable(e.to_string()))
    }
}
