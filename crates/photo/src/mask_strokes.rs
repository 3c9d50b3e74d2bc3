//! Corrections of a mask by a user's brush.

use image::imageops::{self, FilterType};
use image::{GrayImage, Luma};

/// Value of a pixel without a stroke.
const UNTOUCHED: u8 = 128;
/// Largest distance from [`UNTOUCHED`] without a stroke: some browsers add noise to pictures.
const NOISE: u8 = 8;

/// Lays strokes of any size over a mask: white keeps, black removes, [`UNTOUCHED`] changes nothing, and values between
/// are soft edges.
pub fn paint(strokes: &GrayImage, mask: &mut GrayImage) {
    let strokes = imageops::resize(strokes, mask.width(), mask.height(), FilterType::Triangle);
    for (Luma([share]), Luma([stroke])) in mask.pixels_mut().zip(strokes.pixels()) {
        if stroke.abs_diff(UNTOUCHED) <= NOISE {
            continue;
        }
        let [above, full] = [i32::from(*stroke) - i32::from(UNTOUCHED), i32::from(u8::MAX)];
        if above > 0 {
            let least = above * full / (full - i32::from(UNTOUCHED));
            *share = (*share).max(least as u8);
        } else {
            let most = i32::from(*stroke) * full / i32::from(UNTOUCHED);
            *share = (*share).min(most as u8);
        }
    }
}

/// Whether strokes keep a pixel of a picture of this size.
pub fn keeps(strokes: &GrayImage, [width, height]: [u32; 2], x: u32, y: u32) -> bool {
    let at = |at: u32, length: u32, count: u32| (u64::from(at) * u64::from(count) / u64::from(length)) as u32;
    let stroke = strokes.get_pixel(at(x, width, strokes.width()), at(y, height, strokes.height()))[0];
    stroke > UNTOUCHED + NOISE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strokes_keep_and_remove_and_leave_the_rest() {
        let mut mask = GrayImage::from_fn(40, 20, |x, _| Luma([if x < 20 { 200 } else { 10 }]));
        // Half as large: the upper half keeps, the lower one removes, the outer columns are untouched.
        let strokes = GrayImage::from_fn(20, 10, |x, y| match (x, y) {
            (5..15, 0..5) => Luma([255]),
            (5..15, _) => Luma([0]),
            _ => Luma([UNTOUCHED]),
        });
        paint(&strokes, &mut mask);
        let values = [(1, 3, 200), (38, 3, 10), (15, 3, 255), (25, 3, 255), (15, 16, 0), (25, 16, 0)];
        for (x, y, expected) in values {
            assert_eq!(mask.get_pixel(x, y)[0], expected, "{x}, {y}");
        }
    }
}
