//! Textured meshes: import, export, views, and surfaces from Gaussians.

pub mod export;
pub mod fuse;
pub mod import;
pub mod mesh;
pub mod picture;
pub mod view;
