//! The networks of snapsnap: two photographs → point maps → Gaussians, and the files their weights come from.

pub mod config;
mod cpu;
pub mod network;
pub mod regressor;
pub mod resample;
pub mod weights;
