//! Conversion of pictures from their ICC profiles to sRGB. Telephones save colours in Display P3.

use image::{DynamicImage, RgbImage, RgbaImage};
use moxcms::{ColorProfile, DataColorSpace, Layout, TransformOptions};
use rayon::prelude::*;

/// Largest change of a channel, of 255, that is left out: the profile is sRGB's.
const EQUAL: u8 = 1;

/// A picture in sRGB. A picture stays as it is if its profile is absent, sRGB's, or for other channels, like the profile
/// of a CMYK picture, whose pixels are converted without it.
pub fn to_srgb(picture: DynamicImage, profile: Option<ColorProfile>) -> DynamicImage {
    let color = picture.color();
    let (has_color, has_alpha) = (color.has_color(), color.has_alpha());
    let channels = if has_color { DataColorSpace::Rgb } else { DataColorSpace::Gray };
    let Some(profile) = profile.filter(|profile| profile.color_space == channels) else { return picture };
    let [from, to] = match (has_color, has_alpha) {
        (true, false) => [Layout::Rgb; 2],
        (true, true) => [Layout::Rgba; 2],
        (false, false) => [Layout::Gray, Layout::Rgb],
        (false, true) => [Layout::GrayAlpha, Layout::Rgba],
    };
    let srgb = ColorProfile::new_srgb();
    let Ok(transform) = profile.create_transform_8bit(from, &srgb, to, TransformOptions::default()) else {
        return picture;
    };
    let channels = [from, to].map(Layout::channels);
    // A row of greys and a row of saturated colours.
    let probe: Vec<u8> = (0..256 * channels[0])
        .map(|i| if i / channels[0] % 2 == 0 { i / channels[0] } else { 85 * i % 256 } as u8)
        .collect();
    let mut probed = vec![0; 256 * channels[1]];
    let is_equal =
        |(a, b): (&[u8], &[u8])| (0..3).all(|c| a[if has_color { c } else { 0 }].abs_diff(b[c]) <= EQUAL);
    if transform.transform(&probe, &mut probed).is_err()
        || probe.chunks(channels[0]).zip(probed.chunks(channels[1])).all(is_equal)
    {
        return picture;
    }
    let (width, height) = (picture.width(), picture.height());
    let pixels = match from {
        Layout::Rgb => picture.into_rgb8().into_raw(),
        Layout::Rgba => picture.into_rgba8().into_raw(),
        Layout::Gray => picture.into_luma8().into_raw(),
        _ => picture.into_luma_alpha8().into_raw(),
    };
    let mut converted = vec![0; width as usize * height as usize * channels[1]];
    let rows = converted.par_chunks_mut(width as usize * channels[1]);
    let rows = rows.zip(pixels.par_chunks(width as usize * channels[0]));
    rows.for_each(|(to, from)| transform.transform(from, to).expect("as for the probe"));
    if has_alpha {
        RgbaImage::from_raw(width, height, converted).expect("four bytes a pixel").into()
    } else {
        RgbImage::from_raw(width, height, converted).expect("three bytes a pixel").into()
    }
}
