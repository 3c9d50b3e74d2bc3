//! Corrects a mask that is too large: pixels of the background's colour leave the mask (docs/method.md, "Rims").

use glam::Vec3;
use image::{GrayImage, RgbImage};

use crate::INSIDE;
use crate::rect::Rect;
use crate::rim::{Colors, HEIGHT, LEAST_DISTINCT, MAX_REACH, REACH, Rim, pixel};
use snapsnap_net::median;

/// A mask is too large if this share of the distinct outline shows more of the background than of the person. Masks too
/// large by two thirds of [`REACH`] are corrected.
const SHOWN: f32 = 0.4;
/// Shares of the background up to which a pixel is the person's, and from which it is the background's.
const MIXED: (f32, f32) = (0.1, 0.9);
/// Distance below which two colours count as equal.
const ALIKE: f32 = 0.08;
/// Least share of the outline with the median colour, if the outline counts as uniform.
const UNIFORM: f32 = 0.6;
/// Largest share of the person behind the outline that may have this colour as well.
const WORN: f32 = 0.3;

/// Removes the background from the rim of `mask` and from the colours there. Returns how many pixels left the mask.
pub(super) fn clean(rgb: &mut RgbImage, mask: &mut GrayImage) -> usize {
    let Some(person) = Rect::around(mask, INSIDE) else { return 0 };
    let reach = (REACH * person.height).div_ceil(HEIGHT).clamp(1, MAX_REACH);
    let Some(rim) = Rim::new(mask, person, reach as i8) else { return 0 };
    let colors = Colors::new(&rim, rgb);
    // A background of exactly one colour may be none, as in a cut-out. Then the colour of the outline is tried.
    let shown = if colors.is_flat { None } else { colors.shares(&rim, &colors.outside) };
    let shares = shown.or_else(|| {
        let uniform = vec![colors.uniform(&rim)?; colors.own.len()];
        colors.shares(&rim, &uniform)
    });
    let Some(shares) = shares else { return 0 };
    let mut is_gone = vec![false; rim.levels.len()];
    let mut lost = 0;
    for (i, share) in shares.into_iter().enumerate().filter(|(_, share)| *share > MIXED.0) {
        let (x, y) = rim.place(rim.pixels[i]);
        let value = &mut mask.get_pixel_mut(x, y).0[0];
        // The mask's own value is an upper limit of the person's share.
        *value = if share < MIXED.1 { (*value).min((255.0 * (1.0 - share)).round() as u8) } else { 0 };
        is_gone[rim.pixels[i]] = *value < INSIDE;
        lost += usize::from(*value < INSIDE);
        rgb.put_pixel(x, y, pixel(colors.inside[i]));
    }
    // Soft pixels outside of pixels that left are background as well.
    for &pixel in &rim.beyond {
        let level = rim.levels[pixel];
        let inner = if level == -1 { 1 } else { level + 1 };
        let mut before = rim.neighbours(pixel).filter(|to| rim.levels[*to] == inner).peekable();
        if before.peek().is_some() && before.all(|to| is_gone[to]) {
            is_gone[pixel] = true;
            let (x, y) = rim.place(pixel);
            mask.get_pixel_mut(x, y).0[0] = 0;
        }
    }
    lost
}

impl Colors {
    /// The outline's colour, if it is uniform and the person behind it has other colours.
    fn uniform(&self, rim: &Rim) -> Option<Vec3> {
        let outline = rim.outline();
        let color = median(&self.own[..outline])?;
        let share = |colors: &[Vec3]| {
            colors[..outline].iter().filter(|c| c.distance(color) < ALIKE).count() as f32 / outline as f32
        };
        (share(&self.own) >= UNIFORM && share(&self.inside) <= WORN).then_some(color)
    }

    /// The share of `background` in each pixel of the rim; 0 where only the person lies between the pixel and the
    /// outline. `None` if the mask is not too large.
    fn shares(&self, rim: &Rim, background: &[Vec3]) -> Option<Vec<f32>> {
        let mut shares = vec![0.0; self.own.len()];
        let (mut outline, mut distinct, mut shown) = (0, 0, 0);
        for (i, &at) in rim.pixels.iter().enumerate() {
            let (share, is_distinct) = self.share(i, background[i]);
            let level = rim.levels[at];
            if level == 1 {
                outline += 1;
                distinct += usize::from(is_distinct);
                shown += usize::from(share > 0.5);
            }
            let is_gone = |to: usize| rim.levels[to] == level - 1 && shares[self.index[to] as usize] > 0.5;
            if level == 1 || rim.neighbours(at).any(is_gone) {
                shares[i] = share;
            }
        }
        let is_too_large =
            shown as f32 >= SHOWN * distinct as f32 && distinct as f32 >= LEAST_DISTINCT * outline as f32;
        (is_too_large && shown > 0).then_some(shares)
    }
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;
    use crate::rim::tests::{BACKGROUNDS, SIZE, area, error, mask, outside, person, picture};

    /// Colours and mask stay as they are.
    fn stays(mut rgb: RgbImage, mut mask: GrayImage, what: &str) {
        let same = (rgb.clone(), mask.clone());
        assert_eq!(clean(&mut rgb, &mut mask), 0, "{what}");
        assert!((rgb, mask) == same, "{what}");
    }

    #[test]
    fn a_background_that_bleeds_into_the_mask_is_taken_out() {
        let truth = area(&mask(0.0));
        for (name, background) in BACKGROUNDS {
            for grown in [1.0, 2.0, 3.0, 4.0] {
                let (mut rgb, mut mask) = (picture(background), mask(grown));
                let (before, too_much) = (error(&rgb, &mask), area(&mask) - truth);
                let lost = clean(&mut rgb, &mut mask);
                let (after, left) = (error(&rgb, &mask), area(&mask) - truth);
                println!(
                    "{name}, {grown}: {lost} pixels, {too_much} → {left} too much, error {before} → {after}"
                );
                assert!(left.abs() < 0.15 * too_much && before > 0.3 && after < 0.12, "{name}, {grown}");
            }
        }
    }

    /// Files of cut-outs often hold nothing where they are transparent.
    #[test]
    fn a_stripe_of_one_colour_is_known_without_the_background() {
        for (name, background) in &BACKGROUNDS[..3] {
            let (mut rgb, mut grown) = (picture(background), mask(3.0));
            for (pixel, share) in rgb.pixels_mut().zip(grown.pixels()) {
                if share.0[0] == 0 {
                    pixel.0 = [90, 200, 10];
                }
            }
            assert!(clean(&mut rgb, &mut grown) > 500, "{name}");
            assert!(area(&grown) < 1.02 * area(&mask(0.0)), "{name}");
        }
    }

    #[test]
    fn good_masks_and_small_ones_stay_as_they_are() {
        for (name, background) in BACKGROUNDS {
            for grown in [-3.0, -1.0, 0.0] {
                stays(picture(background), mask(grown), &format!("{name}, {grown}"));
            }
        }
        // A person who is dark towards the outline, as under a lamp beside the camera, cut out over nothing.
        let mut shaded = picture(|_, _| Vec3::ZERO);
        for (x, y, pixel) in shaded.enumerate_pixels_mut() {
            let slope =
                (1.0 - (1.0 + outside(x, y).min(0.0) / 120.0).powi(2)).max(0.0).sqrt().powf(1.0 / 2.2);
            let lit = slope * 255.0 * person(x, y);
            pixel.0 = if outside(x, y) > 0.5 { [0; 3] } else { lit.to_array().map(|c| c.round() as u8) };
        }
        stays(shaded, mask(0.0), "shaded");
        stays(RgbImage::from_pixel(SIZE.0, SIZE.1, Rgb([250; 3])), mask(3.0), "the background's colour");
    }

    /// The right half of the mask is too large, the left is good and has a soft fringe. People who are small, or whose
    /// feet are beyond the frame, are corrected as well.
    #[test]
    fn only_what_shows_the_background_leaves() {
        let (mut rgb, good) = (picture(BACKGROUNDS[3].1), mask(0.0));
        let fringe = |x: u32, y: u32| (90.0 * (1.0 - outside(x, y) / 8.0)).clamp(0.0, 90.0) as u8;
        let mut half = mask(3.0);
        for (x, y, value) in half.enumerate_pixels_mut().filter(|(x, ..)| *x < 160) {
            value.0[0] = good.get_pixel(x, y).0[0].max(fringe(x, y));
        }
        let before = half.clone();
        assert!(clean(&mut rgb, &mut half) > 1000);
        let right = |mask: &GrayImage| area(&image::imageops::crop_imm(mask, 170, 0, 150, 800).to_image());
        let too_much = right(&before) - right(&good);
        assert!((right(&half) - right(&good)).abs() < 0.15 * too_much);
        for (x, y, value) in half.enumerate_pixels().filter(|(x, ..)| *x < 150) {
            // The person's own soft pixels may become a little softer.
            let (value, before) = (value.0[0], before.get_pixel(x, y).0[0]);
            let is_softer = before >= INSIDE && (INSIDE / 2..before).contains(&value);
            assert!(value == before || is_softer, "{x}, {y}: {before} → {value}");
        }

        let small = |picture: &GrayImage| image::imageops::thumbnail(picture, 40, 100);
        let mut tiny = image::imageops::thumbnail(&picture(BACKGROUNDS[3].1), 40, 100);
        let (mut grown, exact) = (small(&mask(9.0)), small(&mask(0.0)));
        let too_much = area(&grown) - area(&exact);
        clean(&mut tiny, &mut grown);
        assert!((area(&grown) - area(&exact)).abs() < 0.5 * too_much, "{}", area(&grown) - area(&exact));

        let cut = |picture: GrayImage| image::imageops::crop_imm(&picture, 60, 0, 260, 500).to_image();
        let mut rgb = image::imageops::crop_imm(&picture(BACKGROUNDS[3].1), 60, 0, 260, 500).to_image();
        let (mut grown, exact) = (cut(mask(3.0)), cut(mask(0.0)));
        clean(&mut rgb, &mut grown);
        assert!((area(&grown) - area(&exact)).abs() < 0.02 * area(&exact));
        assert!((100..200).all(|x| grown.get_pixel(x, 499).0[0] == 255), "nothing is beyond the frame");
    }

    #[test]
    fn extreme_masks_lose_nothing() {
        let only = |at: Option<(u32, u32)>| {
            GrayImage::from_fn(9, 300, |x, y| Luma([if at.is_none_or(|at| at == (x, y)) { 255 } else { 0 }]))
        };
        // The last one is a photograph in place of a mask.
        let noise = GrayImage::from_fn(700, 700, |x, y| Luma([((x * 37 + y * 101) % 251) as u8]));
        for mask in [only(None), only(Some((0, 299))), GrayImage::new(9, 300), GrayImage::new(1, 1), noise] {
            let rgb = |x: u32, y: u32| Rgb([x as u8, y as u8, (x ^ y) as u8]);
            stays(RgbImage::from_fn(mask.width(), mask.height(), rgb), mask, "extreme");
        }
    }
}
