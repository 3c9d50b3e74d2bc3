//! Textured meshes: their files in and out, the views of them, and surfaces out of Gaussians.

pub mod export;
pub mod fuse;
pub mod import;
pub mod mesh;
pub mod picture;
pub mod view;
