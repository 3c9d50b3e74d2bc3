//! The TOML schema of a training: the networks' sections and those of data, steps, optimiser and losses.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::{Removed, outside};
use snapsnap_data::dataset::Split;
use snapsnap_data::sample::SampleConfig;
use snapsnap_eval::lpips::MIN_SIDE;
use snapsnap_net::config::{ConfMode, Config, ModeConfig, NetworkConfig, Precision, RegressorConfig, Schema};

use crate::optimizer::OptimizerConfig;
use crate::schedule::Schedule;

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
    /// Batches per step.
    pub accumulate: usize,
    /// Largest norm of all gradients together. Larger gradients are scaled down to it.
    pub clip: f64,
    /// Decay of the exponential moving average of the weights. The average is validated and written; 0: the weights
    /// themselves.
    pub ema_decay: f64,
    /// Weight file to begin with, trained by this program or imported. `--weights` replaces it. Without one, stage 1
    /// begins with random weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<PathBuf>,
    /// Seed of random weights and of the order of samples.
    pub seed: u64,
    /// People in random order instead of one after another.
    pub shuffle: bool,
    /// Threads that make samples.
    pub workers: usize,
    /// Batches that are loaded in advance.
    pub prefetch: usize,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// Steps between two validations; 0: only at the end.
    pub validate_every: usize,
    /// Samples of a validation; 0: none.
    pub validation_samples: usize,
    /// People of the validations.
    pub validate_on: ValidationSplit,
    /// Steps between two checkpoints; 0: only at the end.
    pub checkpoint_every: usize,
    /// Steps between two previews; 0: only at the end.
    pub preview_every: usize,
    /// Number format of the point predictor's layers. The device must support it.
    pub precision: Precision,
}

/// People of the validations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ValidationSplit {
    /// Held-out people.
    Val,
    /// People of the training set, to test whether they can be learned at all.
    Train,
}

impl ValidationSplit {
    /// The split of a data set.
    pub fn split(self) -> Split {
        match self {
            Self::Val => Split::Val,
            Self::Train => Split::Train,
        }
    }
}

/// The section `[stage1]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage1Config {
    /// λ: the weight of the confidences' cross-entropy. The published code has 0.5, the paper 1.
    pub confidence_weight: f64,
    /// Weight of the mean error of differences between pixels that are 1, 2, 4 and 8 apart.
    pub relief_weight: f64,
}

/// The section `[stage2]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage2Config {
    /// β: the share of the L1 loss. The rest is the share of the structural dissimilarity.
    pub l1_share: f64,
    /// Whether views follow the published curriculum: the sides with a penalty on scales, then front and back, then
    /// all.
    pub curriculum: bool,
    /// Weight of the mean absolute difference of coverage and mask.
    pub alpha_weight: f64,
    /// Weight of the anisotropy penalty: the logarithm of a Gaussian's ratio of axes, longest to shortest, above
    /// `anisotropy_limit`.
    pub anisotropy_weight: f64,
    /// Largest ratio of the longest to the shortest axis without a penalty.
    pub anisotropy_limit: f64,
    /// Perceptual distance, in the last steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<LpipsConfig>,
    /// Weight of stage 1's loss while the point predictor is trained as well; 0: it is frozen.
    pub points_weight: f64,
}

/// The section `[stage2.lpips]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LpipsConfig {
    /// Weight of the mean distance.
    pub weight: f64,
    /// Share of the steps before the distance becomes part of the loss.
    #[serde(default = "late")]
    pub after: f64,
    /// Weights of torchvision's AlexNet and of the learned layers of LPIPS v0.1, `.pth` or `.safetensors`.
    pub files: Vec<PathBuf>,
}

fn late() -> f64 {
    0.8
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            steps: 100_000,
            batch: 1,
            accumulate: 1,
            clip: 1.0,
            ema_decay: 0.0,
            weights: None,
            seed: 3407,
            shuffle: true,
            workers: 1,
            prefetch: 2,
            log_every: 10,
            validate_every: 2000,
            validation_samples: 50,
            validate_on: ValidationSplit::Val,
            checkpoint_every: 1000,
            preview_every: 2000,
            precision: Precision::F32,
        }
    }
}

impl Default for Stage1Config {
    fn default() -> Self {
        Self { confidence_weight: 0.5, relief_weight: 0.0 }
    }
}

impl Default for Stage2Config {
    fn default() -> Self {
        Self {
            l1_share: 0.8,
            curriculum: false,
            alpha_weight: 0.0,
            anisotropy_weight: 0.0,
            anisotropy_limit: 8.0,
            lpips: None,
            points_weight: 0.0,
        }
    }
}

impl Schema for TrainConfig {
    const RENAMED: &'static [(&'static str, &'static str)] = &[
        ("samples.place", "samples.placed_share"),
        ("samples.supervision", "samples.random_targets"),
        ("samples.augment.mirror", "samples.augment.flip"),
        ("training.average", "training.ema_decay"),
        ("training.start", "training.weights"),
        ("stage1.confidence", "stage1.confidence_weight"),
        ("stage2.beta", "stage2.l1_share"),
        ("stage2.alpha", "stage2.alpha_weight"),
        ("stage2.needle", "stage2.anisotropy_weight"),
        ("stage2.anisotropy", "stage2.anisotropy_limit"),
        ("stage2.points", "stage2.points_weight"),
    ];

    const REMOVED: &'static [Removed] = &[
        Config::GONE,
        &[
            ("samples.augment.blur", &["0.0"]),
            ("samples.augment.noise", &["0.0"]),
            ("training.gradient_checkpointing", &["false"]),
            ("stage1.normals_weight", &["0.05", "0.0"]),
            ("stage2.point_noise", &["0.0"]),
            ("stage2.point_map_cache", &[]),
        ],
    ];

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

    /// The samples' config, with what the sections `[mode]` and `[network]` say of photographs.
    pub fn samples(&self) -> SampleConfig {
        SampleConfig {
            sides: self.network.side_heads,
            person_height: self.networks().person_height(),
            pair_degrees: self.network.pair_degrees,
            ..self.samples.clone()
        }
    }

    fn problem(&self) -> Option<(String, String)> {
        let (t, two) = (&self.training, &self.stage2);
        let lpips = two.lpips.as_ref();
        let ranges = [
            ("training.steps", t.steps as f64, 1.0..=1e8),
            ("training.batch", t.batch as f64, 1.0..=4096.0),
            ("training.accumulate", t.accumulate as f64, 1.0..=4096.0),
            ("training.workers", t.workers as f64, 1.0..=256.0),
            ("training.prefetch", t.prefetch as f64, 0.0..=256.0),
            ("training.log_every", t.log_every as f64, 1.0..=1e6),
            ("training.validation_samples", t.validation_samples as f64, 0.0..=1e5),
            ("training.clip", t.clip, 1e-9..=1e9),
            ("training.ema_decay", t.ema_decay, 0.0..=0.999_999),
            ("stage1.confidence_weight", self.stage1.confidence_weight, 0.0..=1e6),
            ("stage1.relief_weight", self.stage1.relief_weight, 0.0..=1e6),
            ("stage2.l1_share", two.l1_share, 0.0..=1.0),
            ("stage2.alpha_weight", two.alpha_weight, 0.0..=1e6),
            ("stage2.anisotropy_weight", two.anisotropy_weight, 0.0..=1e6),
            ("stage2.anisotropy_limit", two.anisotropy_limit, 1.0..=1e6),
            ("stage2.points_weight", two.points_weight, 0.0..=1e6),
            ("stage2.lpips.weight", lpips.map_or(0.0, |lpips| lpips.weight), 0.0..=1e6),
            ("stage2.lpips.after", lpips.map_or(0.0, |lpips| lpips.after), 0.0..=1.0),
        ];
        if let Some((key, message)) = outside(ranges) {
            return Some((key.into(), message));
        }
        let refuse = |key: &str, message: &str| Some((key.to_owned(), message.to_owned()));
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
        if lpips.is_some_and(|lpips| lpips.files.is_empty()) {
            return refuse("stage2.lpips.files", "must name AlexNet and the learned layers");
        }
        if lpips.is_some() && self.network.resolution < MIN_SIDE {
            let message = format!("needs `network.resolution` of at least {MIN_SIDE}");
            return refuse("stage2.lpips", &message);
        }
        if let Some((key, message)) = self.samples.problem() {
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
    }

    #[test]
    fn former_names_are_refused_with_the_present_ones() {
        for (old, new) in TrainConfig::RENAMED {
            let refused =
                TrainConfig::from_toml("", "x", &[format!("{old}=1")]).expect_err("former").to_string();
            assert!(refused.ends_with(&format!("`{old}` is now called `{new}`")), "{refused}");
            assert_ne!(old, new);
        }
    }

    /// Keys that the files leave out have the published values.
    #[test]
    fn full_is_the_papers() {
        let published = TrainConfig {
            mode: ModeConfig { compat: true, ..ModeConfig::default() },
            samples: SampleConfig::compat(),
            ..TrainConfig::default()
        };
        let [one, two] = ["full/stage1", "full/stage2"].map(read);
        assert_eq!(one.networks().resolved(), published.networks().resolved());
        assert_eq!((&one.samples, &one.optimizer), (&published.samples, &published.optimizer));
        assert_eq!((one.schedule, &one.stage1), (published.schedule, &published.stage1));
        assert_eq!((one.training.steps, one.training.batch, one.training.clip), (100_000, 1, 1.0));
        assert_eq!((two.training.steps, two.stage2.l1_share, two.stage2.curriculum), (50_000, 0.8, true));
        assert_eq!((two.schedule, &two.optimizer), (one.schedule, &one.optimizer));
    }
}
