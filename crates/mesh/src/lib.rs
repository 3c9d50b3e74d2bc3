//! Textured meshes: their files in and out, and the views of them.

mod error;
pub mod export;
pub mod import;
pub mod mesh;
pub mod picture;
pub mod view;

pub use error::{FileError, guarded, is_guarded, open};
pub use snapsnap_splat::{file, quoted};
