//! Short trainings with extreme people, rates or losses.

use std::path::Path;
use std::slice::from_ref;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use glam::Vec3;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::prepare::DataConfig;
use snapsnap_data::sample::Stage1Item;
use snapsnap_eval::stability::{Case, Found};
use snapsnap_net::weights::{random_predictor, random_regressors};
use snapsnap_people::{Detail, synth};
use tempfile::TempDir;

use super::config;
use crate::config::TrainConfig;
use crate::data::Data;
use crate::log::Line;
use crate::networks::Networks;
use crate::ranks::Ranks;
use crate::run::{Options, Outcome, Watch, on_best_thread, train};
use crate::stage1::PointTask;
use crate::stage2::GaussianTask;
use crate::task::{Moment, Part, Task};
use crate::{Result, TrainError};
use snapsnap_net::Window;

/// Stiff trainings, and one sample whose loss is not a number (docs/method.md, "Stability cases").
pub(super) fn cases() -> Vec<Case> {
    let holds = "its step is skipped and counted, training goes on, weights finite";
    let mut cases = vec![case("one sample whose loss is NaN", holds, poisoned)];
    for (name, factor) in [("×10", 10.0), ("÷10", 0.1)] {
        let input = format!(
            "rate {name}, people nearly black, over-exposed, filling 1 % and 99 % of the frame; 24 steps of either stage"
        );
        let holds = "no step skipped, every logged number finite";
        cases.push(case(&input, holds, move || stiff(factor)));
    }
    cases
}

/// A case that does not depend on the device.
fn case(input: &str, holds: &str, run: impl Fn() -> Result<Found> + 'static) -> Case {
    let run = move |_: &Device| run().unwrap_or_else(Found::broken);
    Case { area: "Stiff training", once: true, ..super::case(input, holds, 0.0, run) }
}

fn temporary() -> Result<TempDir> {
    tempfile::tempdir().map_err(|e| TrainError::Unsuitable(format!("cannot make a temporary folder: {e}")))
}

/// Whether all logged numbers are finite.
struct AllFinite(bool);

impl Watch for AllFinite {
    fn step(&mut self, line: &Line, _: u64, _: u64) {
        self.0 &= line.values.values().all(|value| value.is_finite());
    }
}

/// A short training in a temporary folder: its outcome, and whether all logged numbers are finite. Weights that
/// are not finite cannot be written, which is an error.
fn trained<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    device: &Device,
) -> Result<(Outcome, bool)> {
    let (temporary, ranks, stop) = (temporary()?, Ranks::default(), AtomicBool::new(false));
    let folder = temporary.path();
    let options = Options { folder, device, ranks: &ranks, limit: None, stop: &stop, force: false };
    let mut watch = AllFinite(true);
    let outcome = on_best_thread(device, || train(task, config, networks, &options, &mut watch))?;
    Ok((outcome, watch.0))
}

/// A data set of extreme people: nearly black, over-exposed, in 1 % of the frame, and in nearly all of it.
fn extreme_people(root: &Path) -> Result<Arc<Folder>> {
    let mut data = DataConfig::default();
    (data.views.count, data.views.resolution) = (4, 64);
    let person = synth::person("stability", None, Detail::Fine);
    let lit = |factor: f32| {
        let mut mesh = person.clone();
        mesh.materials.iter_mut().for_each(|material| material.color *= factor);
        mesh
    };
    let middle = Vec3::new(0.0, 0.85, 0.0);
    let mut small = person.clone();
    small.positions.iter_mut().for_each(|p| *p = middle + (*p - middle) * 0.33);
    // A ball that fills the view of the cameras, which are two metres away.
    let mut ball = person.clone();
    ball.positions.iter_mut().for_each(|p| *p = middle + (*p - middle).normalize_or(Vec3::Y) * 1.45);
    let people = [("0000", lit(0.01)), ("0001", lit(40.0)), ("0002", small), ("0003", ball)];
    let people = people.map(|(name, mesh)| (Split::Train, name.to_owned(), mesh));
    Ok(data.make(&root.join("people"), "stability", people)?)
}

fn stiff(factor: f64) -> Result<Found> {
    let temporary = temporary()?;
    let folder = extreme_people(temporary.path())?;
    let share = |subject: &str| -> Result<f64> {
        let (_, mask) = folder.person(Some(Split::Train), subject).picture(0, false)?;
        Ok(mask.as_raw().iter().filter(|m| **m > 127).count() as f64 / 4096.0)
    };
    let (small, large) = (share("0002")?, share("0003")?);
    let rate = 1e-3 * factor;
    let config = config(&[format!("optimizer.rate={rate}"), format!("optimizer.muon.rate={rate}")]);
    let (networks, device) = (config.networks(), Device::flex().autodiff());
    let predictor = |device: &Device| random_predictor(&networks, 3, device);
    let stage1 = PointTask::new(from_ref(&folder), &config, &device)?;
    let fresh = Networks { predictor: Some(predictor(&device)), regressors: Vec::new() };
    let (one, one_finite) = trained(&stage1, &config, fresh, &device)?;
    let stage2 = GaussianTask::new(from_ref(&folder), &config, None, &device)?;
    let regressors = random_regressors(&networks, 4, &device);
    let fresh = Networks { predictor: Some(predictor(&device)), regressors };
    let (two, two_finite) = trained(&stage2, &config, fresh, &device)?;
    let note = format!(
        "{:.1} % and {:.1} % of the frame; {} and {} skipped",
        100.0 * small,
        100.0 * large,
        one.skipped,
        two.skipped
    );
    Ok(Found { note, ..Found::default() }
        .must(small < 0.02 && large > 0.95, "the people do not fill the frame as they should")
        .must(one.step == 24 && two.step == 24, "the training ended early")
        .must(one.skipped == 0 && two.skipped == 0, "steps were skipped")
        .must(one_finite && two_finite, "a logged number or a weight is not finite"))
}

/// Stage 1 with a loss of NaN in its fourth step.
struct Poisoned(PointTask);

impl Task for Poisoned {
    type Item = Stage1Item;
    const STAGE: u32 = 1;

    fn data(&self) -> &Data<Stage1Item> {
        self.0.data()
    }

    fn name(item: &Stage1Item) -> &str {
        PointTask::name(item)
    }

    fn extent(&self, items: &[Stage1Item]) -> Option<Window> {
        self.0.extent(items)
    }

    fn losses(&self, networks: &Networks, items: Vec<Stage1Item>, at: Moment) -> Result<Vec<Part>> {
        let is_poisoned = at.step == 3;
        let mut parts = self.0.losses(networks, items, at)?;
        if is_poisoned {
            parts.iter_mut().for_each(|part| part.value = part.value.clone() * f64::NAN);
        }
        Ok(parts)
    }
}

fn poisoned() -> Result<Found> {
    let temporary = temporary()?;
    let folder = extreme_people(temporary.path())?;
    let config = config(&["training.steps=8".into()]);
    let (networks, device) = (config.networks(), Device::flex().autodiff());
    let task = Poisoned(PointTask::new(from_ref(&folder), &config, &device)?);
    let fresh = Networks { predictor: Some(random_predictor(&networks, 3, &device)), regressors: Vec::new() };
    let (outcome, all_finite) = trained(&task, &config, fresh, &device)?;
    Ok(Found { note: format!("{} of {} steps skipped", outcome.skipped, outcome.step), ..Found::default() }
        .must(outcome.skipped == 1, "not one step was skipped")
        .must(outcome.finished && outcome.step == 8, "the training ended early")
        .must(all_finite, "a logged number or a weight is not finite"))
}
