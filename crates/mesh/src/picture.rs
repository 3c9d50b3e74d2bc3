//! Picture files: photographs, masks and textures.

mod heic;
mod jpeg;
mod profile;
#[cfg(test)]
mod tests;

use std::io::{BufRead, BufReader, Cursor, Read, Seek};
use std::path::Path;

use exif::{In, Tag};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader};
use moxcms::ColorProfile;
use snapsnap_base::{FileError, file, guarded};

/// Memory limit of a decoded photograph, mask or view in bytes: 201 million RGBA pixels, the largest picture that
/// phones take. The steps after decoding need about twice as much again.
pub const MAX_BYTES: u64 = 768 << 20;
/// Largest picture file that is read into memory before it is decoded.
const MAX_FILE: u64 = 1 << 30;

/// The picture in `path`, turned upright according to its EXIF data. Colour profiles are ignored, as glTF demands of
/// textures and as masks need.
///
/// # Errors
/// [`FileError`] for a file that cannot be read, is no picture, is damaged or cut short, or would take more than
/// `most` bytes in memory. The size is checked before decoding.
pub fn decode(path: &Path, most: u64) -> Result<DynamicImage, FileError> {
    let file = BufReader::new(file::open(path).map_err(FileError::read(path))?);
    guarded(path, || decode_from(path, file, most, false, true))
}

/// The photograph in `path`, or in `bytes` if there are any: as [`decode`] reads it, with 8 bits, and in sRGB if it has
/// a colour profile.
///
/// # Errors
/// As [`decode`], above [`MAX_BYTES`].
pub fn photograph(path: &Path, bytes: Option<&[u8]>) -> Result<DynamicImage, FileError> {
    if let Some(bytes) = bytes {
        return guarded(path, || decode_from(path, Cursor::new(bytes), MAX_BYTES, true, true));
    }
    let file = BufReader::new(file::open(path).map_err(FileError::read(path))?);
    guarded(path, || decode_from(path, file, MAX_BYTES, true, true))
}

/// Width and height of the picture in `path`, or in `bytes` if there are any, without regard to its EXIF data.
///
/// # Errors
/// [`FileError`] for a file that cannot be read or is no picture.
pub fn size(path: &Path, bytes: Option<&[u8]>) -> Result<[u32; 2], FileError> {
    if let Some(bytes) = bytes {
        return guarded(path, || size_from(path, Cursor::new(bytes)));
    }
    let file = BufReader::new(file::open(path).map_err(FileError::read(path))?);
    guarded(path, || size_from(path, file))
}

fn size_from(path: &Path, mut source: impl BufRead + Seek) -> Result<[u32; 2], FileError> {
    if heic::is_heic(source.fill_buf().map_err(FileError::read(path))?) {
        return Ok(heic::size(&whole(path, source)?).map_err(unreadable(path))?.0);
    }
    let reader = ImageReader::new(source).with_guessed_format().map_err(FileError::read(path))?;
    reader.into_dimensions().map(Into::into).map_err(unreadable(path))
}

/// The picture in `bytes`, whose EXIF data do not turn it: a texture of `path`, which errors name.
///
/// # Errors
/// As [`decode`].
pub fn decode_bytes(path: &Path, bytes: &[u8], most: u64) -> Result<DynamicImage, FileError> {
    guarded(path, || decode_from(path, Cursor::new(bytes), most, false, false))
}

/// For `map_err`: the error for an image in `path` that is damaged or of an unknown format.
pub fn unreadable(path: &Path) -> impl Fn(ImageError) -> FileError {
    move |source| FileError::unsuitable(path, format!("not a readable image: {source}"))
}

/// The bytes of a file, up to [`MAX_FILE`].
fn whole(path: &Path, source: impl Read) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    source.take(MAX_FILE).read_to_end(&mut bytes).map_err(FileError::read(path))?;
    Ok(bytes)
}

fn decode_from(
    path: &Path,
    mut source: impl BufRead + Seek,
    most: u64,
    in_srgb: bool,
    turned: bool,
) -> Result<DynamicImage, FileError> {
    let failed = unreadable(path);
    let check = |[width, height]: [u32; 2], stored: u64| {
        // Every picture is converted to 8-bit RGB later.
        let bytes = stored.max(3 * u64::from(width) * u64::from(height));
        if bytes <= most {
            return Ok(());
        }
        let (mega, most) = (bytes.div_ceil(1 << 20), most >> 20);
        let message =
            format!("is {width}×{height}, {mega} MiB in memory, more than {most}: make the picture smaller");
        Err(FileError::unsuitable(path, message))
    };
    if heic::is_heic(source.fill_buf().map_err(FileError::read(path))?) {
        let bytes = whole(path, source)?;
        let (size, needed) = heic::size(&bytes).map_err(&failed)?;
        check(size, needed)?;
        let picture = heic::decode(&bytes).map_err(&failed)?;
        let profile = in_srgb.then(|| heic::profile(&bytes)).flatten();
        return Ok(profile::to_srgb(picture, profile));
    }
    let reader = ImageReader::new(source).with_guessed_format().map_err(FileError::read(path))?;
    let is_bmp = reader.format() == Some(ImageFormat::Bmp);
    let (picture, turn, icc) = if reader.format() == Some(ImageFormat::Jpeg) {
        let bytes = jpeg::tidied(whole(path, reader.into_inner())?);
        jpeg::decode(path, &bytes, |size| check(size, 0))?
    } else {
        let mut decoder = reader.into_decoder().map_err(&failed)?;
        check(decoder.dimensions().into(), decoder.total_bytes())?;
        // Damaged metadata are no reason to refuse a picture.
        let exif = decoder.exif_metadata().ok().flatten();
        let turn = exif.and_then(orientation).or(decoder.orientation().ok());
        let icc = decoder.icc_profile().ok().flatten();
        (DynamicImage::from_decoder(decoder).map_err(&failed)?, turn, icc)
    };
    // The fourth byte of screenshots means nothing.
    let is_invisible = |picture: &DynamicImage| {
        picture.color().has_alpha() && picture.to_rgba8().pixels().all(|pixel| pixel.0[3] == 0)
    };
    let picture = if is_bmp && is_invisible(&picture) { picture.into_rgb8().into() } else { picture };
    // A damaged profile counts as none.
    let profile = icc.filter(|_| in_srgb).and_then(|icc| ColorProfile::new_from_slice(&icc).ok());
    let mut picture = profile::to_srgb(picture, profile);
    picture.apply_orientation(turn.filter(|_| turned).unwrap_or(Orientation::NoTransforms));
    Ok(picture)
}

/// The orientation in EXIF data. Some programs write it as another type of number than the standard's.
fn orientation(exif: Vec<u8>) -> Option<Orientation> {
    let exif = exif::Reader::new().read_raw(exif).ok()?;
    let number = exif.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0)?;
    Orientation::from_exif(u8::try_from(number).ok()?)
}
