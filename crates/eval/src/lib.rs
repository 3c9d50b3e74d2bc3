//! Metrics of pictures and surfaces, the evaluation of a model on a data set, error against run time, numerical
//! stability.

pub mod bench;
mod error;
pub mod evaluate;
pub mod foreign;
pub mod geometry;
pub mod lpips;
pub mod parts;
pub mod pictures;
pub mod points;
pub mod preview;
pub mod region;
pub mod report;
pub mod score;
pub mod similarity;
pub mod stability;
pub mod statistics;
pub mod variant;

pub use error::{EvalError, Result};
