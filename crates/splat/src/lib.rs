//! Cameras, 3D Gaussians, their files and the differentiable rasteriser.

pub mod adapter;
mod camera;
pub mod cameras;
mod error;
mod gaussians;
mod glb;
mod linear;
mod op;
mod options;
pub mod ply;
pub mod reference;
mod render;
pub mod scene;
pub mod sh;
mod sog;
mod spz;
mod stored;
mod vjp;

pub use camera::{Camera, Orbit, RigidTransform};
pub use error::SplatError;
pub use gaussians::{Gaussians, affine};
pub use op::{Counts, MAX_SIDE};
pub use options::{MIN_ALPHA, MIN_TRANSMITTANCE, Preset, RenderOptions, TILE};
pub use render::{Rendered, render};
