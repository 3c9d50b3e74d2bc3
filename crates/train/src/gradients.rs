//! The gradients of a step, their common norm, and its limit.

use std::collections::BTreeMap;

use burn::module::Param;
use burn::tensor::{Device, Gradients, Tensor};
use snapsnap_net::weights::{NamedVisitor, ParameterPath};
use snapsnap_ops::host;

use crate::networks::{Networks, Rows, moved, split};
use crate::ranks::Ranks;

/// The gradients of all parameters that have one.
pub fn collect(networks: &Networks, gradients: &mut Gradients) -> Rows {
    struct Collect<'a> {
        gradients: &'a mut Gradients,
        rows: Rows,
    }
    impl NamedVisitor for Collect<'_> {
        fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
            if let Some(gradient) = parameter.val().grad_remove(self.gradients) {
                self.rows.insert(path.name(), gradient.reshape([-1]));
            }
        }
    }
    let mut collect = Collect { gradients, rows: Rows::new() };
    networks.visit(&mut collect);
    collect.rows
}

/// Sums of all ranks' gradients, on a device. A rank may lack some gradients. `sizes` are the numbers of values of
/// all parameters, which are the same on all ranks.
pub fn reduce(ranks: &Ranks, mut gradients: Rows, sizes: &BTreeMap<String, usize>, device: &Device) -> Rows {
    /// Values that are summed at once.
    const BUCKET: usize = 1 << 22;
    if ranks.size == 1 {
        return moved(gradients, device);
    }
    let present: Vec<bool> = sizes.keys().map(|name| gradients.contains_key(name)).collect();
    let everywhere = ranks.gather(&present);
    let is_present = |place: usize| everywhere.iter().any(|present| present[place]);
    let mut sums = Rows::new();
    let (mut bucket, mut inside) = (Vec::new(), Vec::new());
    for (place, (name, length)) in sizes.iter().enumerate() {
        if is_present(place) {
            bucket.extend(gradients.remove(name).map_or_else(|| vec![0.0; *length], host));
            inside.push((name.clone(), *length));
        }
        if !inside.is_empty() && (bucket.len() >= BUCKET || place + 1 == sizes.len()) {
            ranks.sum(&mut bucket);
            sums.extend(split(std::mem::take(&mut inside), &bucket, device));
            bucket.clear();
        }
    }
    sums
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
