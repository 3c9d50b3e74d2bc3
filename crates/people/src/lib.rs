//! Makes people to train on: of simple shapes ([`synth`]), and of MakeHuman's data ([`makehuman`]).

pub mod makehuman;
mod math;
mod pattern;
pub mod synth;
