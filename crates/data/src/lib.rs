//! Training data and photographs: scans, from files or generated → rendered views → data-set folders → samples.

pub mod dataset;
mod error;
pub mod export;
pub mod import;
pub mod makehuman;
pub mod mesh;
mod pattern;
pub mod photo;
mod picture;
pub mod prepare;
pub mod random;
mod resize;
pub mod sample;
pub mod scan;
pub mod smplx;
pub mod synth;
#[cfg(test)]
mod testing;
pub mod view;

pub use error::DataError;
