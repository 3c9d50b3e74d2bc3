//! The TOML schema of a benchmark.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::Schema;
use snapsnap_net::precision::Precision;

use crate::evaluate::config::{DataSection, Preset, views_problem};

/// Everything that decides what a benchmark computes.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BenchConfig {
    /// Who is looked at.
    pub data: DataSection,
    /// How often, and how errors are found.
    pub bench: BenchSection,
    /// What all settings begin with.
    pub model: Setting,
    /// By name, what each changes; the model as it is comes first.
    pub settings: BTreeMap<String, Setting>,
    /// Trainings whose validations become a curve.
    pub training: TrainingSection,
}

/// The section `[bench]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BenchSection {
    /// Reconstructions that are timed.
    pub runs: usize,
    /// Reconstructions before these.
    pub warm_up: usize,
    /// People whose pictures are compared.
    pub people: usize,
    /// Views of each, evenly around.
    pub views: usize,
    /// Side of the pictures that are compared; 0: the data set's.
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
    /// A look at everything that says little: for continuous integration.
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

/// A section `[settings.NAME]`, or `[model]`. Unset keys are the model's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Setting {
    /// What is turned: settings of one knob belong together.
    pub knob: Option<String>,
    /// Weight file.
    pub weights: Option<PathBuf>,
    /// Overrides of the config that is stored with the weights.
    pub set: Vec<String>,
    /// As `--device` names it.
    pub device: Option<String>,
    /// What the point predictor computes in.
    pub precision: Option<Precision>,
    /// Whether the unseen sides are predicted.
    pub sides: Option<bool>,
    /// Whether their pixels get the colours of the nearest photographed points.
    pub side_colors: Option<bool>,
    /// Only every so many-th row and column of pixels becomes a Gaussian, so many times as large.
    pub stride: Option<usize>,
    /// Gaussians less opaque are dropped.
    pub min_opacity: Option<f32>,
    /// Renders are so many times as large on each side, 1 or 2, and shrunk.
    pub supersampling: Option<usize>,
    /// Constants of the rasteriser.
    pub preset: Option<Preset>,
    /// Whether splats smaller than a pixel keep their weight.
    pub antialiased: Option<bool>,
    /// A scene: settings of one scene are compared with the one of them that leaves nothing out.
    pub scene: Option<String>,
    /// What is left out, for people; unset: nothing.
    pub omits: Option<String>,
    /// Another data set.
    pub data: Option<PathBuf>,
    /// Only these people; unset: the first ones.
    pub only: Option<Vec<String>>,
    /// Views that go in, as in an evaluation.
    pub inputs: Option<Vec<usize>>,
    /// Fit the Gaussians to the photographs afterwards.
    pub tune: Option<Tune>,
}

/// What is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tune {
    /// Every parameter.
    All,
    /// Colours alone.
    Colors,
}

impl Setting {
    /// With what is unset taken from another; overrides of the config come after the other's.
    pub fn over(self, base: &Self) -> Self {
        let base = base.clone();
        Self {
            knob: self.knob.or(base.knob),
            weights: self.weights.or(base.weights),
            set: [base.set, self.set].concat(),
            device: self.device.or(base.device),
            precision: self.precision.or(base.precision),
            sides: self.sides.or(base.sides),
            side_colors: self.side_colors.or(base.side_colors),
            stride: self.stride.or(base.stride),
            min_opacity: self.min_opacity.or(base.min_opacity),
            supersampling: self.supersampling.or(base.supersampling),
            preset: self.preset.or(base.preset),
            antialiased: self.antialiased.or(base.antialiased),
            scene: self.scene.or(base.scene),
            omits: self.omits.or(base.omits),
            data: self.data.or(base.data),
            only: self.only.or(base.only),
            inputs: self.inputs.or(base.inputs),
            tune: self.tune.or(base.tune),
        }
    }
}

/// Name of the setting that changes nothing.
pub const AS_IT_IS: &str = "as it is";

impl Schema for BenchConfig {
    fn refusal(&self) -> Option<(String, String)> {
        self.problem().map(|(key, message)| (key.to_owned(), message))
    }
}

impl BenchConfig {
    /// Names of all settings in the order of the report, the model as it is first.
    pub fn names(&self) -> Vec<String> {
        let mut named: Vec<(&String, &Setting)> = self.settings.iter().collect();
        let nothing = |setting: &Setting| (setting.scene.clone(), setting.omits.is_some());
        named.sort_by_key(|(name, setting)| (nothing(setting), setting.knob.clone(), (*name).clone()));
        std::iter::once(AS_IT_IS.to_owned()).chain(named.into_iter().map(|(name, _)| name.clone())).collect()
    }

    /// A setting with everything that it does not change.
    pub fn setting(&self, name: &str) -> Option<Setting> {
        if name == AS_IT_IS {
            return Some(self.model.clone());
        }
        self.settings.get(name).map(|setting| setting.clone().over(&self.model))
    }

    fn problem(&self) -> Option<(&'static str, String)> {
        let b = &self.bench;
        let counts = [
            ("bench.runs", b.runs, 1, 10_000),
            ("bench.warm_up", b.warm_up, 0, 1000),
            ("bench.people", b.people, 1, 100_000),
            ("bench.views", b.views, 1, 4096),
            ("bench.oracle", b.oracle as usize, 1, 1024),
        ];
        for (key, value, low, high) in counts {
            if !(low..=high).contains(&value) {
                return Some((key, format!("is {value}, must be {low} to {high}")));
            }
        }
        if self.settings.contains_key(AS_IT_IS) {
            return Some(("settings", format!("`{AS_IT_IS}` is the model's own name")));
        }
        let name = self
            .settings
            .iter()
            .flat_map(|(name, s)| [Some(name), s.scene.as_ref(), s.omits.as_ref(), s.knob.as_ref()]);
        if name.flatten().any(|name| name.contains(char::is_control)) {
            return Some(("settings", "a name has control characters".into()));
        }
        for setting in self.settings.values().chain([&self.model]) {
            if let Some(problem) = setting.inputs.as_ref().and_then(|inputs| views_problem(inputs)) {
                return Some(("settings.*.inputs", problem));
            }
            if setting.stride.is_some_and(|stride| !(1..=64).contains(&stride)) {
                return Some(("settings.*.stride", "must be 1 to 64".into()));
            }
            if setting.supersampling.is_some_and(|times| ![1, 2].contains(&times)) {
                return Some(("settings.*.supersampling", "must be 1 or 2".into()));
            }
            if setting.min_opacity.is_some_and(|least| !(0.0..=1.0).contains(&least)) {
                return Some(("settings.*.min_opacity", "must be 0 to 1".into()));
            }
        }
        None
    }
}
