//! A session of a run: steps, validations, checkpoints, logs and previews.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use burn::tensor::Device;
use snapsnap_base::config::Schema;
use snapsnap_base::{FileError, file};
use snapsnap_eval::preview;
use snapsnap_net::weights;

use crate::checkpoint;
use crate::config::TrainConfig;
use crate::identity::Identity;
use crate::learner::Learner;
use crate::log::{self, Line, Log, PREVIEWS};
use crate::networks::Networks;
use crate::ranks::Ranks;
use crate::task::{Task, Validation};
use crate::{Result, TrainError};

/// Number of failed steps in a row after which a run ends.
const MAX_FAILURES: u64 = 20;

/// State of a run, relative to its folder.
pub const STATE: &str = "state/state.safetensors";
/// The state before [`STATE`], for a run whose last one is damaged.
const FORMER: &str = "state/former.safetensors";
/// Config of a run.
pub const CONFIG: &str = "config.toml";
/// Latest weights of a run.
pub const LAST: &str = "last.safetensors";
/// Weights of the best validation.
pub const BEST: &str = "best.safetensors";

/// Curves of the loss and of the validations.
pub const CURVES: &str = "curves.svg";
/// Files of a run besides its state.
pub const FILES: [&str; 6] = [BEST, LAST, CONFIG, CURVES, log::NAME, log::EVENTS];

/// Settings of a session.
pub struct Options<'a> {
    /// The run's folder. It must exist.
    pub folder: &'a Path,
    /// The training device, with gradients.
    pub device: &'a Device,
    /// The processes of the training. The first one alone writes files.
    pub ranks: &'a Ranks,
    /// Time after which the session ends.
    pub limit: Option<Duration>,
    /// Flag that ends the session.
    pub stop: &'a AtomicBool,
    /// Continue a run although its settings, data or predictor differ from the recorded ones.
    pub force: bool,
}

/// Receiver of a run's events.
pub trait Watch {
    /// A step was logged. `steps` is the number of steps of the run, `skipped` the number of skipped steps so far.
    fn step(&mut self, line: &Line, steps: u64, skipped: u64);
    /// A validation was made after `step` steps.
    fn validated(&mut self, _step: u64, _validation: &Validation) {}
    /// A message for the user.
    fn note(&mut self, _message: &str) {}
}

/// Outcome of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Steps so far.
    pub step: u64,
    /// Whether all steps were made.
    pub finished: bool,
    /// Skipped steps so far.
    pub skipped: u64,
    /// Step and score of the best validation.
    pub best: Option<(u64, f64)>,
    /// Seconds of training in all sessions.
    pub seconds: f64,
}

/// Trains `networks`, or continues from the state in the run's folder.
///
/// # Errors
/// [`TrainError`] if data cannot be read, a file cannot be written, or twenty steps in a row failed.
pub fn train<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    options: &Options,
    watch: &mut dyn Watch,
) -> Result<Outcome> {
    let mut session = Session::start(task, config, networks, options, watch)?;
    let steps = config.training.steps as u64;
    let first = session.learner.progress.step;
    while session.learner.progress.step < steps && !session.is_over() {
        session.step()?;
    }
    let progress = &session.learner.progress;
    // A finished run with its final validation and preview has nothing to write.
    if progress.step > first || first < steps || progress.shown < progress.step {
        session.finish()?;
    }
    let progress = &session.learner.progress;
    // Nothing was learned.
    if progress.step >= steps && progress.skipped == progress.step {
        let why = session.skipped.take().unwrap_or_else(|| "errors of an earlier session".into());
        return Err(TrainError::Stuck { count: progress.skipped, step: progress.step - 1, why });
    }
    Ok(Outcome {
        step: progress.step,
        finished: progress.step >= steps,
        skipped: progress.skipped,
        best: progress.best.map(|(step, score)| (step, f64::from_bits(score))),
        seconds: session.seconds(),
    })
}

/// Makes a few steps without writing anything. Returns the mean time of a step, without the first ones, and the time of a
/// validation, if the run has validations.
///
/// # Errors
/// As [`train`].
pub fn rehearse<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    device: &Device,
    ranks: &Ranks,
) -> Result<(Duration, Option<Duration>)> {
    /// First steps, which allocate memory and compile GPU kernels, and measured steps.
    const STEPS: [u32; 2] = [5, 5];
    let mut learner = Learner::new(task, config, networks, device, ranks);
    learner.compare(&Identity::of(task, config)?)?;
    let mut start = Instant::now();
    for made in 0..STEPS[0] + STEPS[1] {
        if made == STEPS[0] {
            start = Instant::now();
        }
        if let Err(skipped) = learner.step()? {
            return Err(TrainError::Unsuitable(format!("no step can be made: {skipped}")));
        }
    }
    let step = start.elapsed() / STEPS[1];
    let start = Instant::now();
    let validation = task.validate(&learner.averaged(), ranks)?.map(|_| start.elapsed());
    Ok((step, validation))
}

struct Session<'a, T: Task> {
    learner: Learner<'a, T>,
    options: &'a Options<'a>,
    watch: &'a mut dyn Watch,
    start: Instant,
    /// Only the first rank has one.
    log: Option<Log>,
    identity: Identity,
    /// Why the last skipped step was skipped.
    skipped: Option<String>,
    /// Seconds of earlier sessions.
    before: f64,
    /// Time and step of the last line of the log.
    logged: (Instant, u64),
}

impl<'a, T: Task> Session<'a, T> {
    fn start(
        task: &'a T,
        config: &'a TrainConfig,
        networks: Networks,
        options: &'a Options<'a>,
        watch: &'a mut dyn Watch,
    ) -> Result<Self> {
        let mut learner = Learner::new(task, config, networks, options.device, options.ranks);
        let state = options.folder.join(STATE);
        let identity = Identity::of(task, config)?;
        // The first rank decides, since it is about to write a state.
        let is_begun = options.ranks.gather(&state.exists())[0];
        let mut is_changed = false;
        if is_begun {
            let device = options.device.clone().inner();
            let there = match checkpoint::load(&state, &mut learner, &device) {
                Err(damaged) => {
                    let former = options.folder.join(FORMER);
                    let Ok(there) = checkpoint::load(&former, &mut learner, &device) else {
                        return Err(damaged);
                    };
                    watch.note(&format!("{damaged}; the run goes on from the state before it"));
                    there
                }
                Ok(there) => there,
            };
            if let Some(refusal) = identity.refusal(&there, options.force) {
                return Err(FileError::unsuitable(&state, refusal).into());
            }
            // Scores of other samples do not compare. A finished run keeps its best weights.
            let goes_on = learner.progress.step < config.training.steps as u64;
            if goes_on && identity.validates_otherwise(&there) && learner.progress.best.take().is_some() {
                watch.note("validations measure something else now: the best one so far counts no longer");
            }
            is_changed = goes_on && identity != there;
        }
        learner.compare(&identity)?;
        let is_first = options.ranks.is_first();
        // A frozen predictor is read from the latest weights.
        if is_first && is_changed {
            write_weights(&learner, &learner.averaged(), &options.folder.join(LAST))?;
            save_state(&state, &learner, &identity)?;
        }
        // The config is written after the state was loaded, which proves that it fits the run.
        let path = options.folder.join(CONFIG);
        let text = config.to_toml();
        if is_first && fs::read(&path).ok().as_deref() != Some(text.as_bytes()) {
            file::write_whole(&path, |out| out.write_all(text.as_bytes()))
                .map_err(FileError::write(&path))?;
        }
        // From the first state on, the folder is known to be this run's.
        if is_first && !is_begun {
            save_state(&state, &learner, &identity)?;
        }
        let log = is_first.then(|| Log::open(options.folder, learner.progress.step)).transpose()?;
        let (before, now, step) =
            (log.as_ref().map_or(0.0, Log::seconds), Instant::now(), learner.progress.step);
        Ok(Self {
            learner,
            options,
            watch,
            start: now,
            log,
            identity,
            skipped: None,
            before,
            logged: (now, step),
        })
    }

    /// Whether a rank has to stop.
    fn is_over(&self) -> bool {
        let is_over = self.options.stop.load(Ordering::Relaxed)
            || self.options.limit.is_some_and(|limit| self.start.elapsed() >= limit);
        self.options.ranks.gather(&is_over).contains(&true)
    }

    fn seconds(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64()
    }

    /// One step, and the validation, preview and checkpoint that are due after it.
    fn step(&mut self) -> Result<()> {
        let t = &self.learner.config.training;
        // A failed step leaves the learner unchanged, so that its state can be saved.
        let made = self.learner.step().or_else(|failed| self.save_last().and(Err(failed)))?;
        let now = self.learner.progress.step;
        let due = |every: usize| every > 0 && now.is_multiple_of(every as u64);
        match made {
            Ok(values) if due(t.log_every) => self.report(values)?,
            Ok(_) => {}
            Err(why) => {
                let step = now - 1;
                self.watch.note(&format!("step {step} skipped: {why}"));
                if self.learner.progress.skipped_in_a_row >= MAX_FAILURES {
                    return Err(TrainError::Stuck { count: MAX_FAILURES, step, why });
                }
                self.skipped = Some(why);
            }
        }
        if now >= t.steps as u64 {
            return Ok(());
        }
        if due(t.validate_every) {
            let validated = self.validate();
            self.spared("validation", validated)?;
        }
        // The first validation has a preview as well, so that a wrong training is seen early.
        if due(t.preview_every) || t.preview_every > 0 && now == t.validate_every as u64 {
            let previewed = self.preview();
            self.spared("preview", previewed)?;
        }
        if due(t.checkpoint_every) {
            self.save()?;
        }
        Ok(())
    }

    /// The final validation and preview of a run, and the files of every session.
    fn finish(&mut self) -> Result<()> {
        let is_last = self.learner.progress.step >= self.learner.config.training.steps as u64;
        let shown = if is_last { self.validate().and_then(|()| self.preview()) } else { Ok(()) };
        if is_last && shown.is_ok() {
            self.learner.progress.shown = self.learner.progress.step;
        }
        self.save_last()?;
        shown
    }

    /// Saves before the session ends. No rank ends before the first one has written.
    fn save_last(&mut self) -> Result<()> {
        self.save()?;
        self.options.ranks.gather(&());
        Ok(())
    }

    /// Turns the error of a sample into a note. The validation or preview is lost, but the run continues.
    fn spared(&mut self, what: &str, shown: Result<()>) -> Result<()> {
        match shown {
            Err(e @ (TrainError::Unsuitable(_) | TrainError::Splat(_) | TrainError::Elsewhere(_))) => {
                let step = self.learner.progress.step;
                self.watch.note(&format!("no {what} after step {step}: {e}"));
                Ok(())
            }
            shown => shown,
        }
    }

    fn report(&mut self, mut values: BTreeMap<String, f64>) -> Result<()> {
        let (t, now, step) = (&self.learner.config.training, Instant::now(), self.learner.progress.step);
        let rate = (step - self.logged.1) as f64 / (now - self.logged.0).as_secs_f64().max(1e-9);
        self.logged = (now, step);
        values.insert("steps_per_second".to_owned(), rate);
        values.insert("samples_per_second".to_owned(), rate * t.batch as f64);
        let line = Line { step, seconds: self.seconds(), values };
        self.watch.step(&line, t.steps as u64, self.learner.progress.skipped);
        self.add(line)
    }

    fn add(&mut self, line: Line) -> Result<()> {
        Ok(self.log.as_mut().map_or(Ok(()), |log| log.add(line))?)
    }

    fn validate(&mut self) -> Result<()> {
        let (networks, step) = (self.learner.averaged(), self.learner.progress.step);
        let validation = self.learner.task.validate(&networks, self.options.ranks)?;
        let Some(validation) = validation else { return Ok(()) };
        let beats = |best: u64| validation.score < f64::from_bits(best);
        if validation.score.is_finite() && self.learner.progress.best.is_none_or(|(_, best)| beats(best)) {
            if self.log.is_some() {
                write_weights(&self.learner, &networks, &self.options.folder.join(BEST))?;
            }
            self.learner.progress.best = Some((step, validation.score.to_bits()));
        }
        let named = validation.figures.iter().map(|(name, value)| (format!("validation/{name}"), *value));
        let score = ("validation/score".to_owned(), validation.score);
        // JSON has no numbers that are not finite.
        let values = named.chain([score]).filter(|(_, value)| value.is_finite()).collect();
        self.add(Line { step, seconds: self.seconds(), values })?;
        self.watch.validated(step, &validation);
        Ok(())
    }

    fn preview(&mut self) -> Result<()> {
        let Some(log) = &mut self.log else { return Ok(()) };
        let Some(sheet) = self.learner.task.preview(&self.learner.averaged())? else { return Ok(()) };
        let folder = self.options.folder.join(PREVIEWS);
        fs::create_dir_all(&folder).map_err(FileError::write(&folder))?;
        let path = folder.join(format!("{:07}.png", self.learner.progress.step));
        let png = preview::write_png(&path, &sheet)?;
        Ok(log.add_preview(self.learner.progress.step, sheet.dimensions(), &png)?)
    }

    /// Writes weights, state and curves. Weights are first, so that every state has its weights.
    fn save(&mut self) -> Result<()> {
        self.learner.compare(&self.identity)?;
        let Some(log) = &self.log else { return Ok(()) };
        write_weights(&self.learner, &self.learner.averaged(), &self.options.folder.join(LAST))?;
        save_state(&self.options.folder.join(STATE), &self.learner, &self.identity)?;
        let (path, svg) = (self.options.folder.join(CURVES), log.curves());
        Ok(file::write_whole(&path, |out| out.write_all(svg.as_bytes())).map_err(FileError::write(&path))?)
    }
}

/// Writes `networks` and the frozen predictor.
fn write_weights<T: Task>(learner: &Learner<T>, networks: &Networks, path: &Path) -> Result<()> {
    let mut values = networks.checkpoint();
    values.extend(learner.task.frozen());
    Ok(weights::save(&learner.config.networks(), &values, path)?)
}

fn save_state<T: Task>(path: &Path, learner: &Learner<T>, identity: &Identity) -> Result<()> {
    let folder = path.parent().expect("lies in a folder");
    fs::create_dir_all(folder).map_err(FileError::write(folder))?;
    let [next, former] = ["next", "former"].map(|name| path.with_file_name(format!("{name}.safetensors")));
    let _ = fs::remove_file(&next);
    // Where files cannot have two names, there is only one state.
    let is_kept = fs::hard_link(path, &next).is_ok();
    checkpoint::save(path, learner, identity)?;
    if is_kept {
        file::rename(&next, &former).map_err(FileError::write(&former))?;
    }
    Ok(())
}

/// Runs `work` on the best thread for its device. For the CPU it is a thread of rayon's pool, since any other thread
/// passes every operator to the pool and waits. Other devices order their work by the calling thread.
pub fn on_best_thread<R: Send>(device: &Device, work: impl FnOnce() -> R + Send) -> R {
    if device.clone().inner() == Device::flex() { rayon::scope(|_| work()) } else { work() }
}
