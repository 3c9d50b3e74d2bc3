//! A session of a run: steps, with validations, checkpoints, logs and previews in between.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use burn::tensor::Device;
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_eval::preview;
use snapsnap_net::weights;

use crate::checkpoint;
use crate::config::TrainConfig;
use crate::learner::Learner;
use crate::log::{Line, Log};
use crate::networks::Networks;
use crate::task::{Task, Validation};
use crate::{TrainError, curves};

/// So many steps in a row may fail before a run gives up.
const PATIENCE: u64 = 20;

/// Where the state of a run lies in its folder.
pub const STATE: &str = "state/state.safetensors";
/// Its config in force.
pub const CONFIG: &str = "config.toml";
/// The latest weights of a run.
pub const LAST: &str = "last.safetensors";
/// The weights that did best in a validation.
pub const BEST: &str = "best.safetensors";

/// How a session is made, beside the run's config.
pub struct Options<'a> {
    /// The run's folder, which is there.
    pub folder: &'a Path,
    /// Where it is computed: one device at least, with gradients.
    pub devices: &'a [Device],
    /// Ends the session after so long.
    pub limit: Option<Duration>,
    /// Ends the session once it is set.
    pub stop: &'a AtomicBool,
}

/// What hears how a run goes.
pub trait Watch {
    /// A step was logged: the line of the log, how many steps there will be, and how many were skipped so far.
    fn step(&mut self, line: &Line, steps: u64, skipped: u64);
    /// A validation was made after so many steps.
    fn validated(&mut self, step: u64, validation: &Validation);
    /// Something that a person should know.
    fn note(&mut self, message: &str);
}

/// How a session ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Steps so far.
    pub step: u64,
    /// Whether all steps were made.
    pub finished: bool,
    /// Steps that were skipped.
    pub skipped: u64,
    /// Step and score of the best validation.
    pub best: Option<(u64, f64)>,
    /// Seconds of training, all sessions together.
    pub seconds: f64,
}

/// Trains `networks`, freshly made, or goes on where the state in the run's folder says.
///
/// # Errors
/// [`TrainError`] if data cannot be read, a file cannot be written, or twenty steps in a row failed.
pub fn train<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    options: &Options,
    watch: &mut dyn Watch,
) -> Result<Outcome, TrainError> {
    let mut session = Session::start(task, config, networks, options, watch)?;
    let steps = config.training.steps as u64;
    let first = session.learner.progress.step;
    while session.learner.progress.step < steps && !session.is_over() {
        session.step()?;
    }
    let progress = &session.learner.progress;
    // A run that was finished before, its last validation and preview included, has nothing to write.
    if progress.step > first || first < steps || progress.shown < progress.step {
        session.finish()?;
    }
    let progress = &session.learner.progress;
    Ok(Outcome {
        step: progress.step,
        finished: progress.step >= steps,
        skipped: progress.skipped,
        best: progress.best.map(|(step, score)| (step, f64::from_bits(score))),
        seconds: session.seconds(),
    })
}

/// What a step takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rehearsal {
    /// Mean time of a step, the first ones left out.
    pub step: Duration,
    /// Time of one validation, if there is one.
    pub validation: Option<Duration>,
}

/// Makes a few steps without writing anything, and measures the last ones.
///
/// # Errors
/// As [`train`].
pub fn rehearse<T: Task>(
    task: &T,
    config: &TrainConfig,
    networks: Networks,
    devices: &[Device],
) -> Result<Rehearsal, TrainError> {
    /// The first steps find their memory, and on a GPU their kernels.
    const STEPS: [u32; 2] = [5, 5];
    let mut learner = Learner::new(task, config, networks, devices);
    let mut start = Instant::now();
    let (mut made, mut failed) = (0, 0);
    while made < STEPS[0] + STEPS[1] {
        if made == STEPS[0] {
            start = Instant::now();
        }
        match learner.step()? {
            Ok(_) => made += 1,
            // The loss scale of f16 is found by trying.
            Err(_) if learner.progress.loss_scale.is_some() && failed < PATIENCE => {
                (made, failed) = (0, failed + 1);
            }
            Err(skipped) => {
                return Err(TrainError::Unsuitable(format!("no step can be made: {skipped}")));
            }
        }
    }
    let step = start.elapsed() / STEPS[1];
    let start = Instant::now();
    let validation = task.validate(&learner.averaged())?.map(|_| start.elapsed());
    Ok(Rehearsal { step, validation })
}

struct Session<'a, T: Task> {
    learner: Learner<'a, T>,
    options: &'a Options<'a>,
    watch: &'a mut dyn Watch,
    start: Instant,
    log: Log,
    /// Seconds of earlier sessions.
    before: f64,
    /// When the last line was logged, and at which step.
    logged: (Instant, u64),
}

impl<'a, T: Task> Session<'a, T> {
    fn start(
        task: &'a T,
        config: &'a TrainConfig,
        networks: Networks,
        options: &'a Options<'a>,
        watch: &'a mut dyn Watch,
    ) -> Result<Self, TrainError> {
        let mut learner = Learner::new(task, config, networks, options.devices);
        let state = options.folder.join(STATE);
        if state.exists() {
            checkpoint::load(&state, &mut learner, &options.devices[0].clone().inner())?;
        }
        // Only now is it sure that the config goes with the run.
        let path = options.folder.join(CONFIG);
        let text = config.to_toml();
        if fs::read(&path).ok().as_deref() != Some(text.as_bytes()) {
            file::write_whole(&path, |out| out.write_all(text.as_bytes()))
                .map_err(FileError::write(&path))?;
        }
        let log = Log::open(options.folder, learner.progress.step)?;
        let (before, now, step) = (log.seconds(), Instant::now(), learner.progress.step);
        Ok(Self { learner, options, watch, start: now, log, before, logged: (now, step) })
    }

    fn is_over(&self) -> bool {
        self.options.stop.load(Ordering::Relaxed)
            || self.options.limit.is_some_and(|limit| self.start.elapsed() >= limit)
    }

    fn seconds(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64()
    }

    /// One step and what is due after it.
    fn step(&mut self) -> Result<(), TrainError> {
        let t = &self.learner.config.training;
        // What fails leaves everything as it was before the step.
        let made = self.learner.step().or_else(|failed| self.save().and(Err(failed)))?;
        let now = self.learner.progress.step;
        let due = |every: usize| every > 0 && now.is_multiple_of(every as u64);
        match made {
            Ok(values) if due(t.log_every) => self.report(values)?,
            Ok(_) => {}
            Err(why) => {
                let step = now - 1;
                self.watch.note(&format!("step {step} skipped: {why}"));
                if self.learner.progress.skipped_in_a_row >= PATIENCE {
                    return Err(TrainError::Stuck { count: PATIENCE, step, why });
                }
            }
        }
        if now >= t.steps as u64 {
            return Ok(());
        }
        if due(t.validate_every) {
            let validated = self.validate();
            self.spared("validation", validated)?;
        }
        if due(t.preview_every) {
            let previewed = self.preview();
            self.spared("preview", previewed)?;
        }
        if due(t.checkpoint_every) {
            self.save()?;
        }
        Ok(())
    }

    /// What a run's folder holds at the session's end.
    fn finish(&mut self) -> Result<(), TrainError> {
        let is_last = self.learner.progress.step >= self.learner.config.training.steps as u64;
        let shown = if is_last { self.validate().and_then(|()| self.preview()) } else { Ok(()) };
        if is_last && shown.is_ok() {
            self.learner.progress.shown = self.learner.progress.step;
        }
        self.save()?;
        shown
    }

    /// People who cannot be read or rendered cost what they were to show, not the run.
    fn spared(&mut self, what: &str, shown: Result<(), TrainError>) -> Result<(), TrainError> {
        match shown {
            Err(e @ (TrainError::Unsuitable(_) | TrainError::Splat(_))) => {
                let step = self.learner.progress.step;
                self.watch.note(&format!("no {what} after step {step}: {e}"));
                Ok(())
            }
            shown => shown,
        }
    }

    fn report(&mut self, mut values: BTreeMap<String, f64>) -> Result<(), TrainError> {
        let (t, now, step) = (&self.learner.config.training, Instant::now(), self.learner.progress.step);
        let rate = (step - self.logged.1) as f64 / (now - self.logged.0).as_secs_f64().max(1e-9);
        self.logged = (now, step);
        values.insert("steps_per_second".to_owned(), rate);
        values.insert("samples_per_second".to_owned(), rate * (t.batch * t.accumulate) as f64);
        let line = Line { step, seconds: self.seconds(), values };
        self.watch.step(&line, t.steps as u64, self.learner.progress.skipped);
        Ok(self.log.add(line)?)
    }

    fn validate(&mut self) -> Result<(), TrainError> {
        let (networks, step) = (self.learner.averaged(), self.learner.progress.step);
        let Some(validation) = self.learner.task.validate(&networks)? else { return Ok(()) };
        let beats = |best: u64| validation.score < f64::from_bits(best);
        if validation.score.is_finite() && self.learner.progress.best.is_none_or(|(_, best)| beats(best)) {
            self.write(&networks, BEST)?;
            self.learner.progress.best = Some((step, validation.score.to_bits()));
        }
        let named = validation.figures.iter().map(|(name, value)| (format!("validation/{name}"), *value));
        let score = ("validation/score".to_owned(), validation.score);
        // What is not finite has no place in a log, and is never the best.
        let values = named.chain([score]).filter(|(_, value)| value.is_finite()).collect();
        self.log.add(Line { step, seconds: self.seconds(), values })?;
        self.watch.validated(step, &validation);
        Ok(())
    }

    fn write(&self, networks: &Networks, name: &str) -> Result<(), TrainError> {
        let mut values = networks.checkpoint();
        values.extend(self.learner.task.frozen(networks));
        Ok(weights::save(&self.learner.config.networks(), &values, &self.options.folder.join(name))?)
    }

    fn preview(&mut self) -> Result<(), TrainError> {
        let Some(sheet) = self.learner.task.preview(&self.learner.averaged())? else { return Ok(()) };
        let folder = self.options.folder.join("previews");
        fs::create_dir_all(&folder).map_err(FileError::write(&folder))?;
        let path = folder.join(format!("{:07}.png", self.learner.progress.step));
        Ok(preview::write_png(&path, &sheet)?)
    }

    /// Weights first: where there is a state, there are its weights as well.
    fn save(&mut self) -> Result<(), TrainError> {
        self.write(&self.learner.averaged(), LAST)?;
        let path = self.options.folder.join(STATE);
        let folder = path.parent().expect("lies in a folder");
        fs::create_dir_all(folder).map_err(FileError::write(folder))?;
        checkpoint::save(&path, &self.learner)?;
        let (path, svg) = (self.options.folder.join("curves.svg"), curves::draw(&self.log.lines));
        Ok(file::write_whole(&path, |out| out.write_all(svg.as_bytes())).map_err(FileError::write(&path))?)
    }
}

/// Runs `work` where the CPU's operators are fastest: on one of rayon's own threads. (A caller from outside hands every
/// operator over and waits.) On other devices, which order work by the calling thread, it stays where it is; so it does
/// with several, whose threads would wait for the one that waits for them.
pub fn on_best_thread<R: Send>(devices: &[Device], work: impl FnOnce() -> R + Send) -> R {
    if matches!(devices, [device] if device.clone().inner() == Device::flex()) {
        let mut result = None;
        rayon::scope(|_| result = Some(work()));
        result.expect("the scope runs it")
    } else {
        work()
    }
}
