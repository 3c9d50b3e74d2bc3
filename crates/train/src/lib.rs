//! Training: stage 1 (points) and stage 2 (Gaussians), their losses, optimisers and schedules.

mod checkpoint;
pub mod config;
pub mod data;
mod details;
mod ema;
mod error;
mod events;
pub mod gradients;
mod identity;
mod learner;
pub mod log;
pub mod networks;
pub mod optimizer;
pub mod points;
pub mod ranks;
pub mod run;
pub mod schedule;
pub mod stability;
pub mod stage1;
pub mod stage2;
pub mod task;

pub use error::{Result, TrainError};
