//! Training: stage 1 (points) and stage 2 (Gaussians), their losses, optimisers and schedules.

pub mod gradients;
pub mod optimizer;
pub mod photometric;
pub mod points;
pub mod schedule;
