//! HEIC files, which iPhones write by default.

use image::error::{DecodingError, ImageFormatHint};
use image::{DynamicImage, ImageError, RgbImage, RgbaImage};
use moxcms::ColorProfile;

/// Brands of still pictures in HEVC (ISO/IEC 23008-12, annex B).
const BRANDS: [&[u8; 4]; 6] = [b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"];
/// Peak bytes per pixel of the decoder: 13, measured on a picture of 12 million pixels, plus a reserve.
const BYTES_PER_PIXEL: u64 = 16;
/// Largest number of pixels per byte of file. A picture of one colour has about 10,000.
const MAX_PIXELS_PER_BYTE: u64 = 1 << 15;

/// Whether a file begins as a HEIC does.
pub fn is_heic(start: &[u8]) -> bool {
    start.len() >= 12 && &start[4..8] == b"ftyp" && BRANDS.iter().any(|brand| start[8..12] == **brand)
}

fn damaged(message: impl ToString) -> ImageError {
    let hint = ImageFormatHint::Name("HEIC".into());
    ImageError::Decoding(DecodingError::new(hint, message.to_string()))
}

/// Width and height of the upright picture, and the largest number of bytes that decoding takes.
pub fn size(bytes: &[u8]) -> Result<([u32; 2], u64), ImageError> {
    let info = heic_decoder::probe(bytes).map_err(damaged)?;
    let side = |length: usize| u32::try_from(length).map_err(damaged);
    let mut pixels = (info.coded_width as u64).saturating_mul(info.coded_height as u64);
    if places(bytes, b"grid").next().is_some() {
        // Tiles may be larger than the picture, which is cropped from them. Each tile is one item of the file.
        let items = places(bytes, b"hvc1").count() as u64;
        let largest = places(bytes, b"hvcC").filter_map(|at| coded_pixels(&bytes[at + 4..])).max();
        pixels = pixels.max(items.saturating_mul(largest.unwrap_or(0)));
    }
    if pixels > MAX_PIXELS_PER_BYTE * bytes.len() as u64 {
        return Err(damaged("the file is too short for its number of pixels"));
    }
    let each = if info.alpha_bit_depth.is_some() { 2 * BYTES_PER_PIXEL } else { BYTES_PER_PIXEL };
    Ok(([side(info.width)?, side(info.height)?], pixels.saturating_mul(each)))
}

fn places<'a>(bytes: &'a [u8], kind: &'a [u8; 4]) -> impl Iterator<Item = usize> + 'a {
    bytes.windows(4).enumerate().filter(move |(_, found)| *found == kind).map(|(at, _)| at)
}

/// Coded pixels, from the sequence parameter set of a configuration (ISO/IEC 14496-15, 8.3.2.1; H.265, 7.3.2.2).
fn coded_pixels(configuration: &[u8]) -> Option<u64> {
    const SEQUENCE: u8 = 33;
    let length = |at: usize| {
        Some(usize::from(u16::from_be_bytes([*configuration.get(at)?, *configuration.get(at + 1)?])))
    };
    let mut at = 23;
    for _ in 0..*configuration.get(22)? {
        let is_sequence = configuration.get(at)? & 0x3f == SEQUENCE;
        let count = length(at + 1)?;
        at += 3;
        for _ in 0..count {
            let unit = configuration.get(at + 2..at + 2 + length(at)?)?;
            if is_sequence {
                return Bits::of(unit).pixels();
            }
            at += 2 + unit.len();
        }
    }
    None
}

/// Bits of a parameter set.
struct Bits {
    bytes: Vec<u8>,
    at: usize,
}

impl Bits {
    /// The payload after the two header bytes, without the bytes that prevent start codes (H.265, 7.3.1.1).
    fn of(unit: &[u8]) -> Self {
        let mut bytes: Vec<u8> = Vec::with_capacity(unit.len());
        let mut zeros = 0;
        for &byte in unit.iter().skip(2) {
            if zeros >= 2 && byte == 3 {
                zeros = 0;
                continue;
            }
            zeros = if byte == 0 { zeros + 1 } else { 0 };
            bytes.push(byte);
        }
        Self { bytes, at: 0 }
    }

    fn bit(&mut self) -> Option<u64> {
        let byte = *self.bytes.get(self.at / 8)?;
        self.at += 1;
        Some(u64::from(byte >> (7 - (self.at - 1) % 8) & 1))
    }

    fn number(&mut self, bits: u32) -> Option<u64> {
        (0..bits).try_fold(0, |number, _| Some(number << 1 | self.bit()?))
    }

    /// An unsigned Exp-Golomb number (H.265, 9.2).
    fn golomb(&mut self) -> Option<u64> {
        let mut zeros = 0;
        while self.bit()? == 0 {
            zeros += 1;
        }
        (zeros < 33).then(|| Some((1_u64 << zeros) - 1 + self.number(zeros)?)).flatten()
    }

    fn pixels(mut self) -> Option<u64> {
        self.number(4)?;
        let layers = self.number(3)?;
        // Skips the nesting flag, then the general profile and level.
        self.at += 1 + 96;
        let mut skipped = 0;
        if layers > 0 {
            for _ in 0..layers {
                skipped += 88 * self.bit()? + 8 * self.bit()?;
            }
            self.at += 2 * (8 - layers) as usize + skipped as usize;
        }
        self.golomb()?;
        if self.golomb()? == 3 {
            self.bit()?;
        }
        self.golomb()?.checked_mul(self.golomb()?)
    }
}

/// The file's ICC profile, or the profile of the primaries that it names.
pub fn profile(bytes: &[u8]) -> Option<ColorProfile> {
    /// Primaries of Display P3 and the transfer curve of sRGB (ITU-T H.273, tables 2 and 3).
    const P3: (u16, u16) = (12, 13);
    let metadata = heic_decoder::read_metadata(bytes).ok()?;
    match metadata.icc_profile {
        Some(icc) => ColorProfile::new_from_slice(&icc).ok(),
        None => {
            let color = metadata.color_info?;
            let is_p3 = (color.color_primaries, color.transfer_characteristics) == P3;
            is_p3.then(ColorProfile::new_display_p3)
        }
    }
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
