//! The point predictor: two photographs → one point map per side of the person (SNAPSNAP §1, 2, 4).

mod anchor;
mod attention;
mod block;
mod dpt;
mod dust3r;
mod linear;
mod predictor;

pub use anchor::anchors;
pub use dust3r::{Dust3r, TokenMaps, View};
pub use predictor::{PointMap, PointPredictor, activate};
