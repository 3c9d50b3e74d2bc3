//! The networks of snapsnap: two photographs → point maps → Gaussians, and the files their weights come from.

mod chosen;
pub mod config;
mod crop;
pub mod gaussians;
mod hull;
mod memory;
pub mod names;
pub mod network;
mod photograph;
mod points;
pub mod precision;
mod predict;
mod reconstruct;
pub mod regressor;
pub mod resample;
pub mod sides;
pub mod steps;
mod top;
pub mod u2net;
pub mod weights;

pub use crop::Window;
pub use hull::dilated;
pub use photograph::Photograph;
pub use points::Points;
pub use predict::Prediction;
pub use reconstruct::{Reconstruction, Reconstructor, placed};
