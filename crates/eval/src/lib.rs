//! How like the truth pictures are.

pub mod lpips;
