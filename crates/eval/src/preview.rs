//! Sheets of pictures.

use std::io::{Cursor, Write};
use std::path::Path;

use image::{ImageFormat, Rgb, RgbImage, imageops};
use snapsnap_base::{FileError, file};

/// Largest side of one picture of a grid in pixels.
const MOST: u32 = 256;

/// Pictures of one size in rows.
pub fn grid(rows: &[Vec<RgbImage>]) -> Option<RgbImage> {
    let first = rows.first()?.first()?;
    let scale = first.width().max(first.height()).div_ceil(MOST).max(1);
    let (width, height) = (first.width() / scale, first.height() / scale);
    let columns = rows.iter().map(Vec::len).max()? as u32;
    let mut sheet = RgbImage::from_pixel(columns * width, rows.len() as u32 * height, Rgb([255; 3]));
    for (y, row) in rows.iter().enumerate() {
        for (x, picture) in row.iter().enumerate() {
            let small = imageops::resize(picture, width, height, imageops::FilterType::Triangle);
            imageops::replace(&mut sheet, &small, i64::from(x as u32 * width), i64::from(y as u32 * height));
        }
    }
    Some(sheet)
}

/// A picture of `side`² pixels, row-major, from colours in [0, 1].
pub fn picture(side: usize, color: impl Fn(usize) -> [f32; 3]) -> RgbImage {
    RgbImage::from_fn(side as u32, side as u32, |x, y| self::color(color(y as usize * side + x as usize)))
}

/// A colour in 8 bits, clamped to [0, 1].
pub fn color(color: [f32; 3]) -> Rgb<u8> {
    Rgb(color.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8))
}

/// The colour of an error from 0 to `most`: from black over red and yellow to white.
pub fn heat(error: f32, most: f32) -> [f32; 3] {
    let at = 3.0 * error / most;
    [at, at - 1.0, at - 2.0]
}

/// Writes a PNG, whole or not at all.
///
/// # Errors
/// [`FileError`] if it cannot be written.
pub fn write_png(path: &Path, picture: &RgbImage) -> Result<(), FileError> {
    let mut bytes = Vec::new();
    let encoded = picture.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png);
    encoded.map_err(|e| FileError::unsuitable(path, e))?;
    file::write_whole(path, |out| out.write_all(&bytes)).map_err(FileError::write(path))
}
