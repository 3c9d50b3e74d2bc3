//! The gradients of a step, their common norm, and its limit.

use burn::module::Param;
use burn::tensor::{Gradients, Tensor};
use snapsnap_net::weights::{NamedVisitor, Path};
use snapsnap_ops::host;

use crate::networks::{Networks, Rows};

/// The gradients of all parameters that have one.
pub fn collect(networks: &Networks, gradients: &mut Gradients) -> Rows {
    struct Collect<'a> {
        gradients: &'a mut Gradients,
        rows: Rows,
    }
    impl NamedVisitor for Collect<'_> {
        fn visit<const D: usize>(&mut self, path: &Path, parameter: &Param<Tensor<D>>) {
            if let Some(gradient) = parameter.val().grad_remove(self.gradients) {
                self.rows.insert(path.name(), gradient.reshape([-1]));
            }
        }
    }
    let mut collect = Collect { gradients, rows: Rows::new() };
    networks.visit(&mut collect);
    collect.rows
}

/// Adds the gradients of one batch to those of the others.
pub fn add(sum: &mut Rows, gradients: Rows) {
    for (name, gradient) in gradients {
        let total = match sum.remove(&name) {
            Some(total) => total + gradient,
            None => gradient,
        };
        sum.insert(name, total);
    }
}

/// The Euclidean norm of all gradients together. It is not finite if a gradient is not.
pub fn norm(gradients: &Rows) -> f64 {
    let sums: Vec<_> = gradients.values().map(|gradient| gradient.clone().square().sum()).collect();
    if sums.is_empty() {
        return 0.0;
    }
    // One read-back, and a sum in f64.
    host(Tensor::cat(sums, 0)).into_iter().map(f64::from).sum::<f64>().sqrt()
}

/// Factor of PyTorch's `clip_grad_norm_` for gradients of this norm; `None` for a norm that is not finite.
pub fn clip_factor(norm: f64, limit: f64) -> Option<f64> {
    /// PyTorch's guard against a division by 0.
    const EPSILON: f64 = 1e-6;
    norm.is_finite().then(|| (limit / (norm + EPSILON)).min(1.0))
}
