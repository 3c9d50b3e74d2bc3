//! Training data and photographs. So far: photographs.

pub mod photo;
mod resize;
