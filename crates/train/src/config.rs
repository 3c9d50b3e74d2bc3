//! The TOML schema of a training: the networks' sections and the sections of data, steps, optimiser and losses.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::outside;
use snapsnap_data::sample::{Augment, SampleConfig};
use snapsnap_net::config::{ConfMode, Config, ModeConfig, NetworkConfig, Precision, RegressorConfig, Schema};

use crate::optimizer::OptimizerConfig;
use crate::schedule::Schedule;

/// Most steps of a training.
pub const MAX_STEPS: u64 = 100_000_000;

/// All settings of a training. The default is the published training.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// The point predictor.
    pub network: NetworkConfig,
    /// The Gaussian regressor.
    pub regressor: RegressorConfig,
    /// Quirks of the published code.
    pub mode: ModeConfig,
    /// Data sets. `--data` replaces them.
    pub data: DataSets,
    /// Samples.
    pub samples: SampleConfig,
    /// Steps, batches and reports.
    pub training: TrainingConfig,
    /// The optimiser.
    pub optimizer: OptimizerConfig,
    /// Learning rates over the steps.
    pub schedule: Schedule,
    /// Stage 1's losses.
    pub stage1: Stage1Config,
    /// Stage 2's losses.
    pub stage2: Stage2Config,
}

/// The section `[data]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataSets {
    /// Folders of data sets. Their people are mixed.
    pub folders: Vec<PathBuf>,
}

/// The section `[training]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingConfig {
    /// Optimiser steps.
    pub steps: usize,
    /// Samples per batch.
    pub batch: usize,
    /// Decay of the exponential moving average of the weights. The average is validated and written; 0: the weights
    /// themselves.
    pub ema_decay: f64,
    /// Weight file to begin with, trained by this program or imported. `--weights` replaces it. Without one, stage 1
    /// begins with random weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<PathBuf>,
    /// Seed of random weights, of samples and of their order.
    pub seed: u64,
    /// Threads that make samples.
    pub workers: usize,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// Steps between two validations; 0: only at the end.
    pub validate_every: usize,
    /// Samples of a validation; 0: none.
    pub validation_samples: usize,
    /// Steps between two checkpoints; 0: only at the end.
    pub checkpoint_every: usize,
    /// Steps between two previews; 0: only at the end.
    pub preview_every: usize,
    /// Number format of the point predictor's layers. The device must support it.
    pub precision: Precision,
}

/// The section `[stage1]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage1Config {
    /// Whether only `network.details` is trained. The other layers keep the weights with which the training begins.
    pub only_details: bool,
    /// Weight of the mean error of differences between pixels that are 1, 2, 4 and 8 apart.
    pub relief_weight: f64,
}

/// The section `[stage2]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage2Config {
    /// Whether views follow the published curriculum: the sides with a penalty on scales, then front and back, then
    /// all.
    pub curriculum: bool,
    /// Weight of the mean absolute difference of coverage and mask.
    pub alpha_weight: f64,
    /// Weight of stage 1's loss while the point predictor is trained as well; 0: it is frozen.
    pub points_weight: f64,
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            steps: 100_000,
            batch: 1,
            ema_decay: 0.0,
            weights: None,
            seed: 3407,
            workers: 1,
            log_every: 10,
            validate_every: 2000,
            validation_samples: 50,
            checkpoint_every: 1000,
            preview_every: 2000,
            precision: Precision::F32,
        }
    }
}

impl Schema for TrainConfig {
    fn refusal(&self) -> Option<(String, String)> {
        self.networks().refusal().or_else(|| self.problem())
    }
}

impl TrainConfig {
    /// The part of the config that a weight file contains.
    pub fn networks(&self) -> Config {
        let network = NetworkConfig { precision: self.training.precision, ..self.network.clone() };
        Config { network, regressor: self.regressor.clone(), mode: self.mode.clone() }
    }

    /// The samples' config, with the settings of the sections `[mode]`, `[network]` and `[training]` that concern
    /// samples.
    pub fn samples(&self) -> SampleConfig {
        let compat = self.mode.compat;
        SampleConfig {
            compat,
            high_resolution: compat,
            augment: if compat { Augment::none() } else { self.samples.augment.clone() },
            sides: self.network.side_heads,
            second_depth: self.network.second_layer,
            person_height: self.networks().person_height(),
            pair_degrees: self.network.pair_degrees,
            seed: self.training.seed,
            ..self.samples.clone()
        }
    }

    fn problem(&self) -> Option<(String, String)> {
        let (t, two) = (&self.training, &self.stage2);
        let ranges = [
            ("training.steps", t.steps as f64, 1.0..=MAX_STEPS as f64),
            ("training.batch", t.batch as f64, 1.0..=4096.0),
            ("training.workers", t.workers as f64, 1.0..=256.0),
            ("training.log_every", t.log_every as f64, 1.0..=1e6),
            ("training.validation_samples", t.validation_samples as f64, 0.0..=1e5),
            ("training.ema_decay", t.ema_decay, 0.0..=0.999_999),
            ("stage1.relief_weight", self.stage1.relief_weight, 0.0..=1e6),
            ("stage2.alpha_weight", two.alpha_weight, 0.0..=1e6),
            ("stage2.points_weight", two.points_weight, 0.0..=1e6),
        ];
        if let Some((key, message)) = outside(ranges) {
            return Some((key.into(), message));
        }
        let refuse = |key: &str, message: &str| Some((key.to_owned(), message.to_owned()));
        let details = self.network.details.as_ref();
        let is_used = details.is_some_and(|details| details.resolution <= self.network.resolution);
        if self.stage1.only_details && !is_used {
            let message = "needs `network.details`, whose resolution is at most the canvas'";
            return refuse("stage1.only_details", message);
        }
        if t.precision == Precision::F16 {
            let message = "must be \"f32\" or \"bf16\": small gradients vanish in f16";
            return refuse("training.precision", message);
        }
        if self.network.conf_mode != ConfMode::Sigmoid {
            return refuse("network.conf_mode", "must be \"sigmoid\" to be trained");
        }
        if two.curriculum && !self.network.side_heads {
            let message =
                "must be false with `network.side_heads = false`: the curriculum begins with the sides";
            return refuse("stage2.curriculum", message);
        }
        if two.points_weight > 0.0 && two.curriculum {
            let message = "must be 0 with `stage2.curriculum = true`, which renders parts of a person";
            return refuse("stage2.points_weight", message);
        }
        // What the file says: a key that is not there has the default of trainings.
        let said = Augment { is_photographic: false, ..self.samples.augment.clone() };
        let unsaid = Augment { is_photographic: false, ..Augment::default() };
        if self.mode.compat && ![Augment::none(), unsaid].contains(&said) {
            return refuse("samples.augment", "must be off with `mode.compat = true`");
        }
        if let Some((key, message)) = self.samples().problem() {
            return Some((format!("samples.{key}"), message));
        }
        if let Some((key, message)) = self.optimizer.problem() {
            return Some((format!("optimizer.{key}"), message));
        }
        self.schedule.problem(t.steps).map(|(key, message)| (format!("schedule.{key}"), message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(name: &str) -> TrainConfig {
        let path = format!("{}/../../configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        TrainConfig::from_file(path.as_ref(), &[]).expect("makes sense")
    }

    #[test]
    fn all_configs_make_sense_and_both_stages_are_of_the_same_predictor() {
        for size in ["tiny", "small", "full", "studies", "default"] {
            let [one, two] = [1, 2].map(|stage| read(&format!("{size}/stage{stage}")));
            assert_eq!(one.network, two.network, "{size}");
            assert_eq!(one.mode, two.mode, "{size}");
            let again = TrainConfig::from_toml(&two.to_toml(), "itself", &[]).expect("its own");
            assert_eq!(again, two);
        }
        assert_eq!(read("default/regressor").regressor, read("default/stage2").regressor);
        assert!(read("default/details").stage1.only_details);
    }

    /// Keys that the files leave out have the published values.
    #[test]
    fn full_is_the_papers() {
        let published = TrainConfig {
            mode: ModeConfig { compat: true, ..ModeConfig::default() },
            ..TrainConfig::default()
        };
        let [one, two] = ["full/stage1", "full/stage2"].map(read);
        assert_eq!(one.networks().resolved(), published.networks().resolved());
        assert_eq!(
            (one.samples(), &one.optimizer),
            (SampleConfig { seed: 3407, person_height: 700, ..SampleConfig::compat() }, &published.optimizer)
        );
        assert_eq!((one.schedule, &one.stage1), (published.schedule, &published.stage1));
        assert_eq!((one.training.steps, one.training.batch), (100_000, 1));
        assert_eq!((two.training.steps, two.stage2.curriculum), (50_000, true));
        assert_eq!((two.schedule, &two.optimizer), (one.schedule, &one.optimizer));
    }
}
