//! People for training: synthetic ones of simple shapes ([`synth`]) or of MakeHuman's data ([`makehuman`]), and rigged
//! characters from files ([`avatars`]).

pub mod avatars;
mod figure;
pub mod makehuman;
mod math;
mod pattern;
pub mod poses;
mod skeleton;
pub mod synth;

pub use figure::Pose;
pub use skeleton::Placed;

/// How finely people are meshed and painted, by the size of their pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detail {
    /// For pictures in which a texel of 1.6 mm can be seen.
    Fine,
    /// For pictures of at most [`Self::COARSE_SIDE`] pixels: a quarter of the triangles and texels.
    Coarse,
}

impl Detail {
    /// Largest side of a picture of the published cameras in which coarse people look like fine people: a pixel shows
    /// 8 mm of the person.
    pub const COARSE_SIDE: u32 = 256;

    /// The detail that pictures of this side show.
    pub fn of_pictures(side: u32) -> Self {
        if side <= Self::COARSE_SIDE { Self::Coarse } else { Self::Fine }
    }

    /// `fine` metres in fine people, twice as much in coarse people.
    pub(crate) fn length(self, fine: f32) -> f32 {
        if self == Self::Fine { fine } else { 2.0 * fine }
    }

    /// `fine` steps of subdivision, one less in coarse people.
    pub(crate) fn steps(self, fine: usize) -> usize {
        if self == Self::Fine { fine } else { fine - 1 }
    }
}
