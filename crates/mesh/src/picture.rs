//! Picture files, photographs and textures alike.

use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageReader};

use crate::FileError;
use crate::error::open;

/// Pictures above this number of pixels are refused before they are decoded: 16 bytes each are needed at least.
const MAX_PIXELS: u64 = 256_000_000;

/// The picture in `path`, turned upright as its EXIF data say.
pub fn decode(path: &Path) -> Result<DynamicImage, FileError> {
    decode_from(path, BufReader::new(open(path)?))
}

/// The picture in `bytes`, which are a part of `path`.
pub fn decode_bytes(path: &Path, bytes: &[u8]) -> Result<DynamicImage, FileError> {
    decode_from(path, Cursor::new(bytes))
}

fn decode_from(path: &Path, source: impl BufRead + Seek) -> Result<DynamicImage, FileError> {
    let failed = |source| match source {
        image::ImageError::IoError(source) if source.kind() == std::io::ErrorKind::IsADirectory => {
            FileError::Read { path: path.to_owned(), source }
        }
        source => FileError::Decode { path: path.to_owned(), source },
    };
    let reader = ImageReader::new(source).with_guessed_format().map_err(FileError::read(path))?;
    let mut decoder = reader.into_decoder().map_err(failed)?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let message = format!("is {width}×{height}, more than {} million pixels", MAX_PIXELS / 1_000_000);
        return Err(FileError::unsuitable(path, message));
    }
    let orientation = decoder.orientation().map_err(failed)?;
    let mut picture = DynamicImage::from_decoder(decoder).map_err(failed)?;
    picture.apply_orientation(orientation);
    Ok(picture)
}
