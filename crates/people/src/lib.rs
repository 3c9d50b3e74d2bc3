//! People for training: synthetic ones of simple shapes ([`synth`]) or of MakeHuman's data ([`makehuman`]), and rigged
//! characters from files ([`avatars`]).

pub mod avatars;
mod detail;
mod figure;
mod joint_names;
pub mod makehuman;
mod math;
mod pattern;
pub mod poses;
mod skeleton;
pub mod synth;

pub use detail::Detail;
