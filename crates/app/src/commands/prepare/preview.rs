//! A sheet of subjects, each seen from the front, the back and a side.

use std::path::Path;

use image::{RgbImage, imageops};
use snapsnap_base::file;
use snapsnap_data::dataset::Folder;

use super::Work;
use crate::failure::Failure;
use crate::output::make_folder;
use crate::pictures::{sheet, write_png};

/// Side of a subject's picture in pixels.
const SIDE: u32 = 192;
/// Largest number of subjects on a sheet.
const MOST: usize = 48;
/// Pictures in a row: three subjects.
const COLUMNS: usize = 9;
/// Colour of the background.
const BACKGROUND: [u8; 3] = [235; 3];

/// Writes a sheet of the first of these subjects. There must be at least one.
pub fn write(path: &Path, folder: &Folder, subjects: &[&Work]) -> Result<(), Failure> {
    let (views, arrangement) = (folder.description().views, folder.description().arrangement);
    let [front, back, side, _] = arrangement.four(0, views);
    let mut pictures = Vec::new();
    for work in subjects.iter().take(MOST) {
        for view in [front, back, side] {
            let (color, mask) = folder.person(Some(work.split), &work.subject).picture(view, false)?;
            pictures.push(shrink(&color, &mask));
        }
    }
    make_folder(file::folder_of(path))?;
    let columns = pictures.len().min(COLUMNS);
    let empty = RgbImage::from_pixel(SIDE, SIDE, image::Rgb(BACKGROUND));
    pictures.resize(pictures.len().next_multiple_of(columns), empty);
    write_png(path, &sheet(&pictures, columns as u32))
}

/// The view over the background colour, without its margin, resized to the sheet's pictures.
fn shrink(color: &RgbImage, mask: &image::GrayImage) -> RgbImage {
    let over = RgbImage::from_fn(color.width(), color.height(), |x, y| {
        let (c, a) = (color.get_pixel(x, y).0, u32::from(mask.get_pixel(x, y).0[0]));
        let mix = |i: usize| (u32::from(c[i]) * a + u32::from(BACKGROUND[i]) * (255 - a)).div_ceil(255) as u8;
        image::Rgb([mix(0), mix(1), mix(2)])
    });
    // With the published cameras people cover rows 124 to 863 of 1024. Their arms need as many columns.
    let side = SIDE * 16 / 14;
    let small = imageops::resize(&over, side, side, imageops::FilterType::Triangle);
    imageops::crop_imm(&small, (side - SIDE) / 2, (side - SIDE) / 2, SIDE, SIDE).to_image()
}
