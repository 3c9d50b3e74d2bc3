//! Evaluation of a model and its baselines on the people of a data set (docs/method.md, "Evaluation").

pub mod baselines;
pub mod config;
mod contest;
pub mod meshes;
pub mod model;
pub mod person;
mod shared;
mod sides;
mod surface;

use std::collections::BTreeMap;
use std::time::Duration;

use image::RgbImage;
use rayon::prelude::*;
use snapsnap_data::sample::{PhotographChanges, TestItem};
use snapsnap_ops::is_cpu;

use crate::Result;
use crate::foreign::Traces;
use crate::geometry::Align;
use crate::lpips::Lpips;
use crate::parts::PartError;
use crate::pictures::Picture;
use crate::points::PointError;
use crate::preview::{grid, heat, picture};
use crate::region::{Region, margin};
use crate::score::Score;

use config::{EvalConfig, Protocol};
use contest::Shown;
pub use contest::{Contestant, Kind};
use person::People;
pub use shared::{LeftOut, rendered};
use shared::{at_once, everybody, missing, name_of};
pub use surface::{Surface, Truth, truth};

/// Scores of one view of a person.
#[derive(Debug, Clone)]
pub struct Row {
    /// Index in [`Outcome::people`].
    pub person: usize,
    /// The view.
    pub view: usize,
    /// Degrees from the first photograph's camera, around the person.
    pub degrees: f64,
    /// In the order of the config's protocols.
    pub scores: Vec<Score>,
    /// What the photographs' background left, if the photographs have one.
    pub traces: Option<Traces>,
}

/// All measurements of a contestant.
#[derive(Debug, Clone, Default)]
pub struct Judged {
    /// The contestant's name.
    pub name: String,
    /// The contestant's role.
    pub kind: Kind,
    /// Scores of the views.
    pub rows: Vec<Row>,
    /// Errors of the predicted points, of all people.
    pub points: Vec<PointError>,
    /// Errors of the photographs' points on head, hands and feet, of all people.
    pub parts: Vec<PartError>,
    /// The Gaussians as a surface, per person.
    pub surface: Vec<Surface>,
    /// The mesh made of the Gaussians, per person.
    pub mesh: Vec<Surface>,
    /// Mean overlap of the cut-outs and the true masks, per person.
    pub masks: Vec<f64>,
    /// From the photographs to the Gaussians, per person.
    pub times: Vec<Duration>,
    /// Number of Gaussians, per person.
    pub gaussians: Vec<usize>,
    /// Rotation in degrees, shift of the middle in cm and scale of the alignment, per person.
    pub aligned: Vec<[f64; 3]>,
}

/// Mean score of each person's views, by index in [`Outcome::people`].
pub(crate) fn by_person<'a>(rows: impl Iterator<Item = &'a Row>, protocol: usize) -> BTreeMap<usize, Score> {
    let mut scores: BTreeMap<usize, Vec<Score>> = BTreeMap::new();
    for row in rows {
        scores.entry(row.person).or_default().push(row.scores[protocol]);
    }
    scores.into_iter().filter_map(|(person, scores)| Some((person, Score::mean(&scores)?))).collect()
}

/// The result of an evaluation.
pub struct Outcome {
    /// Names of the people.
    pub people: Vec<String>,
    /// The contestants; the model is the first if it could be loaded.
    pub judged: Vec<Judged>,
    /// Failed parts.
    pub left_out: Vec<LeftOut>,
    /// Size of the compared pictures and of their renders, for the report.
    pub pictures: String,
}

/// Evaluates contestants on all people. `progress` is called with the number of finished people and their total.
/// Failures of single people, views or contestants are part of the outcome, and the rest is evaluated.
pub fn evaluate(
    config: &EvalConfig,
    sets: &[People],
    contestants: &[Contestant],
    lpips: Option<&Lpips>,
    progress: &dyn Fn(usize, usize),
) -> Outcome {
    let total = everybody(sets).count();
    let mut sides: Vec<String> = sets.iter().map(|set| format!("{}²", set.side(&config.views))).collect();
    sides.dedup();
    let pictures =
        format!("pictures of {} pixels, rendered at {}×", sides.join(" and "), config.views.supersampling);
    let named = |name: &str, kind| Judged { name: name.to_owned(), kind, ..Judged::default() };
    let judged = contestants.iter().map(|c| named(c.name(), c.kind())).collect();
    let mut outcome = Outcome { people: Vec::new(), judged, left_out: Vec::new(), pictures };
    for (person, (people, row)) in everybody(sets).enumerate() {
        outcome.people.push(name_of(sets, people, row));
        let at = Place { config, contestants, lpips, people, row, person };
        let metrics = &config.metrics;
        let is_measured = metrics.geometry || metrics.mesh || metrics.align != Align::None;
        let truth = is_measured.then(|| truth(people, row));
        let truth = truth.and_then(|truth| at.kept(&mut outcome, ", geometry", truth));
        at.evaluate(truth.as_ref(), &mut outcome);
        progress(person + 1, total);
    }
    outcome.left_out.extend(missing(config, sets));
    outcome
}

/// A person and the contestants.
struct Place<'a> {
    config: &'a EvalConfig,
    contestants: &'a [Contestant],
    lpips: Option<&'a Lpips>,
    people: &'a People,
    /// The person's row in the data set.
    row: usize,
    /// The person's index in [`Outcome::people`].
    person: usize,
}

/// A contestant's index, and its scores by protocol with the traces of the background.
type Scored = (usize, Result<(Vec<Score>, Option<Traces>)>);

impl Place<'_> {
    /// Records a failure; `what` follows the person's name.
    fn left_out(&self, outcome: &mut Outcome, what: &str, why: impl ToString) {
        let name = format!("{}{what}", outcome.people[self.person]);
        outcome.left_out.push(LeftOut::new(name, why));
    }

    /// The value of a result. A failure is recorded and gives `None`.
    fn kept<T>(&self, outcome: &mut Outcome, what: &str, result: Result<T, impl ToString>) -> Option<T> {
        result.map_err(|e| self.left_out(outcome, what, e)).ok()
    }

    /// Evaluates all contestants.
    fn evaluate(&self, truth: Option<&Truth>, outcome: &mut Outcome) {
        let Self { config, contestants, people, row, person, .. } = *self;
        let (inputs, side) = (people.inputs(&config.views), people.side(&config.views));
        let item = people.item(row, &inputs, &PhotographChanges::default());
        let Some(item) = self.kept(outcome, "", item) else { return };
        let mut shown = Vec::new();
        for (i, contestant) in contestants.iter().enumerate() {
            let made = contestant.prepare(people, row, &item, &inputs, side, (&config.metrics, truth));
            let made = self.kept(outcome, &format!(", {}", contestant.name()), made);
            if let Some(made) = &made {
                self.measure(i, made, truth, outcome);
            }
            shown.push(made);
        }
        let is_compared =
            |view: &usize| config.views.compared.is_empty() || config.views.compared.contains(view);
        let compared: Vec<usize> =
            (0..people.views()).filter(|view| is_compared(view) && !inputs.contains(view)).collect();
        if compared.is_empty() {
            let why = "no view is left to compare: every one of views.compared is an input";
            self.left_out(outcome, "", why);
        }
        let compare = |view: &usize| self.compare(&item, *view, &shown);
        // A GPU runs one task at a time.
        let is_on_gpu = |made: &Shown| !is_cpu(&made.gaussians.device());
        let any_on_gpu = shown.iter().flatten().any(is_on_gpu);
        let times = contestants.iter().map(|contestant| contestant.views(&config.views).supersampling).max();
        let most = if any_on_gpu { 1 } else { at_once(side * times.unwrap_or(1)) };
        let found = compared.chunks(most).flat_map(|views| match views {
            [view] => vec![compare(view)],
            views => views.par_iter().map(compare).collect(),
        });
        let found: Vec<Result<Vec<Scored>>> = found.collect();
        for (view, found) in compared.into_iter().zip(found) {
            let degrees = person::degrees(&item.cameras[view], &item.cameras[inputs[0]]);
            let scored = self.kept(outcome, &format!(", view {view}"), found);
            for (i, scores) in scored.unwrap_or_default() {
                let what = format!(", {}, view {view}", contestants[i].name());
                if let Some((scores, traces)) = self.kept(outcome, &what, scores) {
                    outcome.judged[i].rows.push(Row { person, view, degrees, scores, traces });
                }
            }
        }
    }

    /// Records all measurements of a contestant except the scores of pictures.
    fn measure(&self, i: usize, made: &Shown, truth: Option<&Truth>, outcome: &mut Outcome) {
        let Self { config, .. } = *self;
        let name = format!(", {}", self.contestants[i].name());
        let points = self.kept(outcome, &format!("{name}, points"), made.points.clone());
        if made.lost > 0 {
            let why = format!("{} pixels or Gaussians left out: they are not finite", made.lost);
            self.left_out(outcome, &name, why);
        }
        let judged = &mut outcome.judged[i];
        let (points, parts) = points.unwrap_or_default();
        judged.points.extend(points);
        judged.parts.extend(parts);
        judged.masks.extend(made.masks);
        judged.times.extend(made.time);
        judged.gaussians.push(made.gaussians.len());
        judged.aligned.extend(made.aligned);
        let (Some(truth), gaussians) = (truth, &made.gaussians) else { return };
        if config.metrics.geometry {
            let surface = Surface::of_gaussians(gaussians, truth);
            let surface = self.kept(outcome, &format!("{name}, geometry"), surface);
            outcome.judged[i].surface.extend(surface);
        }
        if config.metrics.mesh && self.contestants[i].kind() != Kind::Baseline {
            let mesh = self.kept(outcome, &format!("{name}, mesh"), Surface::of_mesh(gaussians, truth));
            outcome.judged[i].mesh.extend(mesh);
        }
    }

    /// Compares the pictures of a view.
    fn compare(&self, item: &TestItem, view: usize, shown: &[Option<Shown>]) -> Result<Vec<Scored>> {
        let Self { config, people, .. } = *self;
        let side = people.side(&config.views);
        let (target, mask) = people.target(self.row, view, side)?;
        let masked = || Region::masked(&mask, [side, side], margin(side));
        let region = |protocol: &Protocol| match protocol {
            Protocol::Paper => Region::paper(&target),
            Protocol::Masked => masked(),
            Protocol::Head => Ok(masked()?.head()),
        };
        let regions = config.metrics.protocols.iter().map(region).collect::<Result<Vec<_>, _>>()?;
        let scores = |(i, shown): (usize, &Option<Shown>)| {
            let camera = &item.cameras[view];
            let shown = shown.as_ref()?;
            let score = |image: &Picture, region| Score::new(image, &target, region, self.lpips);
            let judged = || {
                let views = self.contestants[i].views(&config.views);
                let image = rendered(&shown.gaussians, camera, side, &views)?;
                let scores = regions.iter().map(|region| score(&image, region)).collect::<Result<_, _>>()?;
                let palette = shown.palette.as_ref();
                let traces = palette.map(|palette| palette.traces(&image, &target, &mask)).transpose()?;
                Ok((scores, traces))
            };
            Some((i, judged()))
        };
        Ok(shown.iter().enumerate().filter_map(scores).collect())
    }
}

/// Mean absolute difference of the channels that the sheet shows as white.
const WORST: f32 = 0.5;

/// A sheet of the people with these indices in [`Outcome::people`]: both photographs and, for each view of the config,
/// the model's picture, the ground truth and the error. Also returns the people whose pictures failed.
pub fn sheet(
    config: &EvalConfig,
    sets: &[People],
    contestant: &Contestant,
    persons: &[usize],
) -> (Option<RgbImage>, Vec<LeftOut>) {
    let places: Vec<(&People, usize)> = everybody(sets).collect();
    let (mut rows, mut left_out) = (Vec::new(), Vec::new());
    for (people, row) in persons.iter().map(|person| places[*person]) {
        match pictures(config, people, row, contestant) {
            Ok(pictures) => rows.push(pictures),
            Err(e) => left_out.push(LeftOut::new(format!("{}, pictures", name_of(sets, people, row)), e)),
        }
    }
    let of_view = |degrees: &f64| [format!("{degrees} deg. render"), "truth".into(), "error".into()];
    let views = config.report.degrees.iter().flat_map(of_view);
    let captions: Vec<String> = ["front".into(), "back".into()].into_iter().chain(views).collect();
    let captions: Vec<&str> = captions.iter().map(String::as_str).collect();
    (grid(&rows, &captions, &format!("white errors: {WORST} of 1 or more")), left_out)
}

/// A row of the sheet.
fn pictures(config: &EvalConfig, people: &People, row: usize, model: &Contestant) -> Result<Vec<RgbImage>> {
    let inputs = people.inputs(&config.views);
    let item = people.item(row, &inputs, &PhotographChanges::default())?;
    let side = people.side(&config.views);
    let truth = (config.metrics.align != Align::None).then(|| truth(people, row)).transpose()?;
    let shown = model.prepare(people, row, &item, &inputs, side, (&config.metrics, truth.as_ref()))?;
    let mut pictures = Vec::new();
    for view in &inputs[..2] {
        let (target, _) = people.target(row, *view, side)?;
        pictures.push(target.cropped(Region::paper(&target)?.window).to_rgb8());
    }
    for wanted in &config.report.degrees {
        let view = person::nearest_view(&item.cameras, inputs[0], *wanted);
        let views = model.views(&config.views);
        let image = rendered(&shown.gaussians, &item.cameras[view], side, &views)?;
        let (target, _) = people.target(row, view, side)?;
        let window = Region::paper(&target)?.window;
        let [image, target] = [image, target].map(|picture| picture.cropped(window));
        let error = picture([image.width, image.height], |i| {
            let apart = |c: usize| (image.plane(c)[i] - target.plane(c)[i]).abs();
            heat((apart(0) + apart(1) + apart(2)) / 3.0, WORST)
        });
        pictures.extend([image.to_rgb8(), target.to_rgb8(), error]);
    }
    Ok(pictures)
}
