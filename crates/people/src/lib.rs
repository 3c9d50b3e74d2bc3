//! Synthetic people for training, built of simple shapes ([`synth`]) or from MakeHuman's data ([`makehuman`]).

pub mod makehuman;
mod math;
mod pattern;
pub mod synth;
