//! The TOML schema of an evaluation.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::Split;
use snapsnap_data::sample::PhotographChanges;
use snapsnap_splat::{Preset, RenderOptions};

use crate::geometry::Align;
use crate::variant::{SUPERSAMPLING, Variant, names_twice, views_problem};

/// The config of an evaluation.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvalConfig {
    /// The people.
    pub data: DataSection,
    /// Input views and compared views.
    pub views: ViewsSection,
    /// Changes to the photographs for models. Baselines get unchanged photographs.
    pub photographs: PhotographChanges,
    /// The model under test. `--weights` and `--device` replace its weights and its device.
    pub model: Variant,
    /// Metrics.
    pub metrics: MetricsSection,
    /// Baselines.
    pub baselines: BaselineSection,
    /// Variants of the model by name. Each is compared with the model, person by person.
    pub ablations: BTreeMap<String, Variant>,
    /// Pictures of the report.
    pub report: ReportSection,
}

/// The section `[data]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataSection {
    /// The data sets. `--data` replaces them.
    pub folders: Vec<PathBuf>,
    /// Split of the people. Unset: the people are in the folder itself, as in the authors' test sets.
    #[serde(with = "split")]
    pub split: Option<Split>,
    /// Number of people of each data set, the first ones; 0: all.
    pub subjects: usize,
    /// Names of the people; empty: all.
    pub only: Vec<String>,
    /// Folder of ground-truth meshes, NAME.obj, .ply or .glb, for point-to-surface distances.
    pub scans: Option<PathBuf>,
}

/// `"none"` for people in the folder itself.
mod split {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use snapsnap_data::dataset::Split;

    const NONE: &str = "none";

    pub fn serialize<S: Serializer>(split: &Option<Split>, serializer: S) -> Result<S::Ok, S::Error> {
        split.map_or(NONE, Split::name).serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Split>, D::Error> {
        let name = String::deserialize(deserializer)?;
        let split = Split::ALL.into_iter().find(|split| split.name() == name);
        if split.is_none() && name != NONE {
            return Err(D::Error::unknown_variant(&name, &["train", "val", "test", NONE]));
        }
        Ok(split)
    }
}

impl Default for DataSection {
    fn default() -> Self {
        Self { folders: Vec::new(), split: Some(Split::Test), subjects: 0, only: Vec::new(), scans: None }
    }
}

/// The section `[views]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewsSection {
    /// Input views; empty: the first and the opposite view. Others have other angles than the person's own front. Of
    /// more than two, each view and the next around the circle are a pair of photographs with known cameras and no
    /// unseen sides. The Gaussians of all pairs are joined.
    pub inputs: Vec<usize>,
    /// Side of the compared pictures in pixels, a divisor of the data set's side; 0: the data set's side.
    pub resolution: usize,
    /// Pictures are rendered this many times as large on each side, one of [`SUPERSAMPLING`], and shrunk.
    pub supersampling: usize,
    /// Compared views. Input views are left out. Empty: all.
    pub compared: Vec<usize>,
    /// Constants of the rasteriser.
    pub preset: Preset,
    /// Whether splats smaller than a pixel keep their weight.
    pub antialiased: bool,
}

impl Default for ViewsSection {
    fn default() -> Self {
        let (inputs, compared, preset) = (Vec::new(), Vec::new(), Preset::Inria);
        Self { inputs, resolution: 0, supersampling: 2, compared, preset, antialiased: false }
    }
}

impl ViewsSection {
    /// The section with the renders of a variant.
    pub fn of(&self, variant: &Variant) -> Self {
        Self {
            supersampling: variant.supersampling.unwrap_or(self.supersampling),
            preset: variant.preset.unwrap_or(self.preset),
            antialiased: variant.antialiased.unwrap_or(self.antialiased),
            ..self.clone()
        }
    }

    /// Options of a render over black.
    pub fn render_options(&self) -> RenderOptions {
        RenderOptions { antialiased: self.antialiased, ..self.preset.options() }
    }
}

/// Region in which pictures are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Protocol {
    /// The window of 1000 × 500 of 1024 pixels around the person.
    Paper,
    /// The person and a margin of 8 of 1024 pixels.
    Masked,
    /// The upper part of [`Self::Masked`]: head and neck.
    Head,
}

impl Protocol {
    /// Its name in configs and reports.
    pub fn name(self) -> &'static str {
        ["paper", "masked", "head"][self as usize]
    }
}

/// The section `[metrics]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsSection {
    /// Regions in which pictures are compared.
    pub protocols: Vec<Protocol>,
    /// Folder with the published weights of LPIPS. `--lpips` replaces it.
    pub lpips: PathBuf,
    /// Whether the Chamfer distance of the Gaussians' centres and the cosine of normals are measured.
    pub geometry: bool,
    /// Whether the mesh of `snapsnap mesh` is measured too, which takes seconds per person.
    pub mesh: bool,
    /// Alignment of models and meshes with the ground truth before anything is measured. Baselines stay as they are.
    /// `--align` replaces it.
    pub align: Align,
}

impl Default for MetricsSection {
    fn default() -> Self {
        let protocols = vec![Protocol::Paper, Protocol::Masked];
        Self { protocols, lpips: "weights".into(), geometry: true, mesh: false, align: Align::None }
    }
}

/// The section `[baselines]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BaselineSection {
    /// The photographs as flat cut-outs, which need no training.
    pub billboard: bool,
    /// Ground-truth points in the photographs' colours: the best input of a regressor.
    pub true_points: bool,
}

impl Default for BaselineSection {
    fn default() -> Self {
        Self { billboard: true, true_points: true }
    }
}

/// The section `[report]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReportSection {
    /// Number of people in the picture from each of the best, the middle and the worst.
    pub people: usize,
    /// Views of each person, in degrees from the first input view.
    pub degrees: Vec<f64>,
}

impl Default for ReportSection {
    fn default() -> Self {
        Self { people: 2, degrees: vec![0.0, 48.0, 96.0, 132.0, 180.0, 264.0] }
    }
}

impl EvalConfig {
    /// The model under test on `device`, and its variants in `[ablations]`, with their names in reports.
    pub fn variants(&self, device: &str) -> Vec<(String, Variant)> {
        let model = Variant {
            device: Some(device.to_owned()),
            inputs: Some(self.views.inputs.clone()),
            photographs: self.model.photographs.or(Some(self.photographs)),
            ..self.model.clone()
        };
        let others = self.ablations.clone().into_iter().map(|(name, other)| (name, other.over(&model)));
        [("model".to_owned(), model.clone())].into_iter().chain(others).collect()
    }

    fn problem(&self) -> Option<(&'static str, String)> {
        /// Names that have another meaning in reports.
        const TAKEN: [&str; 4] = ["model", "against", "billboard", "true_points"];
        let Self { views, metrics, report, ablations, .. } = self;
        let when = |is_wrong: bool, message: &str| is_wrong.then(|| message.to_owned());
        let taken = ablations.keys().find(|name| TAKEN.contains(&name.as_str()));
        let taken = taken.map(|name| format!("`{name}` has another meaning in reports: choose another name"));
        let has_control = ablations.keys().any(|name| name.contains(char::is_control));
        let photographs = self.photographs.problem().map(|(key, message)| format!("`{key}` {message}"));
        let is_other = !SUPERSAMPLING.contains(&views.supersampling);
        let is_empty = metrics.protocols.is_empty();
        let has_many = report.people > 5 || report.degrees.len() > 12;
        let is_endless = report.degrees.iter().any(|d| !d.is_finite());
        let problems = [
            ("ablations", taken),
            ("ablations", when(has_control, "the name of an ablation has control characters")),
            ("photographs", photographs),
            ("views.inputs", views_problem(&views.inputs)),
            ("views.compared", when(names_twice(&views.compared), "names a view twice")),
            ("views.supersampling", when(is_other, "must be 1, 2 or 4")),
            ("metrics.protocols", when(is_empty, "is empty, must name `paper`, `masked` or both")),
            ("metrics.protocols", when(names_twice(&metrics.protocols), "names a protocol twice")),
            ("report.people", when(has_many, "at most 5 people of each kind and 12 views of each")),
            ("report.degrees", when(is_endless, "must be numbers")),
        ];
        problems.into_iter().find_map(|(key, problem)| Some((key, problem?)))
    }
}

impl Schema for EvalConfig {
    fn refusal(&self) -> Option<(String, String)> {
        let of_variant = |(section, variant): (String, &Variant)| {
            let of_benchmarks = |key| (key, "only settings of `snapsnap bench` have this key".to_owned());
            let problem = variant.refusal().or_else(|| variant.key_of_benchmarks().map(of_benchmarks));
            problem.map(|(key, message)| (format!("{section}.{key}"), message))
        };
        let ablations = self.ablations.iter().map(|(name, ablation)| (format!("ablations.{name}"), ablation));
        let problem = self.problem().map(|(key, message)| (key.to_owned(), message));
        problem.or_else(|| ablations.chain([("model".into(), &self.model)]).find_map(of_variant))
    }
}
