//! The TOML schema of a benchmark.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::{Schema, outside};

use crate::evaluate::config::{DataSection, EvalConfig, MetricsSection, Protocol, ViewsSection};
use crate::variant::Variant;

/// The config of a benchmark.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BenchConfig {
    /// The people.
    pub data: DataSection,
    /// Number of runs, and measurement of errors.
    pub bench: BenchSection,
    /// The model under test.
    pub model: Variant,
    /// Variants of the model by name.
    pub settings: BTreeMap<String, Variant>,
    /// Trainings whose validations become a curve.
    pub training: TrainingSection,
}

/// The section `[bench]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BenchSection {
    /// Number of timed reconstructions.
    pub runs: usize,
    /// Number of reconstructions before the timed ones.
    pub warm_up: usize,
    /// Number of people whose pictures are compared.
    pub people: usize,
    /// Number of compared views of each person, at equal angles.
    pub views: usize,
    /// Side of the compared pictures in pixels; 0: the data set's side.
    pub resolution: usize,
    /// Side of the patch of a picture that the f64 oracle renders.
    pub oracle: u32,
    /// Folder with the published weights of LPIPS.
    pub lpips: PathBuf,
}

impl Default for BenchSection {
    fn default() -> Self {
        let lpips = "weights".into();
        Self { runs: 20, warm_up: 3, people: 6, views: 8, resolution: 0, oracle: 48, lpips }
    }
}

impl BenchSection {
    /// The least work that runs every part, for continuous integration.
    pub fn quick(self) -> Self {
        Self { runs: 2, warm_up: 1, people: 1, views: 2, oracle: 8, ..self }
    }
}

/// The section `[training]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingSection {
    /// Folders of runs.
    pub runs: Vec<PathBuf>,
}

/// Name of the model under test in reports.
const AS_IT_IS: &str = "as it is";

impl BenchConfig {
    /// The model under test, and the settings with all their keys, in the order of the report.
    pub fn variants(&self) -> Vec<(String, Variant)> {
        let merged = |(name, setting): (&String, &Variant)| (name.clone(), setting.clone().over(&self.model));
        let mut settings: Vec<(String, Variant)> = self.settings.iter().map(merged).collect();
        settings.sort_by_key(|(_, setting)| {
            (setting.scene.clone(), setting.omits.is_some(), setting.knob.clone())
        });
        settings.insert(0, (AS_IT_IS.to_owned(), self.model.clone()));
        settings
    }

    /// The config of the evaluation of a variant's pictures.
    pub(super) fn evaluation(&self, variant: &Variant) -> EvalConfig {
        let only = variant.only.as_ref().unwrap_or(&self.data.only).clone();
        let (inputs, resolution) = (variant.inputs.clone().unwrap_or_default(), self.bench.resolution);
        let metrics = MetricsSection::default();
        EvalConfig {
            data: DataSection { subjects: self.bench.people, only, ..self.data.clone() },
            views: ViewsSection { inputs, resolution, ..ViewsSection::default().of(variant) },
            metrics: MetricsSection { protocols: vec![Protocol::Masked], geometry: false, ..metrics },
            ..EvalConfig::default()
        }
    }
}

impl Schema for BenchConfig {
    fn refusal(&self) -> Option<(String, String)> {
        let b = &self.bench;
        let counts = [
            ("bench.runs", b.runs, 1..=10_000),
            ("bench.warm_up", b.warm_up, 0..=1000),
            ("bench.people", b.people, 1..=100_000),
            ("bench.views", b.views, 1..=4096),
            ("bench.oracle", b.oracle as usize, 1..=1024),
        ];
        if let Some((key, message)) = outside(counts) {
            return Some((key.into(), message));
        }
        if self.settings.contains_key(AS_IT_IS) {
            return Some(("settings".into(), format!("`{AS_IT_IS}` is the name of the model under test")));
        }
        let has_control = |(name, s): &(String, &Variant)| {
            let texts = [Some(name), s.scene.as_ref(), s.omits.as_ref(), s.knob.as_ref()];
            texts.into_iter().flatten().any(|text| text.contains(char::is_control))
        };
        let settings = self.settings.iter().map(|(name, setting)| (format!("settings.{name}"), setting));
        let all: Vec<(String, &Variant)> = settings.chain([("model".into(), &self.model)]).collect();
        if all.iter().any(has_control) {
            return Some(("settings".into(), "a name has control characters".into()));
        }
        all.into_iter().find_map(|(section, variant)| {
            let (key, message) = variant.refusal()?;
            Some((format!("{section}.{key}"), message))
        })
    }
}
