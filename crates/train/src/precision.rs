//! Steps in 16 bits: matrix products and convolutions of the point predictor, and their intermediate results for the
//! backward pass. Weights, moments and losses stay in 32 bits.

pub use snapsnap_net::precision::Precision;

use crate::networks::Networks;

/// The networks with a predictor in this precision. Gradients flow back to the given networks.
pub fn lower(precision: Precision, networks: &Networks) -> Networks {
    let mut networks = networks.clone();
    networks.predictor = networks.predictor.map(|predictor| precision.lower(predictor));
    networks
}
