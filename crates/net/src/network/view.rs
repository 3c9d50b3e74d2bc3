//! The views of a person.

/// One side of the person. The sides are named as seen in the front picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum View {
    /// Photographed; all points are in the frame of its camera.
    Front,
    /// Photographed.
    Back,
    /// Unseen; camera yaw +90° from the front.
    Right,
    /// Unseen; camera yaw +270° from the front.
    Left,
    /// The second surface that faces the right's camera, such as the flank behind an arm.
    RightSecond,
    /// The second surface that faces the left's camera.
    LeftSecond,
}

impl View {
    /// All views without second surfaces, in the order of the heads, of the fixtures and of the concatenated Gaussians.
    pub const ALL: [Self; 4] = [Self::Front, Self::Back, Self::Right, Self::Left];
    /// [`Self::ALL`], followed by the second surfaces of the sides (`network.second_layer`).
    pub const WITH_SECOND: [Self; 6] =
        [Self::Front, Self::Back, Self::Right, Self::Left, Self::RightSecond, Self::LeftSecond];

    /// Lower-case name.
    pub fn name(self) -> &'static str {
        ["front", "back", "right", "left", "right-second", "left-second"][self as usize]
    }
}
