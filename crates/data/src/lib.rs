//! Training data and photographs. So far: photographs, meshes and their views.

pub mod mesh;
pub mod photo;
mod resize;
pub mod scan;
pub mod view;
