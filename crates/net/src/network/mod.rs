//! The point predictor: two photographs → one point map per side of the person
//! (docs/method.md, "Point predictor").

mod attention;
mod block;
mod completion;
mod convolution;
mod details;
mod dpt;
mod dust3r;
mod input;
mod linear;
mod predictor;
mod rays;
mod shells;
mod unet;
mod view;

use burn::tensor::Device;
use snapsnap_ops::Rope;

pub use details::{SecondLook, without_mean};
pub(crate) use dpt::{conv1x1, conv3x3};
pub use dust3r::TokenMaps;
pub use input::Input;
pub use predictor::{Decoded, Encoded, PointMap, PointPredictor, activate};
pub use rays::anchors;
pub(crate) use rays::nominal_camera;
pub use rays::pixel_width;
pub use unet::Levels;
pub use view::View;

/// The rotary position embedding of attention between the tokens of a grid of `rows` and `columns`.
fn rope([rows, columns]: [usize; 2], head_dim: usize, device: &Device) -> Rope {
    /// Base of the angles, as in CroCo.
    const BASE: f64 = 100.0;
    Rope::new(rows, columns, head_dim, BASE, device)
}
