//! 3×3 convolutions by Winograd's method: transforms, and matrix products per point of a tile.
//!
//! Channels are in groups of 16, which are one vector of the widest kind. The kernel in `product` reads the groups as
//! the left factor of a matrix product, and every step between products works on whole vectors.

pub(crate) mod planes;
pub(crate) mod product;
pub(crate) mod transforms;

#[cfg(test)]
mod tests;

/// Channels of a group.
pub const GROUP: usize = 16;

/// Cuts planes of `plane` floats into pieces of `piece` floats (the last may be shorter). Returns, for each piece, the
/// slices of all planes. So each task can write some rows of all channels.
pub(crate) fn pieces<'a>(
    planes: impl Iterator<Item = &'a mut [f32]>,
    plane: usize,
    piece: usize,
) -> Vec<Vec<&'a mut [f32]>> {
    let mut pieces: Vec<Vec<&mut [f32]>> = (0..plane.div_ceil(piece)).map(|_| Vec::new()).collect();
    for plane in planes {
        for (slices, slice) in pieces.iter_mut().zip(plane.chunks_mut(piece)) {
            slices.push(slice);
        }
    }
    pieces
}
