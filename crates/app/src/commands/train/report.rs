//! Progress of a training on the terminal.

use std::time::{Duration, Instant};

use burn::tensor::Device;
use indicatif::ProgressBar;
use snapsnap_train::config::TrainConfig;
use snapsnap_train::log::Line;
use snapsnap_train::run::Watch;
use snapsnap_train::task::Validation;

use crate::{device, memory, progress, say};

/// Seconds between two plain lines.
const PAUSE: Duration = Duration::from_secs(10);

/// Prints a bar on a terminal, plain lines elsewhere, and nothing with --quiet.
pub struct Reporter {
    bar: Option<ProgressBar>,
    start: Instant,
    limit: Option<Duration>,
    /// The first step that was logged.
    first: Option<u64>,
    printed: Option<Instant>,
}

impl Reporter {
    pub fn new(config: &TrainConfig, limit: Option<Duration>) -> Self {
        let bar = ProgressBar::new(config.training.steps as u64);
        let bar = progress::shown(bar, "{bar:20} {pos}/{len} {wide_msg}");
        Self { bar, start: Instant::now(), limit, first: None, printed: None }
    }

    fn line(&self, message: &str) {
        match &self.bar {
            Some(bar) => bar.println(say::printable(message)),
            None => say::note(message),
        }
    }

    /// Time until the end of the run or, if it is earlier, of the session.
    fn left(&self, line: &Line, steps: u64) -> String {
        let rate = line.values.get("steps_per_second").copied().unwrap_or_default();
        let run = (steps.saturating_sub(line.step)) as f64 / rate.max(1e-9);
        let session = self.limit.map(|limit| limit.saturating_sub(self.start.elapsed()).as_secs_f64());
        match session {
            Some(session) if session < run => format!("{} left in this session", clock(session)),
            _ => format!("{} left", clock(run)),
        }
    }
}

impl Watch for Reporter {
    fn step(&mut self, line: &Line, steps: u64, skipped: u64) {
        let value = |name: &str| line.values.get(name).copied().unwrap_or_default();
        /// Values that are not parts of the loss.
        const OTHERS: [&str; 6] =
            ["loss", "norm", "rate", "reduce_ms", "samples_per_second", "steps_per_second"];
        let parts: Vec<String> = line
            .values
            .iter()
            .filter(|(name, _)| !OTHERS.contains(&name.as_str()))
            .map(|(name, value)| format!("{name} {value:.4}"))
            .collect();
        let memory = memory::used().map_or(String::new(), |bytes| format!(", {:.1} GB", bytes as f64 / 1e9));
        let skipped = if skipped > 0 { format!(", {skipped} skipped") } else { String::new() };
        // A narrow terminal cuts off the end.
        let message = format!(
            "loss {:.4}, {}, {:.2} it/s{skipped}, {}, {:.1} samples/s, rate {:.1e}, norm {:.2}{memory}",
            value("loss"),
            self.left(line, steps),
            value("steps_per_second"),
            parts.join(", "),
            value("samples_per_second"),
            value("rate"),
            value("norm"),
        );
        let first = *self.first.get_or_insert(line.step);
        if let Some(bar) = &self.bar {
            bar.set_position(line.step);
            bar.set_message(message);
        } else if line.step == first || self.printed.is_none_or(|printed| printed.elapsed() >= PAUSE) {
            self.printed = Some(Instant::now());
            say::note(&format!("step {} of {steps}: {message}", line.step));
        }
    }

    fn validated(&mut self, step: u64, validation: &Validation) {
        let figures: Vec<String> =
            validation.figures.iter().map(|(name, value)| format!("{name} {value:.3}")).collect();
        self.line(&format!("step {step}: validation: {}", figures.join(", ")));
    }

    fn note(&mut self, message: &str) {
        self.line(&format!("note: {message}"));
    }
}

/// Hours, minutes and seconds.
fn clock(seconds: f64) -> String {
    let seconds = seconds.min(1e9) as u64;
    format!("{}:{:02}:{:02}", seconds / 3600, seconds / 60 % 60, seconds % 60)
}

/// Prints the time and memory that a run would take, from the times of a step and a validation.
pub fn rehearsed(config: &TrainConfig, on: &Device, (step, validation): (Duration, Option<Duration>)) {
    let t = &config.training;
    let step = step.as_secs_f64();
    let (device, samples) = (device::describe(&on.clone().inner()), t.batch);
    let rate = samples as f64 / step;
    say::out(&format!(
        "device {device}: a step of {samples} samples takes {step:.3} s, {rate:.1} samples a second"
    ));
    let mut total = step * t.steps as f64;
    if let Some(validation) = validation {
        let count = 1 + t.steps.checked_div(t.validate_every).unwrap_or(0);
        total += validation.as_secs_f64() * count as f64;
        say::out(&format!("a validation takes {:.1} s; there will be {count}", validation.as_secs_f64()));
    }
    if let Some(bytes) = memory::most_used() {
        say::out(&format!("memory: {:.2} GB at most so far", bytes as f64 / 1e9));
    }
    say::out(&format!("{} steps will take about {}", t.steps, clock(total)));
}
