//! Steps in 16 bits: the point predictor's matrix products and convolutions, and what they keep for the backward pass. Weights,
//! moments and losses are left alone.

use serde::{Deserialize, Serialize};
pub use snapsnap_net::precision::Precision;

use crate::networks::Networks;

/// The networks with a predictor in this precision; gradients lead back to the one that was given.
pub fn lower(precision: Precision, networks: &Networks) -> Networks {
    let mut networks = networks.clone();
    networks.predictor = networks.predictor.map(|predictor| precision.lower(predictor));
    networks
}

/// What the loss is multiplied by before it is differentiated, and its gradients are divided by: halved where a gradient
/// is not finite, doubled after long without.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossScale {
    /// A power of two.
    pub factor: f64,
    /// Steps since it was changed.
    pub steps: u64,
}

impl Default for LossScale {
    /// At the beginning of a training.
    fn default() -> Self {
        Self { factor: Self::MOST, steps: 0 }
    }
}

impl LossScale {
    /// Where a training begins, and the most there is: 1 is reached before twenty failed steps in a row end a run.
    const MOST: f64 = 65_536.0;
    /// Steps until a larger one is tried.
    const PATIENCE: u64 = 2000;

    /// Whether a training can have come to this.
    pub fn is_sound(&self) -> bool {
        (1.0..=Self::MOST).contains(&self.factor) && self.steps < Self::PATIENCE
    }

    /// After a step that was made, or was not because of its gradients.
    pub fn update(&mut self, made: bool) {
        self.steps += 1;
        if !made {
            *self = Self { factor: (self.factor / 2.0).max(1.0), steps: 0 };
        } else if self.steps >= Self::PATIENCE {
            *self = Self { factor: (self.factor * 2.0).min(Self::MOST), steps: 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loss_scale_falls_at_once_and_rises_late() {
        let mut scale = LossScale::default();
        scale.update(false);
        assert_eq!(scale, LossScale { factor: 32_768.0, steps: 0 });
        (0..1999).for_each(|_| scale.update(true));
        assert_eq!(scale, LossScale { factor: 32_768.0, steps: 1999 });
        scale.update(true);
        assert_eq!(scale, LossScale { factor: 65_536.0, steps: 0 });
        (0..40).for_each(|_| scale.update(false));
        assert_eq!(scale.factor, 1.0);
    }
}
