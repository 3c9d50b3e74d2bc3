//! Convolutions of hundreds of channels, as the DPT heads have them: 3×3 by Winograd's method, and everything that is a
//! matrix product per pixel.
//!
//! Channels stand in groups of 16, one vector of the widest kind. So an image is at once the left factor of a matrix
//! product as the kernel in `product` reads it, and every step between products works on whole vectors.

pub(crate) mod convolution;
mod image;
mod pointwise;
pub(crate) mod product;
pub(crate) mod transforms;

#[cfg(test)]
mod tests;

pub use crate::buffers::Buffers;
pub use convolution::Conv3x3;
pub use image::{Image, Source};
pub use pointwise::Pointwise;

/// Channels that stand together.
pub const GROUP: usize = 16;

/// Cuts every plane of `plane` floats into pieces of `piece` (the last may be shorter): piece after piece, the slices of
/// all planes. So tasks that each own some rows of all channels can write side by side.
pub(crate) fn pieces(data: &mut [f32], plane: usize, piece: usize) -> Vec<Vec<&mut [f32]>> {
    let mut pieces: Vec<Vec<&mut [f32]>> = (0..plane.div_ceil(piece)).map(|_| Vec::new()).collect();
    for plane in data.chunks_exact_mut(plane) {
        for (slices, slice) in pieces.iter_mut().zip(plane.chunks_mut(piece)) {
            slices.push(slice);
        }
    }
    pieces
}
