//! Extreme and degenerate inputs, each with its required result (docs/method.md, "Stability cases").

pub mod networks;
pub mod report;
pub mod splats;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use burn::tensor::Device;
use serde::Serialize;

/// An input, and what must hold of it.
pub struct Case {
    /// Splats, networks, losses, training.
    pub area: &'static str,
    /// What goes in.
    pub input: String,
    /// What must hold, for people.
    pub holds: String,
    /// Largest error of values that is allowed.
    pub value_limit: f64,
    /// Largest error of gradients that is allowed.
    pub gradient_limit: f64,
    /// Whether it runs on the first device alone: what is computed on the host, or says nothing about a device.
    pub once: bool,
    /// Does it.
    #[allow(clippy::type_complexity, reason = "a function")]
    pub run: Box<dyn Fn(&Device) -> Found>,
}

/// What a case found.
#[derive(Debug, Clone, Default)]
pub struct Found {
    /// Of values against f64, as the case says; not finite where they are not.
    pub value: Option<f64>,
    /// Of gradients against f64, relative.
    pub gradient: Option<f64>,
    /// What else was seen.
    pub note: String,
    /// Something that must hold and does not.
    pub broken: Option<String>,
    /// Why it could not be run here, which is no failure.
    pub skipped: Option<String>,
}

impl Found {
    /// Whether something that must hold does; told what if not.
    pub fn must(mut self, holds: bool, what: &str) -> Self {
        if !holds && self.broken.is_none() {
            self.broken = Some(what.to_owned());
        }
        self
    }
}

/// An error, ∞ for NaN: a largest of several would not see it.
fn nan_is_worst(v: f64) -> f64 {
    if v.is_nan() { f64::INFINITY } else { v }
}

/// A row of the table.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// As in [`Case`].
    pub area: String,
    /// As in [`Case`].
    pub input: String,
    /// In words.
    pub device: String,
    /// As in [`Case`].
    pub holds: String,
    /// `null` where there is none or it is not finite.
    pub value_error: Option<f64>,
    /// As in [`Case`].
    pub value_limit: f64,
    /// `null` where there is none or it is not finite.
    pub gradient_error: Option<f64>,
    /// As in [`Case`].
    pub gradient_limit: f64,
    /// What it took.
    pub seconds: f64,
    /// `holds`, `fails` or `skipped`.
    pub verdict: String,
    /// What else was seen, what broke, or why it was skipped.
    pub note: String,
}

/// Runs a case; what panics fails.
pub fn run(case: &Case, device: &Device, device_name: &str) -> Row {
    let start = Instant::now();
    let found = catch_unwind(AssertUnwindSafe(|| (case.run)(device))).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        let said = said.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
        Found { broken: Some(format!("panicked: {}", said.unwrap_or_default())), ..Found::default() }
    });
    let over = |error: Option<f64>, limit: f64| error.is_some_and(|e| e.is_nan() || e > limit);
    let (verdict, note) = match (&found.skipped, &found.broken) {
        (Some(why), _) => ("skipped", why.clone()),
        (None, Some(what)) => ("fails", format!("{what} {}", found.note).trim_end().to_owned()),
        _ if over(found.value, case.value_limit) => ("fails", format!("values are off {}", found.note)),
        _ if over(found.gradient, case.gradient_limit) => {
            ("fails", format!("gradients are off {}", found.note))
        }
        _ => ("holds", found.note.clone()),
    };
    Row {
        area: case.area.into(),
        input: case.input.clone(),
        device: device_name.into(),
        holds: case.holds.clone(),
        value_error: found.value.filter(|v| v.is_finite()),
        value_limit: case.value_limit,
        gradient_error: found.gradient.filter(|v| v.is_finite()),
        gradient_limit: case.gradient_limit,
        seconds: start.elapsed().as_secs_f64(),
        verdict: verdict.into(),
        note,
    }
}
