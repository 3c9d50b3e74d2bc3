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
    /// The model under test.
    pub model: ModelSection,
    /// Metrics.
    pub metrics: MetricsSection,
    /// Baselines.
    pub baselines: BaselineSection,
    /// Variants of the model by name. Each is compared with the model, person by person.
    pub ablations: BTreeMap<String, Variant>,
    /// Groups of subjects with figures of their own, such as people in loose clothes.
    pub groups: BTreeMap<String, Group>,
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
    /// Input views; empty: the first and the opposite view. Of more than two, each view and the next around the circle
    /// are a pair of photographs with known cameras and no unseen sides. The Gaussians of all pairs are joined.
    pub inputs: Vec<usize>,
    /// Offsets that are added to the input views, for angles other than the person's front.
    pub turns: Vec<usize>,
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
        Self {
            inputs: Vec::new(),
            turns: vec![0],
            resolution: 0,
            supersampling: 2,
            compared: Vec::new(),
            preset: Preset::Inria,
            antialiased: false,
        }
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

/// The section `[model]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelSection {
    /// Weight file. `--weights` replaces it.
    pub weights: Option<PathBuf>,
    /// Overrides of the config that is stored with the weights, `section.key=value`.
    pub set: Vec<String>,
    /// Devices, as in `--device`; empty: the best device. The model runs on the first. Each further device is compared
    /// with the first like an ablation.
    pub devices: Vec<String>,
}

/// A section `[groups.NAME]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Group {
    /// Names of subjects.
    pub subjects: Vec<String>,
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
        match self {
            Self::Paper => "paper",
            Self::Masked => "masked",
            Self::Head => "head",
        }
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
    /// Least opacity of Gaussians that belong to the surface.
    pub opaque: f32,
    /// Whether the mesh of `snapsnap mesh` is measured too, which takes seconds per person.
    pub mesh: bool,
    /// Alignment of models and meshes with the ground truth before anything is measured. Baselines stay as they are.
    /// `--align` replaces it.
    pub align: Align,
}

impl Default for MetricsSection {
    fn default() -> Self {
        Self {
            protocols: vec![Protocol::Paper, Protocol::Masked],
            lpips: "weights".into(),
            geometry: true,
            opaque: 0.5,
            mesh: false,
            align: Align::None,
        }
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
    /// The model under test, and its variants on the further `devices` and in `[ablations]`, with their names in
    /// reports.
    pub fn variants(&self, devices: &[String]) -> Vec<(String, Variant)> {
        let model = Variant {
            weights: self.model.weights.clone(),
            set: self.model.set.clone(),
            device: devices.first().cloned(),
            inputs: Some(self.views.inputs.clone()),
            photographs: Some(self.photographs),
            ..Variant::default()
        };
        let on = |name: &String| Variant { device: Some(name.clone()), ..Variant::default() };
        let others = devices.iter().skip(1).map(|name| (on_device(name), on(name)));
        let others = others.chain(self.ablations.clone()).map(|(name, other)| (name, other.over(&model)));
        [("model".to_owned(), model.clone())].into_iter().chain(others).collect()
    }
}

/// Name of the model on another device in reports.
fn on_device(name: &str) -> String {
    format!("on {name}")
}

impl Schema for EvalConfig {
    fn refusal(&self) -> Option<(String, String)> {
        let of_ablation = |(name, ablation): (&String, &Variant)| {
            let of_benchmarks = |key| (key, "only settings of `snapsnap bench` have this key".to_owned());
            let problem = ablation.refusal().or_else(|| ablation.key_of_benchmarks().map(of_benchmarks));
            problem.map(|(key, message)| (format!("ablations.{name}.{key}"), message))
        };
        let problem = self.problem().map(|(key, message)| (key.to_owned(), message));
        problem.or_else(|| self.ablations.iter().find_map(of_ablation))
    }
}

impl EvalConfig {
    fn problem(&self) -> Option<(&'static str, String)> {
        /// Names that have another meaning in reports.
        const TAKEN: [&str; 4] = ["model", "against", "billboard", "true_points"];
        let Self { views, metrics, report, ablations, model, .. } = self;
        let devices = model.devices.iter().map(|name| on_device(name));
        let mut names: Vec<String> = ablations.keys().cloned().chain(devices).collect();
        names.sort_unstable();
        if let Some(name) = names.iter().find(|name| TAKEN.contains(&name.as_str())) {
            let message = format!("`{name}` has another meaning in reports: choose another name");
            return Some(("ablations", message));
        }
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            return Some(("ablations", format!("`{}` is the name of two ablations or devices", pair[0])));
        }
        if names.iter().chain(self.groups.keys()).any(|name| name.contains(char::is_control)) {
            let message = "the name of an ablation, a device or a group has control characters";
            return Some(("ablations", message.into()));
        }
        if let Some((key, message)) = self.photographs.problem() {
            return Some(("photographs", format!("`{key}` {message}")));
        }
        if let Some(problem) = views_problem(&views.inputs) {
            return Some(("views.inputs", problem));
        }
        let problems = [
            ("views.turns", names_twice(&views.turns), "names a view twice"),
            ("views.compared", names_twice(&views.compared), "names a view twice"),
            ("views.turns", !(1..=64).contains(&views.turns.len()), "must have 1 to 64 entries"),
            ("views.supersampling", !SUPERSAMPLING.contains(&views.supersampling), "must be 1, 2 or 4"),
            (
                "metrics.protocols",
                metrics.protocols.is_empty(),
                "is empty, must name `paper`, `masked` or both",
            ),
            ("metrics.protocols", names_twice(&metrics.protocols), "names a protocol twice"),
            ("metrics.opaque", !(0.0..=1.0).contains(&metrics.opaque), "must be 0 to 1"),
            (
                "report.people",
                report.people > 5 || report.degrees.len() > 12,
                "at most 5 people of each kind and 12 views of each",
            ),
            ("report.degrees", report.degrees.iter().any(|d| !d.is_finite()), "must be numbers"),
        ];
        problems.into_iter().find_map(|(key, is_wrong, message)| is_wrong.then(|| (key, message.into())))
    }
}
