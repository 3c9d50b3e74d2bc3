//! Progress on stderr: a bar or a spinner on a terminal, plain lines elsewhere, nothing with --quiet.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use crate::say;
use indicatif::{ProgressBar, ProgressStyle};

/// Bytes between two plain lines.
const LINE_BYTES: u64 = 500_000_000;

/// Plain lines over all steps of a command.
const LINES: u64 = 10;

/// Progress of one command.
pub struct Progress {
    bar: Option<ProgressBar>,
    plain: bool,
    /// Bytes or steps reported by the last plain line.
    reported: Cell<u64>,
    start: Instant,
}

impl Progress {
    /// Named modules one after another.
    pub fn stages(quiet: bool) -> Self {
        Self::new(quiet, ProgressBar::new_spinner(), "{spinner} {msg} [{elapsed}]")
    }

    /// Bytes of a file, with rate and time left.
    pub fn bytes(quiet: bool) -> Self {
        let template = "{bar:40} {bytes}/{total_bytes} {bytes_per_sec} {eta} left";
        Self::new(quiet, ProgressBar::new(0), template)
    }

    /// Equal steps of a known number, with rate and time left.
    pub fn steps(quiet: bool, total: usize, unit: &str) -> Self {
        let template = format!("{{bar:40}} {{pos}}/{{len}} {unit} {{per_sec}} {{eta}} left");
        Self::new(quiet, ProgressBar::new(total as u64), &template)
    }

    fn new(quiet: bool, bar: ProgressBar, template: &str) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = (!quiet && terminal).then(|| {
            bar.set_style(ProgressStyle::with_template(template).expect("a valid template"));
            bar.enable_steady_tick(Duration::from_millis(100));
            bar
        });
        Self { bar, plain: !quiet && !terminal, reported: Cell::new(0), start: Instant::now() }
    }

    /// A module starts.
    pub fn stage(&self, name: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(name.to_owned());
        } else if self.plain {
            say::err(&format!("{name} …"));
        }
    }

    /// So many steps of so many are done.
    pub fn step(&self, done: usize, total: usize, unit: &str) {
        let (done, total) = (done as u64, total as u64);
        if let Some(bar) = &self.bar {
            bar.set_length(total);
            bar.set_position(done);
        } else if self.plain
            && done > 0
            && (done == total || done >= self.reported.get() + total.div_ceil(LINES))
        {
            self.reported.set(done);
            let rate = done as f64 / self.start.elapsed().as_secs_f64();
            let left = (total - done) as f64 / rate;
            say::err(&format!("{done} of {total} {unit}, {rate:.1} a second, {left:.0} s left"));
        }
    }

    /// So many bytes of so many are done.
    pub fn advance(&self, done: u64, total: u64) {
        if let Some(bar) = &self.bar {
            bar.set_length(total);
            bar.set_position(done);
        } else if self.plain && done >= self.reported.get() + LINE_BYTES {
            self.reported.set(done);
            say::err(&format!("{} of {} MB", done / 1_000_000, total / 1_000_000));
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
