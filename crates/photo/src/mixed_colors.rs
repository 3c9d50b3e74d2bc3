//! Replaces colours that mix person and background by the person's own colours (docs/method.md, "Rims"). The sides get
//! their colours from these pixels.

use glam::Vec2;
use image::{GrayImage, RgbImage};

use crate::INSIDE;
use crate::rect::Rect;
use crate::rim::{Colors, DISTINCT, HEIGHT, LEAST_DISTINCT, MAX_REACH, REACH, Rim, mean, pixel};

/// Mean share of the background from which a level of the rim counts as mixed.
const BLEEDS: f32 = 0.08;
/// Width of mixed colours in pixels for a person of [`HEIGHT`] pixels, where the background is not known.
const ASSUMED: f32 = 1.5;
/// Width of the rim in which mixed colours are looked for, in widths of the rim of a mask.
const WIDER: i8 = 2;
/// Share of the background from which a pixel among hair is mixed.
const STRANDS: f32 = 0.2;

/// What the pixels outside of a mask are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Background {
    /// The photograph's, and a network made the mask.
    OfNetwork,
    /// The photograph's, unless they have exactly one colour, as in a cut-out.
    Visible,
    /// Anything: they are transparent.
    Unknown,
}

/// Pixels whose colours mix person and background get the colours behind them: pixels beside the outline, pixels of the
/// background in a network's mask, and pixels among hair. `is_hair` and `is_kept` say whether there may be hair at a
/// column and row, and whether a user keeps the pixel. Returns the measured depth of the first kind, in pixels.
pub fn replace(
    rgb: &mut RgbImage,
    mask: &GrayImage,
    background: Background,
    is_hair: impl Fn(Vec2) -> bool,
    is_kept: impl Fn(u32, u32) -> bool,
) -> usize {
    let Some(person) = Rect::around(mask, INSIDE) else { return 0 };
    let scale = person.height as f32 / HEIGHT as f32;
    let reach = ((REACH as f32 * scale).ceil() as i8).clamp(1, MAX_REACH as i8 / WIDER);
    let Some(rim) = Rim::new(mask, person, WIDER * reach) else { return 0 };
    let mut colors = Colors::new(&rim, rgb);
    let is_cut_out = background == Background::OfNetwork;
    let is_known = is_cut_out || background == Background::Visible && !colors.is_flat;
    let assumed = ((ASSUMED * scale).round() as i8).clamp(1, reach);
    let width = is_known.then(|| colors.mixed(&rim, reach)).flatten().unwrap_or(assumed);
    let is_hair = |at: usize| {
        let (x, y) = rim.place(at);
        is_known && is_hair(Vec2::new(x as f32, y as f32))
    };
    let has_hair = rim.pixels.iter().any(|at| is_hair(*at));
    let strands = if has_hair { colors.strands(&rim, rgb) } else { Vec::new() };
    // Whether a pixel shows the background, without a gap from the outline; and whether it is mixed.
    let mut shown = vec![false; rim.pixels.len()];
    let mut is_mixed = vec![false; rim.pixels.len()];
    let mut is_strand = vec![false; rim.pixels.len()];
    for (i, &at) in rim.pixels.iter().enumerate() {
        let (level, (x, y)) = (rim.levels[at], rim.place(at));
        let share = if is_known { colors.share(i, colors.outside[i]).0 } else { 0.0 };
        let mut before = rim.neighbours(at).filter(|to| rim.levels[*to] == level - 1);
        shown[i] = is_cut_out
            && level <= reach
            && share > 0.5
            && !is_kept(x, y)
            && (level == 1 || before.any(|to| shown[colors.index[to] as usize]));
        is_mixed[i] = level <= width || shown[i];
        if is_hair(at) {
            colors.inside[i] = strands[i];
            is_strand[i] = colors.share(i, colors.outside[i]).0 > STRANDS;
            is_mixed[i] |= is_strand[i];
        }
    }
    // From the deepest pixel outwards.
    for (i, &at) in rim.pixels.iter().enumerate().rev().filter(|(i, _)| is_mixed[*i]) {
        let deeper = rim.neighbours(at).filter(|to| rim.levels[*to] > rim.levels[at]);
        let color = |to: usize| match colors.index[to] {
            u32::MAX => rim.color(rgb, to),
            index => colors.own[index as usize],
        };
        if let Some(color) = mean(deeper.map(color)).or_else(|| is_strand[i].then(|| strands[i])) {
            colors.own[i] = color;
            let (x, y) = rim.place(at);
            rgb.put_pixel(x, y, pixel(color));
        }
    }
    width as usize
}

impl Colors {
    /// The number of levels that mix both colours, from the outline inwards. `None` if the colours are too similar.
    fn mixed(&self, rim: &Rim, reach: i8) -> Option<i8> {
        // Sum of the background's shares, and number of pixels with distinct colours.
        let mut levels = vec![(0.0, 0); reach as usize];
        for (i, &at) in rim.pixels.iter().enumerate().take_while(|(_, at)| rim.levels[**at] <= reach) {
            let line = self.outside[i] - self.inside[i];
            if line.length() >= DISTINCT {
                let share = (self.own[i] - self.inside[i]).dot(line) / line.length_squared();
                let (sum, count) = &mut levels[rim.levels[at] as usize - 1];
                (*sum, *count) = (*sum + share.clamp(-1.0, 1.0), *count + 1);
            }
        }
        let is_distinct = levels[0].1 as f32 >= LEAST_DISTINCT * rim.outline() as f32;
        let mixed = levels.iter().take_while(|(sum, count)| *sum > BLEEDS * *count as f32).count();
        is_distinct.then_some((mixed as i8 + 1).min(reach))
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::rim::tests::{BACKGROUNDS, error, mask, outside, picture};
    use crate::unit_color;

    /// An outline as soft as a camera's, with the true mask: the colours of the person are found, those inside stay.
    #[test]
    fn mixed_colours_become_the_persons() {
        let blurred = |picture: RgbImage, sigma: f32| image::imageops::blur(&picture, sigma);
        for (name, background) in BACKGROUNDS {
            let mut widths = Vec::new();
            for sigma in [0.0, 1.5, 3.0] {
                let taken =
                    if sigma > 0.0 { blurred(picture(background), sigma) } else { picture(background) };
                let mut rgb = taken.clone();
                let width = replace(&mut rgb, &mask(0.0), Background::OfNetwork, |_| false, |_, _| false);
                let (before, after) = (error(&taken, &mask(0.0)), error(&rgb, &mask(0.0)));
                println!("{name}, σ {sigma}: {width} pixels, error {before} → {after}");
                // The person's fine pattern is a tenth.
                assert!(after < 0.13 && (sigma == 0.0 || after < 0.6 * before), "{name}, {sigma}");
                let deep = |x: u32, y: u32| outside(x, y) < -11.0; // levels reach 14
                assert!(rgb.enumerate_pixels().all(|(x, y, p)| !deep(x, y) || p == taken.get_pixel(x, y)));
                widths.push(width);
            }
            assert!(widths.is_sorted() && widths[2] > widths[0], "{name}: {widths:?}");
        }
    }

    /// Strands are thinner than the rim, and the background shines through them. They get the colour behind the rim.
    #[test]
    fn strands_get_the_colour_of_the_hair_that_they_hang_on() {
        let hair = Vec3::new(0.15, 0.1, 0.08);
        let is_strand = |x: u32, y: u32| y < 200 && x % 16 < 5 && (0.0..25.0).contains(&outside(x, y));
        for (name, background) in [BACKGROUNDS[0], BACKGROUNDS[3]] {
            let mut mask = mask(0.0);
            mask.enumerate_pixels_mut().filter(|(x, y, _)| is_strand(*x, *y)).for_each(|(.., m)| m.0 = [255]);
            let mut rgb = RgbImage::from_fn(mask.width(), mask.height(), |x, y| {
                let share = if is_strand(x, y) { 0.4 } else { outside(x, y).clamp(-0.5, 0.5) + 0.5 };
                pixel(hair.lerp(background(x, y), share))
            });
            let error = |rgb: &RgbImage| {
                let strands = rgb.enumerate_pixels().filter(|(x, y, _)| is_strand(*x, *y));
                let off: Vec<f32> = strands.map(|(.., color)| unit_color(color).distance(hair)).collect();
                off.iter().sum::<f32>() / off.len() as f32
            };
            let before = error(&rgb);
            replace(&mut rgb, &mask, Background::OfNetwork, |_| true, |_, _| false);
            let after = error(&rgb);
            assert!(before > 0.2 && after < 0.25 * before, "{name}: {before} → {after}");
        }
    }

    /// White shows between strands, and a network's mask has a piece of the wall.
    #[test]
    fn the_background_among_hair_and_beside_a_networks_outline_is_replaced() {
        let white = |x: u32, y: u32| y < 200 && x % 8 < 2 && (-11.0..0.0).contains(&outside(x, y));
        let taken = {
            let mut taken = picture(BACKGROUNDS[0].1);
            for (x, _, pixel) in taken.enumerate_pixels_mut().filter(|(x, y, _)| white(*x, *y)) {
                pixel.0 = [if x % 2 == 0 { 255 } else { 235 }; 3];
            }
            taken
        };
        let bright =
            |rgb: &RgbImage| rgb.enumerate_pixels().filter(|(x, y, p)| white(*x, *y) && p[2] > 220).count();
        let with = |is_hair: bool| {
            let mut rgb = taken.clone();
            replace(&mut rgb, &mask(0.0), Background::OfNetwork, |_| is_hair, |_, _| false);
            bright(&rgb)
        };
        let (all, cloth, hair) = (bright(&taken), with(false), with(true));
        assert!(all > 300 && cloth > all / 2 && hair < all / 4, "{all} {cloth} {hair}");
        let (mut rgb, grown) = (picture(BACKGROUNDS[0].1), mask(5.0));
        replace(&mut rgb, &grown, Background::OfNetwork, |_| false, |_, _| false);
        let left = rgb
            .enumerate_pixels()
            .filter(|(x, y, p)| grown.get_pixel(*x, *y)[0] >= INSIDE && p[2] > 240)
            .count();
        assert!(left < 20, "{left}");
    }
}
