//! A sheet of subjects, each from the front, the back and a side.

use std::path::Path;

use image::{RgbImage, imageops};
use snapsnap_data::dataset::{Folder, Split};

use crate::failure::Failure;
use crate::pictures::{sheet, write_png};

/// Side of a subject's picture in pixels.
const SIDE: u32 = 192;
/// Most subjects on a sheet.
const MOST: usize = 48;
/// Pictures in a row: three subjects.
const COLUMNS: u32 = 9;
/// Colour of the background.
const BACKGROUND: [u8; 3] = [235; 3];

/// Writes the sheet of the first of these subjects, of which there is one at least.
pub fn write(path: &Path, folder: &Folder, subjects: &[(Split, &str)]) -> Result<(), Failure> {
    let views = folder.description().views;
    let mut pictures = Vec::new();
    for (split, subject) in subjects.iter().take(MOST) {
        for view in [0, views / 2, views / 4] {
            let (color, mask) = folder.picture(Some(*split), subject, view, false)?;
            pictures.push(shrink(&color, &mask));
        }
    }
    write_png(path, &sheet(&pictures, COLUMNS.min(pictures.len() as u32)))
}

/// On the background, smaller, without the margin around.
fn shrink(color: &RgbImage, mask: &image::GrayImage) -> RgbImage {
    let over = RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let (c, a) = (color.get_pixel(x, y).0, u32::from(mask.get_pixel(x, y).0[0]));
        let mix = |i: usize| (u32::from(c[i]) * a + u32::from(BACKGROUND[i]) * (255 - a)).div_ceil(255) as u8;
        image::Rgb([mix(0), mix(1), mix(2)])
    });
    // With the published cameras people reach from row 124 to 863 of 1024, and as far aside with their arms.
    let side = SIDE * 16 / 14;
    let small = imageops::resize(&over, side, side, imageops::FilterType::Triangle);
    imageops::crop_imm(&small, (side - SIDE) / 2, (side - SIDE) / 2, SIDE, SIDE).to_image()
}
