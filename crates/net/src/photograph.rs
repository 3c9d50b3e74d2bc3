//! A photograph as the networks receive it.

/// One photograph on its square canvas of `resolution` pixels; row-major, side S.
#[derive(Debug, Clone)]
pub struct Photograph {
    /// `[3, S, S]`: colours in [−1, 1] times the mask; the background is 0.
    pub rgb: Vec<f32>,
    /// `[S, S]`: share of the person in each pixel, 0 to 1.
    pub mask: Vec<f32>,
    /// `[S, S]`: whether the pixel becomes a Gaussian.
    pub valid: Vec<bool>,
}

impl Photograph {
    /// Least share of the person in a pixel that becomes a Gaussian.
    pub const LEAST: f32 = 0.5;

    /// The photograph with these colours and this mask.
    pub fn new(rgb: Vec<f32>, mask: Vec<f32>) -> Self {
        let valid = mask.iter().map(|share| *share >= Self::LEAST).collect();
        Self { rgb, mask, valid }
    }
}
