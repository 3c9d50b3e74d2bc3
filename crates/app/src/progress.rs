//! Progress on stderr: a bar or a spinner on a terminal, plain lines elsewhere, nothing with --quiet.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::say;

/// Plain lines over all steps of a command.
const LINES: u64 = 10;

/// The bar with this template, on a terminal and without --quiet.
pub fn shown(bar: ProgressBar, template: &str) -> Option<ProgressBar> {
    let style = || ProgressStyle::with_template(template).expect("a valid template");
    (!say::is_quiet() && std::io::stderr().is_terminal()).then(|| bar.with_style(style()))
}

/// Progress of one command.
pub struct Progress {
    /// It is cleared when it is dropped.
    bar: Option<ProgressBar>,
    /// Steps reported by the last plain line.
    reported: Cell<u64>,
    start: Instant,
}

impl Progress {
    /// Progress of named modules, one after another.
    pub fn stages() -> Self {
        Self::new(ProgressBar::new_spinner(), "{spinner} {msg} [{elapsed}]")
    }

    /// A function that is told the numbers of finished and of all steps, with rate and time left. The progress ends when
    /// the function is dropped.
    pub fn counted(unit: &'static str) -> impl Fn(usize, usize) {
        let template = format!("{{bar:40}} {{pos}}/{{len}} {unit} {{per_sec}} {{eta}} left");
        let progress = Self::new(ProgressBar::new(0), &template);
        move |done, total| progress.step(done, total, unit)
    }

    /// As [`Self::counted`], for finished and all bytes.
    pub fn megabytes() -> impl Fn(u64, u64) {
        let step = Self::counted("MB");
        let megabytes = |bytes: u64| (bytes / 1_000_000) as usize;
        move |done, total| step(megabytes(done), megabytes(total))
    }

    /// Iterates over `items` and counts each as a step when the next one is requested.
    pub fn over<T>(items: impl ExactSizeIterator<Item = T>, unit: &'static str) -> impl Iterator<Item = T> {
        let (total, step) = (items.len(), Self::counted(unit));
        items.map(Some).chain([None]).enumerate().map_while(move |(done, item)| {
            step(done, total);
            item
        })
    }

    fn new(bar: ProgressBar, template: &str) -> Self {
        let bar = shown(bar, template);
        bar.iter().for_each(|bar| bar.enable_steady_tick(Duration::from_millis(100)));
        Self { bar, reported: Cell::new(0), start: Instant::now() }
    }

    /// Reports the start of a module.
    pub fn stage(&self, name: &str) {
        match &self.bar {
            Some(bar) => bar.set_message(name.to_owned()),
            None => say::note(&format!("{name} …")),
        }
    }

    /// Reports the number of finished steps.
    fn step(&self, done: usize, total: usize, unit: &str) {
        let (done, total) = (done as u64, total as u64);
        if let Some(bar) = &self.bar {
            bar.set_length(total);
            bar.set_position(done);
        } else if done > self.reported.get()
            && (done == total || done >= self.reported.get() + total.div_ceil(LINES))
        {
            self.reported.set(done);
            let rate = done as f64 / self.start.elapsed().as_secs_f64();
            let left = (total - done) as f64 / rate;
            say::note(&format!("{done} of {total} {unit}, {rate:.1} a second, {left:.0} s left"));
        }
    }
}
