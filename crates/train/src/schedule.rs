//! Learning rates over the steps of a run.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// A schedule as a share of the highest rate, for steps from 0 to one below [`Schedule::steps`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Schedule {
    /// PyTorch's `OneCycleLR` with cosine annealing, as the published code trains (SNAPSNAP §6).
    OneCycle {
        /// Steps of the cycle.
        steps: usize,
        /// Share of the steps that rise.
        rise: f64,
        /// The highest rate over the first.
        start_divisor: f64,
        /// The first rate over the last.
        end_divisor: f64,
    },
    /// A linear rise, then half a cosine.
    Cosine {
        /// All steps.
        steps: usize,
        /// Steps that rise.
        warm_up: usize,
        /// The last rate over the highest.
        end: f64,
    },
}

impl Schedule {
    /// All steps.
    pub fn steps(&self) -> usize {
        match self {
            Self::OneCycle { steps, .. } | Self::Cosine { steps, .. } => *steps,
        }
    }

    /// Share of the highest rate at a step; beyond the last step the last share.
    pub fn share(&self, step: usize) -> f64 {
        let anneal = |from: f64, to: f64, progress: f64| {
            to + (from - to) / 2.0 * (1.0 + (PI * progress.clamp(0.0, 1.0)).cos())
        };
        let at = step.min(self.steps().saturating_sub(1)) as f64;
        match *self {
            Self::OneCycle { steps, rise, start_divisor, end_divisor } => {
                let start = 1.0 / start_divisor;
                let peak = rise * steps as f64 - 1.0;
                if at < peak {
                    return anneal(start, 1.0, at / peak);
                }
                let fall = (steps as f64 - 1.0 - peak).max(f64::MIN_POSITIVE);
                anneal(1.0, start / end_divisor, (at - peak) / fall)
            }
            Self::Cosine { warm_up, .. } if at < warm_up as f64 => (at + 1.0) / (warm_up as f64 + 1.0),
            Self::Cosine { steps, warm_up, end } => {
                let fall = (steps.saturating_sub(1).saturating_sub(warm_up)).max(1) as f64;
                anneal(1.0, end, (at - warm_up as f64) / fall)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of the published run: 4e-6, 1e-4 at step 1000, 4e-10 (SNAPSNAP §6).
    #[test]
    fn one_cycle_is_the_published_one() {
        let schedule =
            Schedule::OneCycle { steps: 100_100, rise: 0.01, start_divisor: 25.0, end_divisor: 1e4 };
        let rate = |step| 1e-4 * schedule.share(step);
        assert!((rate(0) - 4e-6).abs() < 1e-12);
        assert!((rate(1000) - 1e-4).abs() < 1e-12);
        assert!((rate(100_099) - 4e-10).abs() < 1e-14 && (rate(200_000) - 4e-10).abs() < 1e-14);
        let short = Schedule::OneCycle { steps: 100, rise: 0.01, start_divisor: 25.0, end_divisor: 1e4 };
        assert!((0..100).all(|step| short.share(step).is_finite()) && (short.share(0) - 1.0).abs() < 1e-12);
        assert!(rate(500) > rate(400) && rate(50_000) > rate(60_000));
    }

    #[test]
    fn cosine_rises_and_ends_where_it_should() {
        let schedule = Schedule::Cosine { steps: 1000, warm_up: 99, end: 1e-3 };
        assert!((schedule.share(0) - 0.01).abs() < 1e-12 && (schedule.share(98) - 0.99).abs() < 1e-12);
        assert!((schedule.share(99) - 1.0).abs() < 1e-12 && (schedule.share(999) - 1e-3).abs() < 1e-12);
        let short = Schedule::Cosine { steps: 1, warm_up: 0, end: 0.1 };
        assert!(short.share(0).is_finite() && short.share(7).is_finite());
    }
}
