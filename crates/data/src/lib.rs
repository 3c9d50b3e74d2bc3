//! Training data: scans and generated people are rendered, stored as data sets of views, and read as samples.

pub mod dataset;
mod jitter;
mod light;
pub mod prepare;
pub mod sample;
pub mod scan;
mod shard;
pub mod smplx;
#[cfg(test)]
mod testing;

pub use jitter::{Jitter, JitterConfig};
pub use light::LightConfig;
pub use shard::Shard;
