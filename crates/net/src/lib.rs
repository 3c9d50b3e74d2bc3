//! The networks of snapsnap (two photographs → point maps → Gaussians) and their weight files.

mod backing;
pub mod blazepose;
mod closed_top;
pub mod config;
mod hull;
mod memory;
mod nearest_colors;
pub mod network;
mod own_colors;
pub mod painter;
mod parameters;
mod photograph;
mod points;
pub mod precision;
mod predict;
mod reconstruct;
pub mod regressor;
pub mod resample;
pub mod steps;
pub mod u2net;
mod valid_pixels;
pub mod weights;
mod window;

pub use backing::backing;
pub use hull::dilated;
pub use nearest_colors::median;
pub use network::pixel_width;
pub use photograph::Photograph;
pub use points::Points;
pub use predict::Prediction;
pub use reconstruct::{Reconstruction, Reconstructor, placed, rows};
pub use window::Window;
