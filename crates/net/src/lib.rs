//! The networks of snapsnap: two photographs → point maps → Gaussians, and the files their weights come from.

pub mod config;
mod crop;
pub mod gaussians;
mod hull;
mod memory;
pub mod names;
mod neighbours;
pub mod network;
pub mod precision;
mod reconstruct;
pub mod regressor;
pub mod resample;
pub mod sides;
mod top;
pub mod u2net;
pub mod weights;

pub use crop::Window;
pub use hull::{carve, dilated};
pub use neighbours::Neighbours;
pub use reconstruct::{Photograph, Reconstruction, Reconstructor};
