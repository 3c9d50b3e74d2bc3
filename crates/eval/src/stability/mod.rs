//! Extreme and degenerate inputs, each with its required result (docs/method.md, "Stability cases").

pub mod networks;
pub mod report;
pub mod splats;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use serde::Serialize;

/// An input and its required result.
#[derive(Serialize)]
pub struct Case {
    /// The area of the table: splats, networks, losses or training.
    pub area: &'static str,
    /// The input.
    pub input: String,
    /// The requirement.
    pub holds: String,
    /// Largest allowed error of values.
    pub value_limit: f64,
    /// Largest allowed error of gradients.
    pub gradient_limit: f64,
    /// Whether the case runs on the first device alone, since its result does not depend on the device.
    #[serde(skip)]
    pub once: bool,
    /// The test.
    #[serde(skip)]
    pub run: Run,
}

/// The test of a case on a device.
pub type Run = Box<dyn Fn(&Device) -> Found>;

impl Case {
    /// A case that runs on every device, with the limits of values and gradients.
    pub fn new(
        area: &'static str,
        input: impl Into<String>,
        holds: &str,
        [value_limit, gradient_limit]: [f64; 2],
        run: impl Fn(&Device) -> Found + 'static,
    ) -> Self {
        let (input, holds, run) = (input.into(), holds.into(), Box::new(run));
        Self { area, input, holds, value_limit, gradient_limit, once: false, run }
    }
}

/// The result of a case.
#[derive(Debug, Clone, Default)]
pub struct Found {
    /// Error of values against f64, as defined by the case; not finite if a value is not finite.
    pub value: Option<f64>,
    /// Relative error of gradients against f64.
    pub gradient: Option<f64>,
    /// Further observations.
    pub note: String,
    /// The first failed requirement.
    pub broken: Option<String>,
    /// The reason why the case does not run here, which is no failure.
    pub skipped: Option<String>,
}

impl Found {
    /// The result of a case that cannot run on this device.
    pub fn skipped(why: String) -> Self {
        Self { skipped: Some(why), ..Self::default() }
    }

    /// A failed result.
    pub fn broken(what: impl ToString) -> Self {
        Self { broken: Some(what.to_string()), ..Self::default() }
    }

    /// Records the failure `what` unless the requirement holds.
    pub fn must(mut self, holds: bool, what: &str) -> Self {
        if !holds && self.broken.is_none() {
            self.broken = Some(what.to_owned());
        }
        self
    }
}

/// The largest error, ∞ if one is NaN.
pub fn worst(errors: impl IntoIterator<Item = f64>) -> f64 {
    let number = |error: f64| if error.is_nan() { f64::INFINITY } else { error };
    errors.into_iter().map(number).fold(0.0, f64::max)
}

/// The difference of a value from its f64 reference.
pub fn apart(found: f32, expected: f64) -> f64 {
    (f64::from(found) - expected).abs()
}

/// A tracked tensor.
pub fn tracked<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), &device.clone().autodiff()).require_grad()
}

/// Whether no value is infinite or NaN.
pub fn all_finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// A row of the table.
#[derive(Serialize)]
pub struct Row<'a> {
    /// The case.
    #[serde(flatten)]
    pub case: &'a Case,
    /// Name of the device.
    pub device: String,
    /// `None` if it is absent or not finite.
    pub value_error: Option<f64>,
    /// `None` if it is absent or not finite.
    pub gradient_error: Option<f64>,
    /// Run time.
    pub seconds: f64,
    /// `holds`, `fails` or `skipped`.
    pub verdict: &'static str,
    /// Observations, the failed requirement, or why it was skipped.
    pub note: String,
}

/// Runs a case. A panic is a failure.
pub fn run<'a>(case: &'a Case, device: &Device, device_name: &str) -> Row<'a> {
    let start = Instant::now();
    let found = catch_unwind(AssertUnwindSafe(|| (case.run)(device))).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        let said = said.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
        Found::broken(format!("panicked: {}", said.unwrap_or_default()))
    });
    let within = |error: Option<f64>, limit: f64| error.is_none_or(|e| e <= limit);
    let (value, gradient) = (found.value, found.gradient);
    let found = found
        .must(within(value, case.value_limit), "values are off")
        .must(within(gradient, case.gradient_limit), "gradients are off");
    let (verdict, note) = match (found.skipped, found.broken) {
        (Some(why), _) => ("skipped", why),
        (None, Some(what)) => ("fails", format!("{what} {}", found.note).trim_end().to_owned()),
        (None, None) => ("holds", found.note),
    };
    Row {
        case,
        device: device_name.into(),
        value_error: value.filter(|v| v.is_finite()),
        gradient_error: gradient.filter(|v| v.is_finite()),
        seconds: start.elapsed().as_secs_f64(),
        verdict,
        note,
    }
}
