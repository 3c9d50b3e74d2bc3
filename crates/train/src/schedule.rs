//! Learning rates over the steps of a run.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// One cycle, as published: the number of steps by which the cycle is longer than the run, the share of the steps in
/// which the rate rises, the highest rate divided by the first, and the first rate divided by the last.
const OVERHANG: usize = 100;
const RISE: f64 = 0.01;
const START_DIVISOR: f64 = 25.0;
const END_DIVISOR: f64 = 1e4;
/// The last rate of the other schedules, divided by the highest.
const END: f64 = 0.01;

/// A schedule as a share of the highest rate: the section `[schedule]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Schedule {
    /// PyTorch's `OneCycleLR` with cosine annealing, as in the published code
    /// (docs/method.md, "Optimisation and schedules").
    OneCycle {},
    /// A linear rise of `warm_up` steps, then half a cosine.
    Cosine { warm_up: usize },
    /// A linear rise of `warm_up` steps, the highest rate, and a linear fall in the last `fall` steps
    /// ("warmup-stable-decay"). While the rate is constant, it does not depend on the number of steps, so that a run's
    /// end can be set later.
    Trapezoid { warm_up: usize, fall: usize },
}

impl Default for Schedule {
    /// The schedule of the published code.
    fn default() -> Self {
        Self::OneCycle {}
    }
}

impl Schedule {
    /// The first key that makes no sense in a run of `steps`, and why.
    pub fn problem(&self, steps: usize) -> Option<(&'static str, String)> {
        match *self {
            Self::Cosine { warm_up } if warm_up > steps => {
                Some(("warm_up", format!("is {warm_up}, must be at most `training.steps` ({steps})")))
            }
            Self::Trapezoid { warm_up, fall } if warm_up.saturating_add(fall) > steps => {
                let message = format!("is {fall}, with `warm_up` must be at most `training.steps` ({steps})");
                Some(("fall", message))
            }
            _ => None,
        }
    }

    /// Share of the highest rate at a step of a run of `steps`. Later steps have the share of the last.
    pub fn share(&self, step: usize, steps: usize) -> f64 {
        let anneal = |from: f64, to: f64, progress: f64| {
            to + (from - to) / 2.0 * (1.0 + (PI * progress.clamp(0.0, 1.0)).cos())
        };
        let steps = match self {
            Self::OneCycle {} => steps + OVERHANG,
            Self::Cosine { .. } | Self::Trapezoid { .. } => steps,
        };
        let at = step.min(steps.saturating_sub(1)) as f64;
        match *self {
            Self::OneCycle {} => {
                let start = 1.0 / START_DIVISOR;
                let peak = RISE * steps as f64 - 1.0;
                if at < peak {
                    return anneal(start, 1.0, at / peak);
                }
                let fall = (steps as f64 - 1.0 - peak).max(f64::MIN_POSITIVE);
                anneal(1.0, start / END_DIVISOR, (at - peak) / fall)
            }
            Self::Cosine { warm_up } | Self::Trapezoid { warm_up, .. } if at < warm_up as f64 => {
                (at + 1.0) / (warm_up as f64 + 1.0)
            }
            Self::Cosine { warm_up } => {
                let fall = (steps.saturating_sub(1).saturating_sub(warm_up)).max(1) as f64;
                anneal(1.0, END, (at - warm_up as f64) / fall)
            }
            Self::Trapezoid { fall: 0, .. } => 1.0,
            Self::Trapezoid { fall, .. } => {
                let left = steps.saturating_sub(1) as f64 - at;
                END + (1.0 - END) * (left / fall as f64).min(1.0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rates of the published run: 4e-6, 1e-4 at step 1000, 4e-10 (docs/method.md, "Check values").
    #[test]
    fn one_cycle_is_the_published_one() {
        let schedule = Schedule::default();
        let rate = |step| 1e-4 * schedule.share(step, 100_000);
        assert!((rate(0) - 4e-6).abs() < 1e-12);
        assert!((rate(1000) - 1e-4).abs() < 1e-12);
        assert!((rate(100_099) - 4e-10).abs() < 1e-14 && (rate(200_000) - 4e-10).abs() < 1e-14);
        let short = |step| schedule.share(step, 100);
        assert!((0..200).all(|step| short(step).is_finite()) && short(1) > short(0));
        assert!(rate(500) > rate(400) && rate(50_000) > rate(60_000));
    }

    #[test]
    fn trapezoid_is_constant_until_it_falls() {
        let schedule = Schedule::Trapezoid { warm_up: 9, fall: 100 };
        let share = |step| schedule.share(step, 1000);
        assert!((9..900).all(|step| share(step) == 1.0), "constant");
        // 100 steps from the highest rate to the last.
        for (step, expected) in [(0, 0.1), (8, 0.9), (949, 0.505), (999, 0.01)] {
            assert!((share(step) - expected).abs() < 1e-12, "{step}: {}", share(step));
        }
        assert_eq!(share(2000), share(999));
        assert_eq!(schedule.share(500, 100_000), share(500), "whatever the number of steps");
        assert_eq!(schedule.problem(1000), None);
        assert_eq!(schedule.problem(108).map(|(key, _)| key), Some("fall"));
        let endless = Schedule::Trapezoid { warm_up: 1, fall: usize::MAX };
        assert_eq!(endless.problem(1000).map(|(key, _)| key), Some("fall"));
        let step = Schedule::Trapezoid { warm_up: 0, fall: 0 };
        assert_eq!([0, 8, 9].map(|at| step.share(at, 10)), [1.0; 3]);
    }
}
