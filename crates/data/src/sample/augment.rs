//! Augmentation: changes to rendered photographs that imitate real cameras and inexact masks.

use std::io::Cursor;

use glam::Vec3;
use image::codecs::jpeg::JpegEncoder;
use image::{GrayImage, Luma, Rgb, RgbImage};
use rand::Rng;
use serde::{Deserialize, Serialize};

use snapsnap_base::config::outside;
use snapsnap_photo::Rect;

/// Largest change of red and blue against green, as a share.
const WHITE_BALANCE: f32 = 0.06;
/// Lowest JPEG quality of photographs.
const LOWEST_QUALITY: f32 = 70.0;

/// Ranges of the changes; 0 or false disables one. Front and back are changed independently.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augment {
    /// Largest change of brightness, as a share.
    pub exposure: f32,
    /// Largest error of masks that are too small, in pixels.
    pub mask_erosion: f32,
    /// Largest error of masks that are too large, in pixels.
    pub mask_dilation: f32,
    /// Whether photographs have a random white balance, the losses of JPEG, and random backgrounds, which are visible
    /// through soft or too large masks. In stage 2, targets have a random colour behind the person instead of black.
    #[serde(skip)]
    pub is_photographic: bool,
}

impl Default for Augment {
    /// Augmentation of this program's own trainings.
    fn default() -> Self {
        Self { exposure: 0.15, mask_erosion: 1.5, mask_dilation: 1.5, is_photographic: true }
    }
}

impl Augment {
    /// No augmentation.
    pub fn none() -> Self {
        Self { exposure: 0.0, mask_erosion: 0.0, mask_dilation: 0.0, is_photographic: false }
    }

    pub(super) fn problem(&self) -> Option<(&'static str, String)> {
        outside([
            ("exposure", self.exposure, 0.0..=0.9),
            ("mask_erosion", self.mask_erosion, 0.0..=16.0),
            ("mask_dilation", self.mask_dilation, 0.0..=16.0),
        ])
    }

    /// The changed photograph and its mask.
    pub(super) fn apply(
        &self,
        color: &RgbImage,
        mask: &GrayImage,
        random: &mut impl Rng,
    ) -> (RgbImage, GrayImage) {
        let mut stray = |range: f32| 1.0 + range * random.random_range(-1.0_f32..1.0);
        let exposure = stray(self.exposure);
        let balance = if self.is_photographic { WHITE_BALANCE } else { 0.0 };
        let gain = Vec3::new(stray(balance), 1.0, stray(balance)) * exposure;
        let grow = random.random_range(-1.0_f32..1.0);
        let quality = random.random_range(0.0_f32..1.0);
        // A smooth background between two colours.
        let colors = [(); 2].map(|()| 255.0 * Vec3::new(random.random(), random.random(), random.random()));
        let way: [f32; 2] = [random.random_range(-1.0..1.0), random.random_range(-1.0..1.0)];
        let backdrop = |x: f32, y: f32| {
            colors[0].lerp(colors[1], (0.5 + (x - 0.5) * way[0] + (y - 0.5) * way[1]).clamp(0.0, 1.0))
        };
        let mut picture = color.clone();
        if self.is_photographic || gain != Vec3::ONE {
            for (x, y, pixel) in picture.enumerate_pixels_mut() {
                let lit = (Vec3::from(pixel.0.map(f32::from)) * gain).clamp(Vec3::ZERO, Vec3::splat(255.0));
                let mixed = if self.is_photographic {
                    let share = f32::from(mask.get_pixel(x, y).0[0]) / 255.0;
                    backdrop(x as f32 / color.width() as f32, y as f32 / color.height() as f32)
                        .lerp(lit, share)
                } else {
                    lit
                };
                *pixel = Rgb(mixed.to_array().map(|c| c.round() as u8));
            }
        }
        if self.is_photographic {
            picture = compressed(picture, (LOWEST_QUALITY + quality * (100.0 - LOWEST_QUALITY)) as u8);
        }
        let reach = if grow < 0.0 { grow * self.mask_erosion } else { grow * self.mask_dilation };
        let mask = if reach == 0.0 { mask.clone() } else { moved(mask, reach) };
        (picture, mask)
    }
}

pub(super) fn compressed(picture: RgbImage, quality: u8) -> RgbImage {
    let mut bytes = Vec::new();
    let done = JpegEncoder::new_with_quality(&mut bytes, quality.clamp(1, 100)).encode_image(&picture);
    let decoded = image::ImageReader::with_format(Cursor::new(&bytes), image::ImageFormat::Jpeg).decode();
    match (done, decoded) {
        (Ok(()), Ok(decoded)) => decoded.into_rgb8(),
        // Compression fails only if memory runs out. The picture then stays uncompressed.
        _ => picture,
    }
}

/// The mask with its outline moved outwards by `reach` pixels, or inwards if `reach` is negative.
pub(super) fn moved(mask: &GrayImage, reach: f32) -> GrayImage {
    let radius = reach.abs();
    let (width, height) = (i64::from(mask.width()), i64::from(mask.height()));
    let whole = radius.ceil() as i64;
    // Offsets of the pixels of a disc, and the share of each pixel within the radius.
    let disc: Vec<(i64, i64, f32)> = (-whole..=whole)
        .flat_map(|y| (-whole..=whole).map(move |x| (x, y)))
        .map(|(x, y)| (x, y, (radius + 1.0 - ((x * x + y * y) as f32).sqrt()).clamp(0.0, 1.0)))
        .filter(|(_, _, share)| *share > 0.0)
        .collect();
    let dilate = reach > 0.0;
    let at = |x: i64, y: i64| {
        let inside = (0..width).contains(&x) && (0..height).contains(&y);
        let value = if inside { mask.as_raw()[(y * width + x) as usize] } else { 0 };
        if dilate { value } else { 255 - value }
    };
    // The mask's box and what a disc reaches around it. The rest stays empty.
    let [columns, rows] = Rect::around(mask, 1).map_or([0..0, 0..0], |person| {
        [(person.x, person.width), (person.y, person.height)]
            .map(|(first, size)| i64::from(first) - whole..i64::from(first + size) + whole)
    });
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
        let (x, y) = (i64::from(x), i64::from(y));
        let here = at(x, y);
        // A full pixel cannot grow.
        let value = if here == 255 || !columns.contains(&x) || !rows.contains(&y) {
            here
        } else {
            disc.iter().map(|(dx, dy, share)| f32::from(at(x + dx, y + dy)) * share).fold(0.0, f32::max) as u8
        };
        Luma([if dilate { value } else { 255 - value }])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use snapsnap_base::random::stream;

    fn disc(radius: f32) -> GrayImage {
        GrayImage::from_fn(64, 64, |x, y| {
            let d = ((x as f32 - 31.5).powi(2) + (y as f32 - 31.5).powi(2)).sqrt();
            Luma([((radius + 0.5 - d).clamp(0.0, 1.0) * 255.0) as u8])
        })
    }

    fn area(mask: &GrayImage) -> f32 {
        mask.as_raw().iter().map(|v| f32::from(*v) / 255.0).sum()
    }

    #[test]
    fn outlines_move_by_the_given_distance() {
        let radius_of = |mask: &GrayImage| (area(mask) / std::f32::consts::PI).sqrt();
        let before = radius_of(&disc(16.0));
        for reach in [-2.5, -1.0, -0.5, 0.5, 1.0, 2.5] {
            let after = radius_of(&moved(&disc(16.0), reach));
            assert!((after - before - reach).abs() < 0.35, "{reach}: {before} to {after}");
        }
    }

    #[test]
    fn only_the_configured_changes_are_made() {
        let color = RgbImage::from_fn(64, 64, |x, y| Rgb([x as u8, y as u8, 77]));
        let mask = disc(20.0);
        let mut random = stream("a");
        assert_eq!(Augment::none().apply(&color, &mask, &mut random), (color.clone(), mask.clone()));
        let (changed, moved) = Augment::default().apply(&color, &mask, &mut random);
        assert_ne!(changed, color);
        assert_ne!(moved, mask);
        // A random choice does not depend on the other changes.
        let only = Augment { exposure: 0.5, ..Augment::none() };
        let (brighter, same) = only.apply(&color, &mask, &mut stream("b"));
        assert_eq!(same, mask);
        let ratio = f32::from(brighter.get_pixel(10, 60).0[1]) / 60.0;
        assert!((0.5..1.5).contains(&ratio) && (ratio - 1.0).abs() > 0.01, "{ratio}");
    }
}
