//! Variants of the model under test: the model with one thing changed. Ablations of an evaluation and settings of a
//! benchmark are variants.

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use snapsnap_data::sample::PhotographChanges;
use snapsnap_net::config::Precision;
use snapsnap_splat::Preset;

/// How many times as large as the compared pictures renders may be on each side.
pub const SUPERSAMPLING: [usize; 3] = [1, 2, 4];

/// The section `[model]`, a section `[ablations.NAME]` of an evaluation, or `[settings.NAME]` of a benchmark. Unset
/// keys have the values of the model under test.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Variant {
    /// Weight file.
    pub weights: Option<PathBuf>,
    /// Overrides of the config that is stored with the weights, `section.key=value`.
    pub set: Vec<String>,
    /// Device, as in `--device`.
    pub device: Option<String>,
    /// Precision of the point predictor. Unset: the weights' own on a CPU with instructions for bf16, else f32.
    pub precision: Option<Precision>,
    /// Whether the unseen sides are predicted. Unset: only with two photographs.
    pub sides: Option<bool>,
    /// Whether pixels of the unseen sides get the colours of the nearest photographed points.
    pub side_colors: Option<bool>,
    /// Only each `stride`-th row and column of pixels becomes Gaussians, which are `stride` times as large.
    pub stride: Option<usize>,
    /// Least opacity of the Gaussians that are kept.
    pub min_opacity: Option<f32>,
    /// Benchmarks: the property that is varied. Settings with the same knob belong together.
    pub knob: Option<String>,
    /// Pictures are rendered this many times as large on each side, one of [`SUPERSAMPLING`], and shrunk: enlarged
    /// pictures show what the person looks like from near.
    pub supersampling: Option<usize>,
    /// Constants of the rasteriser.
    pub preset: Option<Preset>,
    /// Whether splats smaller than a pixel keep their weight.
    pub antialiased: Option<bool>,
    /// Benchmarks: the scene. Settings of a scene are compared with the scene's one setting that omits nothing.
    pub scene: Option<String>,
    /// Benchmarks: the omitted work, for the report. Unset: none.
    pub omits: Option<String>,
    /// Benchmarks: another data set.
    pub data: Option<PathBuf>,
    /// Benchmarks: names of the people. Unset: the first ones.
    pub only: Option<Vec<String>>,
    /// Benchmarks: input views, as in `views.inputs` of an evaluation.
    pub inputs: Option<Vec<usize>>,
    /// Changes to the photographs.
    pub photographs: Option<PhotographChanges>,
}

impl Variant {
    /// This variant with the unset keys of `base`. Overrides of the config follow the overrides of `base`.
    pub fn over(self, base: &Self) -> Self {
        let mut keys = base.keys();
        keys.extend(self.keys());
        let merged = serde_json::from_value(Value::Object(keys)).expect("keys of variants");
        Self { set: [base.set.clone(), self.set].concat(), ..merged }
    }

    /// The set keys with their values. Paths are UTF-8, as the commands check.
    fn keys(&self) -> Map<String, Value> {
        let Value::Object(mut keys) = json!(self) else { unreachable!("a variant has keys") };
        keys.retain(|_, value| !value.is_null());
        keys
    }

    /// The first key with an invalid value, and the reason.
    pub(crate) fn refusal(&self) -> Option<(&'static str, String)> {
        let photographs = self.photographs.as_ref().and_then(PhotographChanges::problem);
        let must = |is_wrong: bool, range: &str| is_wrong.then(|| format!("must be {range}"));
        let is_other = self.supersampling.is_some_and(|n| !SUPERSAMPLING.contains(&n));
        let problems = [
            ("photographs", photographs.map(|(key, message)| format!("`{key}` {message}"))),
            ("inputs", self.inputs.as_deref().and_then(views_problem)),
            ("stride", must(self.stride.is_some_and(|n| !(1..=64).contains(&n)), "1 to 64")),
            ("supersampling", must(is_other, "1, 2 or 4")),
            ("min_opacity", must(self.min_opacity.is_some_and(|o| !(0.0..=1.0).contains(&o)), "0 to 1")),
        ];
        problems.into_iter().find_map(|(key, problem)| Some((key, problem?)))
    }

    /// The first key that is set and that only benchmarks have.
    pub(crate) fn key_of_benchmarks(&self) -> Option<&'static str> {
        const KEYS: [&str; 6] = ["knob", "scene", "omits", "data", "only", "inputs"];
        let keys = self.keys();
        KEYS.into_iter().find(|key| keys.contains_key(*key))
    }
}

/// The reason why a list of input views is invalid; `None` for a valid list.
pub(crate) fn views_problem(inputs: &[usize]) -> Option<String> {
    if inputs.len() == 1 || inputs.len() > 64 {
        return Some("must be empty, or 2 to 64 views".into());
    }
    names_twice(inputs).then(|| "names a view twice".into())
}

/// Whether a list contains an entry twice.
pub(crate) fn names_twice<T: Ord>(list: &[T]) -> bool {
    list.iter().collect::<BTreeSet<_>>().len() < list.len()
}
