//! The subcommands.

pub mod bench;
pub mod compare;
pub mod convert;
pub mod demo;
pub mod doctor;
pub mod evaluate;
pub mod fetch_weights;
pub mod manuals;
pub mod mesh;
mod pairs;
pub mod prepare;
pub mod reconstruct;
pub mod render;
pub mod rig;
pub mod stability;
pub mod studio;
pub mod train;
pub mod view;
pub mod weight_files;
