//! Atomic writing of files, errors that name files, configs, random streams, bilinear weights and plots. Every other
//! crate may use this one.

pub mod bilinear;
pub mod config;
mod error;
pub mod file;
pub mod folder;
pub mod plot;
pub mod random;

pub use error::{FileError, guarded, is_guarded, quoted};
