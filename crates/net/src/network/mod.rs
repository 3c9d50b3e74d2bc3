//! The point predictor: two photographs → one point map per side of the person
//! (docs/method.md, "Point predictor").

mod anchor;
mod attention;
mod block;
mod completion;
mod convolution;
mod dpt;
mod dust3r;
mod input;
mod linear;
mod predictor;
mod rays;
mod shells;

pub use anchor::anchors;
pub(crate) use anchor::nominal_camera;
pub use convolution::{Levels, PointUNet};
pub use dust3r::{Dust3r, Grid, TokenMaps, View};
pub use input::Input;
pub use predictor::{Decoded, Encoded, PointMap, PointPredictor, activate};
