//! Photographs and training data: scans and generated people → rendered views → data sets → samples.

pub mod dataset;
mod jitter;
mod light;
pub mod prepare;
pub mod sample;
pub mod scan;
pub mod smplx;
#[cfg(test)]
mod testing;

pub use jitter::{Jitter, JitterConfig};
pub use light::LightConfig;
