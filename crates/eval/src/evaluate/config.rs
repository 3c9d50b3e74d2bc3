//! The TOML schema of an evaluation.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::Split;
use snapsnap_data::sample::Handling;
use snapsnap_splat::RenderOptions;

/// Everything that decides what an evaluation computes.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvalConfig {
    /// Who is looked at.
    pub data: DataSection,
    /// Which views go in and which are compared.
    pub views: ViewsSection,
    /// What is done to the photographs that models see; baselines have them as they are.
    pub photographs: Handling,
    /// What is judged.
    pub model: ModelSection,
    /// How pictures are compared.
    pub metrics: MetricsSection,
    /// What it is compared with.
    pub baselines: BaselineSection,
    /// The same model otherwise, or another one, by name; each is compared with the model, person by person.
    pub ablations: BTreeMap<String, Ablation>,
    /// Lists of subjects that get figures of their own, such as those in loose clothes.
    pub groups: BTreeMap<String, Group>,
    /// What is written.
    pub report: ReportSection,
}

/// The section `[data]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataSection {
    /// The data sets; `--data` replaces them.
    pub folders: Vec<PathBuf>,
    /// Which people of them; unset: those that lie in the folder itself, as in the authors' test sets.
    #[serde(with = "split")]
    pub split: Option<Split>,
    /// Only so many of each, the first ones; 0: all.
    pub subjects: usize,
    /// Only these; empty: all.
    pub only: Vec<String>,
    /// Folder of true meshes, NAME.obj, .ply or .glb, for point-to-surface distances.
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
    /// Views that go in; empty: the first and the opposite one. Of more than two, each and the next make a pair of
    /// photographs of known cameras, around the circle, without unseen sides; what the pairs give is put together.
    pub inputs: Vec<usize>,
    /// The same people again with all inputs so many views further: other angles than the person's own front.
    pub turns: Vec<usize>,
    /// Side of the pictures that are compared, in pixels; 0: the data set's, else a whole part of it.
    pub resolution: usize,
    /// Renders are so many times as large on each side, 1 or 2, and shrunk.
    pub supersampling: usize,
    /// Views that are compared, of those that do not go in; empty: all.
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
    /// How pictures are rendered, before black.
    pub fn render_options(&self) -> RenderOptions {
        let options = match self.preset {
            Preset::Inria => RenderOptions::inria(),
            Preset::Gsplat => RenderOptions::gsplat_1_5(),
        };
        RenderOptions { antialiased: self.antialiased, ..options }
    }
}

/// Constants of a rasteriser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// The original one; what the published weights were trained with.
    #[default]
    Inria,
    /// gsplat 1.5.
    Gsplat,
}

/// The section `[model]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelSection {
    /// Weight file; `--weights` replaces it.
    pub weights: Option<PathBuf>,
    /// Overrides of the config that is stored with the weights, `section.key=value`.
    pub set: Vec<String>,
    /// Devices, as `--device` names them; empty: the best there is. The first one makes the figures, each further one is
    /// compared with it like an ablation.
    pub devices: Vec<String>,
}

/// A section `[ablations.NAME]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ablation {
    /// Other weights; unset: the model's.
    pub weights: Option<PathBuf>,
    /// Further overrides of the stored config.
    pub set: Vec<String>,
    /// Whether the unseen sides are predicted.
    pub sides: bool,
    /// Whether their pixels get the colours of the nearest photographed points.
    pub side_colors: bool,
    /// What is done to the photographs instead of what is done to the model's.
    pub photographs: Option<Handling>,
}

impl Default for Ablation {
    fn default() -> Self {
        Self { weights: None, set: Vec::new(), sides: true, side_colors: true, photographs: None }
    }
}

/// A section `[groups.NAME]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Group {
    /// Names of subjects.
    pub subjects: Vec<String>,
}

/// Where pictures are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Protocol {
    /// In the window of 1000 × 500 of 1024 pixels around the person.
    Paper,
    /// On the person and 8 of 1024 pixels around.
    Masked,
}

impl Protocol {
    /// As in configs and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Masked => "masked",
        }
    }
}

/// The section `[metrics]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsSection {
    /// Where pictures are compared.
    pub protocols: Vec<Protocol>,
    /// Folder with the published weights of LPIPS; `--lpips` replaces it.
    pub lpips: PathBuf,
    /// Chamfer distance of the Gaussians' centres and agreement of normals.
    pub geometry: bool,
    /// Gaussians at least so opaque are surface.
    pub opaque: f32,
    /// The same of the mesh that `snapsnap mesh` makes of the Gaussians: seconds per person.
    pub mesh: bool,
}

impl Default for MetricsSection {
    fn default() -> Self {
        Self {
            protocols: vec![Protocol::Paper, Protocol::Masked],
            lpips: "weights".into(),
            geometry: true,
            opaque: 0.5,
            mesh: false,
        }
    }
}

/// The section `[baselines]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BaselineSection {
    /// The photographs as flat cut-outs, which need no training.
    pub billboard: bool,
    /// True points in the photographs' colours: the most that the regressor could begin with.
    pub true_points: bool,
    /// Data sets of people to train on with the same views, of any size: their mean picture per view knows nobody, but no
    /// wrong colours either. Empty: left out.
    pub mean: Vec<PathBuf>,
}

impl Default for BaselineSection {
    fn default() -> Self {
        Self { billboard: true, true_points: true, mean: Vec::new() }
    }
}

/// The section `[report]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReportSection {
    /// How many people of each kind are shown: the best, those in the middle, the worst.
    pub people: usize,
    /// Views of each that are shown, degrees from the input view.
    pub degrees: Vec<f64>,
}

impl Default for ReportSection {
    fn default() -> Self {
        Self { people: 2, degrees: vec![0.0, 48.0, 96.0, 132.0, 180.0, 264.0] }
    }
}

/// What is wrong with a list of views that go in.
pub(crate) fn views_problem(inputs: &[usize]) -> Option<String> {
    if inputs.len() == 1 || inputs.len() > 64 {
        return Some("must be empty, or 2 to 64 views".into());
    }
    let is_twice = inputs.iter().collect::<BTreeSet<_>>().len() < inputs.len();
    is_twice.then(|| "names a view twice".into())
}

impl Schema for EvalConfig {
    fn refusal(&self) -> Option<(String, String)> {
        self.problem().map(|(key, message)| (key.to_owned(), message))
    }
}

impl EvalConfig {
    fn problem(&self) -> Option<(&'static str, String)> {
        /// Names that reports have for others.
        const TAKEN: [&str; 5] = ["model", "against", "billboard", "true_points", "mean_picture"];
        let Self { views, metrics, report, ablations, model, .. } = self;
        let devices = model.devices.iter().map(|name| format!("on {name}"));
        let mut names: Vec<String> = ablations.keys().cloned().chain(devices).collect();
        names.sort_unstable();
        if let Some(name) = names.iter().find(|name| TAKEN.contains(&name.as_str())) {
            return Some(("ablations", format!("`{name}` is the name of something else in reports")));
        }
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            return Some(("ablations", format!("`{}` is there twice, as an ablation or a device", pair[0])));
        }
        if names.iter().chain(self.groups.keys()).any(|name| name.contains(char::is_control)) {
            return Some(("ablations", "the name of one, or of a group, has control characters".into()));
        }
        let handlings = ablations.values().filter_map(|ablation| ablation.photographs.as_ref());
        if let Some((key, message)) = handlings.chain([&self.photographs]).find_map(Handling::problem) {
            return Some(("photographs", format!("`{key}` {message}")));
        }
        if let Some(problem) = views_problem(&views.inputs) {
            return Some(("views.inputs", problem));
        }
        let lists = [("views.turns", &views.turns), ("views.compared", &views.compared)];
        for (key, list) in lists {
            if list.iter().collect::<BTreeSet<_>>().len() < list.len() {
                return Some((key, "names a view twice".into()));
            }
        }
        if views.turns.is_empty() || views.turns.len() > 64 {
            return Some(("views.turns", "must have 1 to 64 entries".into()));
        }
        if ![1, 2].contains(&views.supersampling) {
            return Some(("views.supersampling", format!("is {}, must be 1 or 2", views.supersampling)));
        }
        if metrics.protocols.is_empty() {
            return Some(("metrics.protocols", "is empty, must name `paper`, `masked` or both".into()));
        }
        if metrics.protocols.len() > 2 || metrics.protocols.get(1) == metrics.protocols.first() {
            return Some(("metrics.protocols", "names a protocol twice".into()));
        }
        if !(0.0..=1.0).contains(&metrics.opaque) {
            return Some(("metrics.opaque", format!("is {}, must be 0 to 1", metrics.opaque)));
        }
        if report.people > 5 || report.degrees.len() > 12 {
            return Some(("report.people", "at most 5 people of each kind and 12 views of each".into()));
        }
        if report.degrees.iter().any(|degrees| !degrees.is_finite()) {
            return Some(("report.degrees", "must be numbers".into()));
        }
        None
    }
}
