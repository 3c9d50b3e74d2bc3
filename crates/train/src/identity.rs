//! The identity of a run: its settings, data and frozen predictor. A run is not continued with others.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use snapsnap_base::FileError;
use snapsnap_base::config::{differences, keys};
use snapsnap_data::dataset::Folder;
use snapsnap_data::dataset::Split::{self, Train, Val};

use crate::Result;
use crate::config::TrainConfig;
use crate::task::Task;

/// Keys that may change between the sessions of a run: its length, its reports, the speed of its loader, and paths. The
/// files behind the paths have hashes of their own, or are no longer read.
const FREE: [&str; 8] = [
    "data.folders",
    "training.checkpoint_every",
    "training.log_every",
    "training.preview_every",
    "training.steps",
    "training.validate_every",
    "training.weights",
    "training.workers",
];
/// Sections of the networks. A state of other networks cannot be used.
const NETWORKS: [&str; 3] = ["network.", "regressor.", "mode."];

/// Prefixes of the keys that decide what a validation measures, besides the data.
const VALIDATION: [&str; 2] = ["samples.", "training.validation_samples"];
/// Prefix of the keys of [`VALIDATION`] that affect training samples alone.
const TRAINING_ALONE: &str = "samples.augment.";

/// Settings, data and frozen predictor of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct Identity {
    /// The config's keys with their values, without the keys that may change.
    config: BTreeMap<String, String>,
    /// Fingerprints of the data sets.
    data: Vec<String>,
    /// Fingerprints of the people of the validations. Earlier states have none.
    #[serde(default)]
    validated: Vec<String>,
    /// Hash of the frozen point predictor.
    predictor: Option<String>,
}

impl Identity {
    /// The identity of a run of `task`.
    ///
    /// # Errors
    /// [`TrainError::File`](crate::TrainError::File) if a file of a data set cannot be read.
    pub fn of<T: Task>(task: &T, config: &TrainConfig) -> Result<Self> {
        let mut own = keys(config);
        own.retain(|key, _| !FREE.contains(&key.as_str()));
        let folders = &task.data().folders;
        let fingerprints = |splits: &[Split]| {
            let has_any = |folder: &&Arc<Folder>| {
                let there = folder.splits();
                splits.iter().any(|split| there.contains(&Some(*split)))
            };
            let some = folders.iter().filter(has_any);
            some.map(|folder| folder.fingerprint(splits)).collect::<Result<_, FileError>>()
        };
        let frozen = task.frozen();
        let predictor = (!frozen.is_empty()).then(|| {
            let mut hash = Sha256::new();
            for (name, values) in frozen {
                hash.update(name);
                values.into_iter().for_each(|value| hash.update(value.to_le_bytes()));
            }
            format!("{:x}", hash.finalize())
        });
        let (data, validated) = (fingerprints(&[Train, Val])?, fingerprints(&[Val])?);
        Ok(Self { config: own, data, validated, predictor })
    }

    /// Differences from the identity `there`: of the networks, and of everything else.
    pub fn differences(&self, there: &Self) -> [Vec<String>; 2] {
        let mut harmful = Vec::new();
        let mut harmless = Vec::new();
        for (key, message) in differences(&there.config, &self.config) {
            let is_network = NETWORKS.iter().any(|section| key.starts_with(section));
            if is_network { &mut harmful } else { &mut harmless }.push(message);
        }
        if there.data != self.data {
            harmless.push("the data sets have other content".to_owned());
        }
        if there.predictor != self.predictor {
            harmless.push("the frozen point predictor has other weights".to_owned());
        }
        [harmful, harmless]
    }

    /// Whether scores of validations do not compare with the scores of the identity `there`.
    pub fn validates_otherwise(&self, there: &Self) -> bool {
        let is_other = differences(&there.config, &self.config).iter().any(|(key, _)| {
            VALIDATION.iter().any(|start| key.starts_with(start)) && !key.starts_with(TRAINING_ALONE)
        });
        let has_others = match there.validated.is_empty() {
            true => there.data != self.data,
            false => there.validated != self.validated,
        };
        is_other || has_others || there.predictor != self.predictor
    }

    /// Why a run with the identity `there` cannot be continued as this one, or not without `force`.
    pub fn refusal(&self, there: &Self, force: bool) -> Option<String> {
        let [harmful, harmless] = self.differences(there);
        let message =
            |differences: &[String]| format!("is the state of another run: {}", differences.join("; "));
        match (harmful.is_empty(), harmless.is_empty() || force) {
            (true, true) => None,
            (true, false) => Some(format!("{}. Add --force to continue it anyway", message(&harmless))),
            (false, _) => Some(message(&harmful)),
        }
    }
}
