//! The regressor's network as one differentiable function over the fused convolutions.
//!
//! `layout` lists the operators and the places of their parameters; `forward` and `backward` run them.
//! The tape between them holds only the planes that group normalisations or convolutions read.

mod backward;
mod forward;
mod layout;

pub use forward::Saved;
pub use layout::Network;

/// Channels of the input: red, green, blue in [−1, 1], then x, y, z in metres (front camera's frame).
pub const INPUT_CHANNELS: usize = 6;
/// Channels of the features: opacity 1, scale 3, rotation 4, colour 3, offset 3.
pub const FEATURES: usize = 14;
/// Factor of every sum of two branches, which keeps the variance.
pub const BRANCH_SCALE: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Levels of the UNet.
pub const LEVELS: usize = 3;
