//! How like the truth pictures and surfaces are, and what that costs: metrics, the evaluation of a model on a data set, error
//! against run time, numerical stability.

mod error;
pub mod geometry;
pub mod lpips;
pub mod pictures;
pub mod region;
pub mod score;
pub mod similarity;
pub mod statistics;

pub use error::EvalError;
