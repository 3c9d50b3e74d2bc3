//! Strict decoding of JPEG files. The image crate's decoder fills the missing part of a truncated file with grey.

use std::path::Path;

use image::error::{DecodingError, ImageFormatHint};
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage, ImageError, ImageFormat, RgbImage};
use snapsnap_base::FileError;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::{orientation, unreadable};

/// Largest number of pixels per byte of a JPEG: each 8×8 block takes at least one bit.
const MAX_PIXELS_PER_BYTE: u64 = 512;

/// A picture as it is stored, its orientation, and its ICC profile.
type Decoded = (DynamicImage, Option<Orientation>, Option<Vec<u8>>);

/// Decodes a picture if the file contains its end, and if `check` accepts its width and height as stored.
pub fn decode(
    path: &Path,
    bytes: &[u8],
    check: impl FnOnce([u32; 2]) -> Result<(), FileError>,
) -> Result<Decoded, FileError> {
    let damaged = |message: String| {
        let hint = ImageFormatHint::Exact(ImageFormat::Jpeg);
        unreadable(path)(ImageError::Decoding(DecodingError::new(hint, message)))
    };
    let options =
        DecoderOptions::default().set_strict_mode(true).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| damaged(format!("{e:?}")))?;
    let (width, height) = decoder.dimensions().ok_or_else(|| damaged("its size is missing".into()))?;
    // Otherwise a file of a few bytes could claim gigabytes.
    if (width * height) as u64 > MAX_PIXELS_PER_BYTE * bytes.len() as u64 || !is_whole(bytes) {
        return Err(damaged("the file ends before the picture does".into()));
    }
    let [width, height] = [width as u32, height as u32];
    check([width, height])?;
    let is_grey = matches!(decoder.input_colorspace(), Some(ColorSpace::Luma | ColorSpace::LumaA));
    let color = if is_grey { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(options.jpeg_set_out_colorspace(color));
    let pixels = decoder.decode().map_err(|e| damaged(format!("{e:?}")))?;
    let picture = if is_grey {
        GrayImage::from_raw(width, height, pixels).map(DynamicImage::ImageLuma8)
    } else {
        RgbImage::from_raw(width, height, pixels).map(DynamicImage::ImageRgb8)
    };
    let missing = || damaged("it contains fewer pixels than its header promises".into());
    let orientation = decoder.exif().cloned().and_then(orientation);
    Ok((picture.ok_or_else(missing)?, orientation, decoder.icc_profile()))
}

/// A JPEG without stray bytes between the segments of its header.
pub fn tidied(mut bytes: Vec<u8>) -> Vec<u8> {
    let mut at = 2;
    // The coded data begin with the segment 0xDA.
    while let Some([first, marker, high, low]) = bytes.get(at..at + 4).and_then(|start| start.first_chunk()) {
        match (first, marker) {
            (0xff, 0xff) => at += 1,
            (0xff, 0xda | 0) => break,
            (0xff, _) => at += 2 + usize::from(u16::from_be_bytes([*high, *low])),
            _ => {
                let next = bytes[at..].iter().position(|byte| *byte == 0xff).unwrap_or(bytes.len() - at);
                bytes.drain(at..at + next);
            }
        }
    }
    bytes
}

/// Whether the segments of a JPEG lead to an end-of-image marker (ITU T.81, B.1.1). Thumbnails inside segments do not
/// count.
fn is_whole(bytes: &[u8]) -> bool {
    let mut at = 0;
    // A marker follows 0xFF and optional padding with 0xFF. 0 after 0xFF means coded data.
    let is_marker = |pair: &[u8]| pair[0] == 0xff && pair[1] != 0 && pair[1] != 0xff;
    // The length of the segment follows most markers.
    while let Some(found) = bytes.get(at..).and_then(|left| left.windows(2).position(is_marker)) {
        let marker = bytes[at + found + 1];
        at += found + 2;
        match marker {
            0xd9 => return true,
            // Start of image, restarts and TEM have no length.
            0xd8 | 0xd0..=0xd7 | 0x01 => {}
            _ => {
                let Some(length) = bytes.get(at..at + 2) else { return false };
                at += usize::from(u16::from_be_bytes([length[0], length[1]]));
            }
        }
    }
    false
}
