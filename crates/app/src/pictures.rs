//! Rendered views and cut-out photographs as picture files.

use std::io::Cursor;
use std::path::Path;

use burn::tensor::Tensor;
use image::buffer::ConvertBuffer;
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, GrayImage, ImageFormat, Rgb, RgbImage, Rgba, RgbaImage, imageops};
use snapsnap_eval::preview;

use crate::failure::Failure;
use crate::output::{make_folder, write};

/// Speed of the search for a GIF's colours: 1 is best, 30 fastest.
const GIF_SPEED: i32 = 10;

/// The first view of colours `[V,H,W,3]`, clamped to [0, 1], in 8 bits.
pub fn picture(color: &Tensor<4>) -> Result<RgbImage, Failure> {
    let [_, height, width, _] = color.dims();
    let values = read_back(color.clone().narrow(0, 0, 1))?;
    Ok(preview::picture([width, height], |i| [0, 1, 2].map(|c| values[3 * i + c])))
}

/// Values of a render, copied to the host.
pub fn read_back<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>, Failure> {
    let data =
        tensor.try_into_data().map_err(|e| Failure::Internal(format!("reading a picture back: {e:?}")))?;
    Ok(data.try_into_vec().expect("renders are f32"))
}

/// Writes a PNG, whole or not at all.
pub fn write_png(path: &Path, picture: &RgbImage) -> Result<(), Failure> {
    Ok(preview::write_png(path, picture).map(drop)?)
}

/// The file of an endless animation.
pub fn gif(pictures: &[RgbImage], frames_per_second: u32) -> Result<Vec<u8>, Failure> {
    let mut bytes = Vec::new();
    let mut encoder = GifEncoder::new_with_speed(&mut bytes, GIF_SPEED);
    let delay = Delay::from_numer_denom_ms(1000, frames_per_second);
    let frames = pictures.iter().map(|picture| Frame::from_parts(picture.convert(), 0, 0, delay));
    let encoded = encoder.set_repeat(Repeat::Infinite).and_then(|()| encoder.encode_frames(frames));
    encoded.map_err(|e| Failure::Internal(format!("an animation: cannot encode: {e}")))?;
    drop(encoder);
    Ok(bytes)
}

/// Pictures of one size in rows of `columns`.
pub fn sheet(pictures: &[RgbImage], columns: u32) -> RgbImage {
    let (width, height) = pictures.first().map_or((0, 0), RgbImage::dimensions);
    let rows = (pictures.len() as u32).div_ceil(columns);
    let mut sheet = RgbImage::new(width * columns, height * rows);
    for (i, picture) in (0..).zip(pictures) {
        let (x, y) = (i64::from(i % columns * width), i64::from(i / columns * height));
        imageops::replace(&mut sheet, picture, x, y);
    }
    sheet
}

/// Writes a photograph with its mask as alpha channel, and makes the folder. Colours without coverage are black.
pub fn save_cutout(path: &Path, rgb: &RgbImage, mask: &GrayImage) -> Result<(), Failure> {
    make_folder(path.parent().expect("a name in the folder"))?;
    let pixels = RgbaImage::from_fn(rgb.width(), rgb.height(), |x, y| {
        let (Rgb([r, g, b]), alpha) = (*rgb.get_pixel(x, y), mask.get_pixel(x, y)[0]);
        if alpha > 0 { Rgba([r, g, b, alpha]) } else { Rgba([0; 4]) }
    });
    let mut bytes = Vec::new();
    let encoded = pixels.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png);
    encoded.map_err(|e| Failure::Internal(format!("{}: cannot encode: {e}", path.display())))?;
    write(path, &bytes)
}
