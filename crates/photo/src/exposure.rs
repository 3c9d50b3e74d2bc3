//! Matches the back's colours to the front's if exposure or white balance differ (docs/method.md, "Exposure").

use glam::Vec3;
use image::{GrayImage, RgbImage};

use super::INSIDE;
use crate::rect::Rect;
use snapsnap_net::median;

/// Number of rows of the person's box that are compared.
const ROWS: u32 = 200;
/// Distance of the compared pixels from the silhouette, as shares of the person's height.
const BAND: (f32, f32) = (0.012, 0.04);
/// Rows whose widths in front and back differ by more than this share of the larger width show different surfaces.
const WIDER: f32 = 0.2;
/// Fewest rows with colours on either edge.
const FEWEST: usize = 20;
/// Channels below this value count as this value: their ratio would be noise.
const DARK: f32 = 0.02;
/// Brightest channel of colours that are compared: darker ones are noise, brighter ones clipped.
const USABLE: (f32, f32) = (0.06, 0.97);
/// Smallest difference that is corrected, and largest correction, of the brightness and of a channel relative to it,
/// as logarithms of ratios. People photographed alike differ by less than the smallest: light that stays with the
/// camera, or a room that is brighter in front of them, makes front and back differ as well.
const BRIGHTNESS: (f32, f32) = (0.28, 0.8);
const BALANCE: (f32, f32) = (0.08, 0.3);
/// Mask value of pixels that show the person alone.
const WHOLE: u8 = 250;

/// Multiplies the back's colours so that surfaces in both photographs have equal colours. Returns the factors; `None`
/// if the photographs hardly differ or too few rows can be compared.
pub(super) fn match_back(
    front: (&RgbImage, &GrayImage),
    back: (&mut RgbImage, &GrayImage),
) -> Option<[f32; 3]> {
    let edges = [edges(front.0, front.1)?, edges(back.0, back.1)?];
    // Light from one side makes one edge brighter and the other darker: each has the same weight.
    let mut sum = Vec3::ZERO;
    for side in 0..2 {
        let both = edges[0].iter().zip(&edges[1]);
        let ratio = |(front, back): (&Option<Row>, &Option<Row>)| {
            let (front, back) = (front.as_ref()?, back.as_ref()?);
            let wider = (front.width - back.width).abs() > WIDER * front.width.max(back.width);
            // The left edge of the front is the right edge of the back.
            let (a, b) = (front.colors[side]?, back.colors[1 - side]?);
            let usable = a.max_element().min(b.max_element()) > USABLE.0
                && a.max_element().max(b.max_element()) < USABLE.1;
            (!wider && usable).then(|| (a.max(Vec3::splat(DARK)) / b.max(Vec3::splat(DARK))).ln())
        };
        let ratios: Vec<Vec3> = both.filter_map(ratio).collect();
        sum += median(&ratios).filter(|_| ratios.len() >= FEWEST)?;
    }
    let ratio = 0.5 * sum;
    let brightness = ratio.element_sum() / 3.0;
    let corrected = |value: Vec3, (least, most): (f32, f32)| {
        let is_large = value.abs().max_element() > least;
        if is_large { value.clamp(Vec3::splat(-most), Vec3::splat(most)) } else { Vec3::ZERO }
    };
    let gain = corrected(Vec3::splat(brightness), BRIGHTNESS) + corrected(ratio - brightness, BALANCE);
    if gain == Vec3::ZERO {
        return None;
    }
    let gain = gain.exp().to_array();
    for pixel in back.0.pixels_mut() {
        pixel.0 = std::array::from_fn(|c| (f32::from(pixel[c]) * gain[c]).round().min(255.0) as u8);
    }
    Some(gain)
}

/// A row of the person: its width as a share of the person's height, and the mean colours at its left and right ends.
struct Row {
    width: f32,
    colors: [Option<Vec3>; 2],
}

fn edges(rgb: &RgbImage, mask: &GrayImage) -> Option<Vec<Option<Row>>> {
    let person = Rect::around(mask, INSIDE)?;
    let height = person.height as f32;
    let band = ((BAND.0 * height).round().max(1.0) as u32)..((BAND.1 * height).round().max(2.0) as u32);
    let row = |i: u32| {
        let y = person.y + (2 * i + 1) * person.height / (2 * ROWS);
        let mut inside = (person.x..person.x + person.width).filter(|x| mask.get_pixel(*x, y)[0] >= INSIDE);
        let left = inside.next()?;
        let right = inside.next_back().unwrap_or(left);
        let mean = |columns: &mut dyn Iterator<Item = u32>| {
            let columns = columns.filter(|x| *x >= left && *x <= right && mask.get_pixel(*x, y)[0] >= WHOLE);
            let (sum, count) = columns.fold((Vec3::ZERO, 0), |(sum, count), x| {
                (sum + Vec3::from_array(rgb.get_pixel(x, y).0.map(f32::from)), count + 1)
            });
            (2 * count >= band.len()).then(|| sum / (255.0 * count.max(1) as f32))
        };
        let colors = [
            mean(&mut band.clone().map(|x| left + x)),
            mean(&mut band.clone().map(|x| right.saturating_sub(x))),
        ];
        Some(Row { width: (right - left + 1) as f32 / height, colors })
    };
    Some((0..ROWS).map(row).collect())
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;

    /// A person of 100 × 300 pixels. `left` and `right` are the brightnesses of its halves, `middle` is a colour.
    fn person(middle: [u8; 3], [left, right]: [f32; 2], gain: [f32; 3]) -> (RgbImage, GrayImage) {
        let inside = |x: u32, y: u32| (50..150).contains(&x) && (20..320).contains(&y);
        let rgb = RgbImage::from_fn(200, 340, |x, y| {
            let cloth = [90, 110, 70].map(|c| c + (y / 40 * 9) as u8);
            let color = if (80..120).contains(&x) { middle } else { cloth };
            let light = if x < 100 { left } else { right };
            Rgb(std::array::from_fn(|c| (f32::from(color[c]) * light * gain[c]).round() as u8))
        });
        (rgb, GrayImage::from_fn(200, 340, |x, y| Luma([if inside(x, y) { 255 } else { 0 }])))
    }

    #[test]
    fn the_back_gets_the_fronts_exposure_and_white_balance() {
        // Light from the left stays where it is while the person turns.
        let light = [1.0, 0.8];
        let (front, mask) = person([250, 40, 40], light, [1.0; 3]);
        let gain = [0.55, 0.6, 0.75];
        let (mut back, back_mask) = person([20, 20, 90], light, gain);
        let found = match_back((&front, &mask), (&mut back, &back_mask)).expect("differ");
        for c in 0..3 {
            assert!((found[c] * gain[c] - 1.0).abs() < 0.05, "{found:?}");
        }
        let (a, b) = (front.get_pixel(60, 200), back.get_pixel(60, 200));
        assert!((0..3).all(|c| a[c].abs_diff(b[c]) < 6), "{a:?} {b:?}");
    }

    #[test]
    fn photographs_that_hardly_differ_or_cannot_be_compared_stay() {
        let (front, mask) = person([250, 40, 40], [1.0, 0.6], [1.0; 3]);
        let stays = |back: (RgbImage, GrayImage)| {
            let mut changed = back.0.clone();
            assert_eq!(match_back((&front, &mask), (&mut changed, &back.1)), None);
            assert!(changed == back.0);
        };
        stays(person([20, 20, 90], [1.0, 0.6], [1.05, 1.0, 0.97]));
        // Black, clipped, nobody, and a person of another width.
        stays(person([0; 3], [0.0, 0.0], [1.0; 3]));
        stays((RgbImage::from_pixel(200, 340, Rgb([255; 3])), mask.clone()));
        stays((person([20, 20, 90], [1.0, 1.0], [0.5; 3]).0, GrayImage::new(200, 340)));
        let narrow = GrayImage::from_fn(200, 340, |x, y| {
            Luma([if (80..120).contains(&x) && (20..320).contains(&y) { 255 } else { 0 }])
        });
        stays((person([20, 20, 90], [1.0, 1.0], [0.5; 3]).0, narrow));
        // A channel that is dark in both photographs says nothing.
        let yellow = |gain| person([200, 200, 0], [1.0, 1.0], gain);
        let saturated = |(mut rgb, mask): (RgbImage, GrayImage), blue: u8| {
            rgb.pixels_mut().for_each(|pixel| pixel.0 = [pixel[0].max(60), pixel[1].max(60), blue]);
            (rgb, mask)
        };
        let [front, mut back] = [saturated(yellow([1.0; 3]), 0), saturated(yellow([1.0; 3]), 4)];
        assert_eq!(match_back((&front.0, &front.1), (&mut back.0, &back.1)), None);
        let (front, mask) = person([250, 40, 40], [1.0, 0.6], [1.0; 3]);
        // A correction has limits.
        let (mut dark, dark_mask) = person([20, 20, 90], [1.0, 0.6], [0.3, 0.3, 0.3]);
        let found = match_back((&front, &mask), (&mut dark, &dark_mask)).expect("differ");
        assert!(found.iter().all(|gain| (gain - 0.8_f32.exp()).abs() < 0.01), "{found:?}");
    }
}
