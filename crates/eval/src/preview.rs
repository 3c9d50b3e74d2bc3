//! Sheets of pictures with captions, colours of errors, PNG files.

use std::io::{Cursor, Write};
use std::path::Path;

use font8x8::{BASIC_FONTS, UnicodeFonts};
use image::{ImageFormat, Rgb, RgbImage, imageops};
use snapsnap_base::{FileError, file};

/// Largest side of one picture of a grid in pixels.
const MOST: u32 = 256;

/// Width and height of a letter, and height of the strip of captions, in pixels.
const LETTER: u32 = 8;
const STRIP: u32 = 14;

/// A sheet of equally large pictures in rows. The captions stand above the columns and repeat; `note` stands below.
pub fn grid(rows: &[Vec<RgbImage>], captions: &[&str], note: &str) -> Option<RgbImage> {
    let first = rows.first()?.first()?;
    let scale = first.width().max(first.height()).div_ceil(MOST).max(1);
    let (width, height) = (first.width() / scale, first.height() / scale);
    let columns = rows.iter().map(Vec::len).max()? as u32;
    let size = [columns * width, rows.len() as u32 * height + 2 * STRIP];
    let mut sheet = RgbImage::from_pixel(size[0], size[1], Rgb([255; 3]));
    for (column, caption) in (0..columns).zip(captions.iter().cycle()) {
        // A caption is cut off at the end of its column.
        write(&mut sheet, caption, [column * width, 0], (column + 1) * width);
    }
    write(&mut sheet, note, [0, size[1] - STRIP], size[0]);
    for (y, row) in rows.iter().enumerate() {
        for (x, picture) in row.iter().enumerate() {
            let small = imageops::resize(picture, width, height, imageops::FilterType::Triangle);
            let (x, y) = (x as u32 * width, STRIP + y as u32 * height);
            imageops::replace(&mut sheet, &small, x.into(), y.into());
        }
    }
    Some(sheet)
}

/// Writes black text into the strip that begins at `at`, up to column `end`.
fn write(sheet: &mut RgbImage, text: &str, [left, top]: [u32; 2], end: u32) {
    let (left, top) = (left + 3, top + (STRIP - LETTER) / 2);
    for (i, letter) in (0..).zip(text.chars()) {
        let Some(rows) = BASIC_FONTS.get(letter) else { continue };
        for (y, row) in (0..).zip(rows) {
            for x in (0..LETTER).filter(|x| row >> x & 1 == 1) {
                let x = left + i * LETTER + x;
                if x < end {
                    sheet.put_pixel(x, top + y, Rgb([0; 3]));
                }
            }
        }
    }
}

/// A picture of `width` × `height` pixels, row-major, from colours that are clamped to [0, 1].
pub fn picture([width, height]: [usize; 2], color: impl Fn(usize) -> [f32; 3]) -> RgbImage {
    RgbImage::from_fn(width as u32, height as u32, |x, y| {
        Rgb(color(y as usize * width + x as usize).map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8))
    })
}

/// The colour of an error from 0 to `most`: from black over red and yellow to white.
pub fn heat(error: f32, most: f32) -> [f32; 3] {
    let at = 3.0 * error / most;
    [at, at - 1.0, at - 2.0]
}

/// Writes a PNG, whole or not at all, and returns its bytes.
///
/// # Errors
/// [`FileError`] if it cannot be written.
pub fn write_png(path: &Path, picture: &RgbImage) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    let encoded = picture.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png);
    encoded.map_err(|e| FileError::unsuitable(path, e))?;
    file::write_whole(path, |out| out.write_all(&bytes)).map_err(FileError::write(path))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captions_stand_above_their_columns_and_a_note_below() {
        let grey = RgbImage::from_pixel(32, 20, Rgb([128; 3]));
        let rows = vec![vec![grey.clone(); 4], vec![grey; 4]];
        let sheet = grid(&rows, &["il", "photograph"], "white: 5 cm").expect("a sheet");
        assert_eq!(sheet.dimensions(), (128, 14 + 40 + 14));
        let black = |columns: std::ops::Range<u32>, rows: std::ops::Range<u32>| {
            let mut all = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
            all.by_ref().filter(|(x, y)| sheet.get_pixel(*x, *y).0 == [0; 3]).count()
        };
        // Captions are repeated, and cut off at the next column.
        assert_eq!(black(0..32, 0..14), black(64..96, 0..14));
        assert_eq!(black(32..64, 0..14), black(96..128, 0..14));
        assert!(black(0..32, 0..14) > 10 && black(32..64, 0..14) > black(0..32, 0..14));
        assert_eq!(black(0..128, 14..54), 0);
        assert!(black(0..128, 54..68) > 50);
    }
}
