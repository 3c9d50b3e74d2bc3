//! Textured meshes: their files in and out, the views of them, and surfaces out of Gaussians.

mod error;
pub mod export;
pub mod fuse;
pub mod import;
pub mod mesh;
pub mod picture;
pub mod view;

pub use error::{FileError, guarded, is_guarded, open};
pub use snapsnap_splat::{file, quoted};
