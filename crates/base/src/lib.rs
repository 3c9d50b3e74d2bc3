//! The lowest floor of snapsnap: files that are written whole or not at all, the errors that name them, configs, random
//! streams, bilinear weights and plots. Every other crate may use it.

pub mod bilinear;
pub mod config;
mod error;
pub mod file;
pub mod plot;
pub mod random;

pub use error::{FileError, guarded, is_guarded, quoted};
