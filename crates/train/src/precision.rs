//! Steps in 16 bits: matrix products and convolutions of the point predictor, and their intermediate results for the
//! backward pass. Weights, moments and losses stay in 32 bits.

use serde::{Deserialize, Serialize};
pub use snapsnap_net::precision::Precision;

use crate::networks::Networks;

/// The networks with a predictor in this precision. Gradients flow back to the given networks.
pub fn lower(precision: Precision, networks: &Networks) -> Networks {
    let mut networks = networks.clone();
    networks.predictor = networks.predictor.map(|predictor| precision.lower(predictor));
    networks
}

/// Factor of the loss before the backward pass; gradients are divided by it. It is halved after a gradient that is not
/// finite, and doubled after many steps without one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossScale {
    /// A power of two.
    pub factor: f64,
    /// Steps since the last change.
    pub steps: u64,
}

impl Default for LossScale {
    /// The initial factor.
    fn default() -> Self {
        Self { factor: Self::MOST, steps: 0 }
    }
}

impl LossScale {
    /// Initial and largest factor. Sixteen failed steps reduce it to 1, and twenty in a row end a run.
    const MOST: f64 = 65_536.0;
    /// Steps before the factor is doubled.
    const INTERVAL: u64 = 2000;

    /// Whether a training can have this state.
    pub fn is_sound(&self) -> bool {
        (1.0..=Self::MOST).contains(&self.factor) && self.steps < Self::INTERVAL
    }

    /// Records a step, or, with `made` false, one that was skipped because of its gradients.
    pub fn update(&mut self, made: bool) {
        self.steps += 1;
        if !made {
            *self = Self { factor: (self.factor / 2.0).max(1.0), steps: 0 };
        } else if self.steps >= Self::INTERVAL {
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
