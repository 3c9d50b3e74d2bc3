//! Tests of every device: parity with reference numbers, properties of the networks, the splatting operation, training.
//! They are one program, so that `cargo xtask bundle` can pack them for a machine without cargo.

mod bodies;
mod networks;
mod pipeline;
mod properties;
mod splat_fit;
mod splat_invariants;
mod splat_oracle;
mod steps;
mod training;

/// |`found` − `expected`|, ∞ for a NaN, which `f64::max` would ignore.
fn distance(found: f64, expected: f64) -> f64 {
    let distance = (found - expected).abs();
    if distance.is_nan() { f64::INFINITY } else { distance }
}
