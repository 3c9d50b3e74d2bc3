//! HEIC files, which iPhones write by default.

use image::error::{DecodingError, ImageFormatHint};
use image::{DynamicImage, ImageError, RgbImage, RgbaImage};

/// Length of the part of a file that shows its kind.
pub const START: usize = 12;
/// Brands of still pictures in HEVC (ISO/IEC 23008-12, annex B).
const BRANDS: [&[u8; 4]; 6] = [b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"];
/// Bytes per pixel while a picture is decoded: 13, measured on one of 12 million pixels, and some to spare.
const BYTES_PER_PIXEL: u64 = 16;
/// Most pixels per byte of a file. A picture of one colour has some 10,000.
const MAX_PIXELS_PER_BYTE: u64 = 1 << 15;

/// Whether a file begins as a HEIC does.
pub fn is_heic(start: &[u8]) -> bool {
    start.len() >= START && &start[4..8] == b"ftyp" && BRANDS.iter().any(|brand| start[8..START] == **brand)
}

fn damaged(message: impl ToString) -> ImageError {
    let hint = ImageFormatHint::Name("HEIC".into());
    ImageError::Decoding(DecodingError::new(hint, message.to_string()))
}

/// Width and height of the picture, upright, and the bytes that decoding takes.
pub fn size(bytes: &[u8]) -> Result<([u32; 2], u64), ImageError> {
    let info = heic_decoder::probe(bytes).map_err(damaged)?;
    let side = |length: usize| u32::try_from(length).map_err(damaged);
    let pixels = (info.coded_width as u64).saturating_mul(info.coded_height as u64);
    if pixels > MAX_PIXELS_PER_BYTE * bytes.len() as u64 {
        return Err(damaged("the file is too short for its number of pixels"));
    }
    Ok(([side(info.width)?, side(info.height)?], pixels.saturating_mul(BYTES_PER_PIXEL)))
}

/// The picture, turned upright as the file says.
pub fn decode(bytes: &[u8]) -> Result<DynamicImage, ImageError> {
    let decoded = heic_decoder::decode(bytes).map_err(damaged)?;
    let [width, height] = [decoded.width, decoded.height].map(|side| side as u32);
    let picture = if decoded.alpha.is_some() {
        let pixels = decoded.to_rgba8().map_err(damaged)?.data;
        RgbaImage::from_raw(width, height, pixels).map(DynamicImage::ImageRgba8)
    } else {
        let pixels = decoded.to_rgb8().map_err(damaged)?.data;
        RgbImage::from_raw(width, height, pixels).map(DynamicImage::ImageRgb8)
    };
    picture.ok_or_else(|| damaged("it has another number of pixels than its header promises"))
}
