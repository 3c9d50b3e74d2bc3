//! Samples that are the same in every validation, and checks of data sets.

use std::sync::Arc;

use burn::data::dataset::Dataset;
use snapsnap_base::FileError;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::sample::{Augment, Joined, SampleConfig};

use crate::TrainError;
use crate::config::{TrainConfig, ValidationSplit};

/// Samples of validations, from all data sets with the configured split.
pub(crate) struct Fixed<I> {
    samples: Joined<I>,
    /// Number of samples that are used.
    pub count: usize,
}

impl<I: Send + Sync + 'static> Fixed<I> {
    /// `samples` makes the samples of one data set.
    pub fn new(
        folders: &[Arc<Folder>],
        config: &TrainConfig,
        samples: impl Fn(Arc<Folder>, Option<Split>, SampleConfig) -> Result<Box<dyn Dataset<I>>, FileError>,
    ) -> Result<Self, TrainError> {
        let wanted = Some(match config.training.validate_on {
            ValidationSplit::Val => Split::Val,
            ValidationSplit::Train => Split::Train,
        });
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
        let sets = there.into_iter().map(|folder| samples(folder.clone(), wanted, fixed.clone()));
        let samples = Joined::new(sets.collect::<Result<_, _>>()?);
        let count = wished.min(samples.len());
        Ok(Self { samples, count })
    }

    /// Indices of `count` samples, spread over all data sets.
    pub fn indices(&self, count: usize) -> impl Iterator<Item = usize> {
        let (len, count) = (self.samples.len(), count.min(self.count));
        (0..count).map(move |i| i * len / count)
    }

    /// One sample.
    pub fn get(&self, index: usize) -> Result<I, TrainError> {
        self.samples.get(index).map_err(|e| TrainError::Unsuitable(e.to_string()))
    }
}

/// Refuses data sets whose views have another size than the canvas.
pub(crate) fn check_resolution(folder: &Folder, config: &TrainConfig) -> Result<(), TrainError> {
    let (there, wanted) = (folder.description().resolution as usize, config.network.resolution);
    if there == wanted {
        return Ok(());
    }
    Err(TrainError::Unsuitable(format!(
        "{}: has views of {there}² pixels, network.resolution is {wanted}",
        folder.root().display()
    )))
}
