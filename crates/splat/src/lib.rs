//! Cameras, 3D Gaussians, their files and the differentiable rasteriser.

mod camera;
pub mod camera_file;
mod error;
mod gaussians;
mod glb;
#[cfg(feature = "gpu")]
pub mod graphics_api;
mod linear;
mod op;
mod options;
pub mod ply;
mod projection;
pub mod reference;
mod render;
pub mod scene;
pub mod sh;
mod sog;
mod splat_file;
mod spz;
mod stored;

pub use camera::{Camera, Orbit, RigidTransform};
pub use error::SplatError;
pub use gaussians::{Gaussians, affine};
pub use glb::linear_light;
pub use op::Counts;
pub use options::{MAX_SIDE, MIN_ALPHA, MIN_TRANSMITTANCE, Preset, RenderOptions, TILE};
pub use render::{Rendered, render};
