//! Cameras, 3D Gaussians and their PLY files: the lowest floor of snapsnap, on which the differentiable
//! rasteriser will stand.

mod camera;
mod error;
pub mod file;
mod gaussians;
pub mod ply;

pub use camera::{Camera, RigidTransform};
pub use error::SplatError;
pub use gaussians::Gaussians;
