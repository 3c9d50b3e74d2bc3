//! Training data and photographs: scans, from files or generated → rendered views → data-set folders → samples.

pub mod dataset;
mod error;
pub mod import;
pub mod mesh;
pub mod photo;
mod picture;
pub mod prepare;
pub mod random;
mod resize;
pub mod scan;
pub mod smplx;
pub mod view;

pub use error::DataError;
