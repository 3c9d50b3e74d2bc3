//! What must be right on every device: parity with reference numbers, properties of the networks, the splatting operation.
//! One program, so that it can be taken to a machine that cannot build it (`cargo xtask bundle`).

mod bodies;
mod networks;
mod pipeline;
mod properties;
mod splat_fit;
mod splat_fixtures;
mod splat_invariants;
mod splat_oracle;
mod steps;
mod training;
