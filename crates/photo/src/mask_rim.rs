//! The rim of a mask (docs/method.md, "Rims"). Pixels of the background's colour leave a mask that is too large, and
//! pixels that mix person and background receive the person's colour: the sides get their colours from these pixels.

use glam::{Vec2, Vec3};
use image::{GrayImage, Rgb, RgbImage};

use super::{INSIDE, median, unit_color};
use crate::rect::Rect;

/// Width of the rim in pixels for a person of [`HEIGHT`] pixels. Masks too large by two thirds of it are corrected.
const REACH: u32 = 6;
/// Height of the person that [`REACH`] refers to, in pixels.
const HEIGHT: u32 = 739;
/// Largest width of the rim, in pixels of the photograph.
const MAX_REACH: u32 = 64;
/// Least distance of the colours of person and background at which they are told apart. Channels are 0 to 1.
const DISTINCT: f32 = 0.12;
/// Least share of the outline with distinct colours.
const LEAST_DISTINCT: f32 = 0.25;
/// A mask is too large if this share of the distinct outline shows more of the background than of the person.
const SHOWN: f32 = 0.4;
/// Largest distance of a mixed colour from the line between both colours: a share of its length, plus a constant.
const OFF_LINE: (f32, f32) = (0.35, 0.03);
/// Shares of the background up to which a pixel is the person's, and from which it is the background's.
const MIXED: (f32, f32) = (0.1, 0.9);
/// Distance below which two colours count as equal.
const ALIKE: f32 = 0.08;
/// Least share of the outline with the median colour, if the outline counts as uniform.
const UNIFORM: f32 = 0.6;
/// Largest share of the person behind the outline that may have this colour as well.
const WORN: f32 = 0.3;
/// Longest outline of a person: the larger of the first number, in pixels, and the box's area over the second number.
const LONGEST: (usize, usize) = (50_000, 20);

/// Mean share of the background from which a level of the rim counts as mixed.
const BLEEDS: f32 = 0.08;
/// Width of mixed colours in pixels for a person of [`HEIGHT`] pixels, where the background is not known.
const ASSUMED: f32 = 1.5;
/// Width of the rim in which mixed colours are looked for, in widths of the rim of a mask.
const WIDER: u32 = 2;
/// Share of the background from which a pixel among hair is mixed.
const STRANDS: f32 = 0.2;

/// What the pixels outside of a mask are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Background {
    /// The photograph's, and a network made the mask.
    OfNetwork,
    /// The photograph's, unless they have exactly one colour, as in a cut-out.
    Visible,
    /// Anything: they are transparent.
    Unknown,
}

/// Pixels whose colours mix person and background get the colours behind them: pixels beside the outline, down to a
/// depth that is measured and returned (in pixels), pixels of the background in a network's mask, and
/// pixels among hair. `is_hair` and `is_kept` say whether there may be hair at a column and row, and whether a user
/// keeps the pixel.
pub(super) fn own_colors(
    rgb: &mut RgbImage,
    mask: &GrayImage,
    background: Background,
    is_hair: impl Fn(Vec2) -> bool,
    is_kept: impl Fn(u32, u32) -> bool,
) -> usize {
    let Some(person) = Rect::around(mask, INSIDE) else { return 0 };
    let scale = person.height as f32 / HEIGHT as f32;
    let reach = (REACH as f32 * scale).ceil().clamp(1.0, (MAX_REACH / WIDER) as f32);
    let Some(rim) = Rim::new(mask, person, (WIDER * reach as u32) as i8) else { return 0 };
    let mut colors = Colors::new(&rim, rgb);
    let assumed = (ASSUMED * scale).round().clamp(1.0, reach);
    let is_cut_out = background == Background::OfNetwork;
    let is_known = is_cut_out || background == Background::Visible && !colors.is_flat;
    let width = if is_known { colors.mixed(&rim, reach).unwrap_or(assumed) } else { assumed };
    // Whether a pixel shows the background, without a gap from the outline; and whether it is mixed.
    let mut shown = vec![false; rim.pixels.len()];
    let mut is_mixed = vec![false; rim.pixels.len()];
    for (i, &at) in rim.pixels.iter().enumerate() {
        let level = rim.levels[at];
        let share = if is_known { colors.share(i, colors.outside[i]).0 } else { 0.0 };
        let mut before = rim.neighbours(at).filter(|to| rim.levels[*to] == level - 1);
        let (x, y) = rim.place(at);
        shown[i] = is_cut_out
            && f32::from(level) <= reach
            && share > 0.5
            && !is_kept(x, y)
            && (level == 1 || before.any(|to| shown[colors.index[to] as usize]));
        let among_hair = share > STRANDS && is_hair(Vec2::new(x as f32, y as f32));
        is_mixed[i] = f32::from(level) <= width || shown[i] || among_hair;
    }
    for (i, &at) in rim.pixels.iter().enumerate().rev().filter(|(i, _)| is_mixed[*i]) {
        let deeper = rim.neighbours(at).filter(|to| rim.levels[*to] > rim.levels[at]);
        let color = |to: usize| match colors.index[to] {
            u32::MAX => {
                let (x, y) = rim.place(to);
                unit_color(rgb.get_pixel(x, y))
            }
            index => colors.own[index as usize],
        };
        if let Some(color) = mean(deeper.map(color)) {
            colors.own[i] = color;
        }
    }
    for (i, at) in rim.pixels.iter().enumerate().filter(|(i, _)| is_mixed[*i]) {
        let (x, y) = rim.place(*at);
        rgb.put_pixel(x, y, pixel(colors.own[i]));
    }
    width as usize
}

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

/// Pixels near the outline of a mask, in a part of the picture.
struct Rim {
    part: Rect,
    /// Level of each pixel of the part. Inside: 1, 2, … from the outline, [`DEEP`] behind the rim. Outside: −1, −2, …,
    /// and 0 farther away.
    levels: Vec<i8>,
    /// Pixels inside, level by level.
    pixels: Vec<usize>,
    /// Pixels outside, level by level.
    beyond: Vec<usize>,
}

/// Level of pixels behind the rim.
const DEEP: i8 = i8::MAX;

impl Rim {
    /// `None` if the outline is too long for a person.
    fn new(mask: &GrayImage, person: Rect, reach: i8) -> Option<Self> {
        let whole = Rect { x: 0, y: 0, width: mask.width(), height: mask.height() };
        let part = whole.clipped_around(person, [reach as u32 + 1; 2]);
        let (width, rows) = (part.width as usize, part.y..part.y + part.height);
        let row = |y: u32| &mask.as_raw()[(y * mask.width() + part.x) as usize..][..width];
        let is_inside: Vec<bool> = rows.flat_map(|y| row(y).iter().map(|value| *value >= INSIDE)).collect();
        let mut rim = Self { part, levels: vec![0; is_inside.len()], pixels: Vec::new(), beyond: Vec::new() };
        // Pixels beside the outline, first those inside. Every pixel is looked at, so that this takes most of the time.
        let mut outlines = [Vec::new(), Vec::new()];
        for (at, inside) in is_inside.iter().enumerate() {
            let differs =
                |to: Option<usize>| to.and_then(|to| is_inside.get(to)).is_some_and(|to| to != inside);
            let column = at % width;
            if differs((column > 0).then(|| at - 1))
                || differs((column + 1 < width).then_some(at + 1))
                || differs(at.checked_sub(width))
                || differs(Some(at + width))
            {
                outlines[usize::from(!inside)].push(at);
            }
        }
        if outlines[0].len() > LONGEST.0.max(is_inside.len() / LONGEST.1) {
            return None;
        }
        for (inside, mut last) in [true, false].into_iter().zip(outlines) {
            let sign = if inside { 1 } else { -1 };
            let mut all = Vec::new();
            for level in 1..=reach {
                last.iter().for_each(|at| rim.levels[*at] = sign * level);
                // Steps to four and to eight neighbours in turn come close to a circle.
                let mut next: Vec<usize> = match level % 2 {
                    0 => last.iter().flat_map(|at| rim.neighbours(*at)).collect(),
                    _ => last.iter().flat_map(|at| rim.direct(*at)).collect(),
                };
                next.retain(|at| is_inside[*at] == inside && rim.levels[*at] == 0);
                next.sort_unstable();
                next.dedup();
                all.append(&mut last);
                last = next;
            }
            *if inside { &mut rim.pixels } else { &mut rim.beyond } = all;
        }
        let deep = rim.levels.iter_mut().zip(&is_inside).filter(|(level, inside)| **level == 0 && **inside);
        deep.for_each(|(level, _)| *level = DEEP);
        Some(rim)
    }

    /// Column and row of a pixel of the part in the picture.
    fn place(&self, at: usize) -> (u32, u32) {
        let at = at as u32;
        (self.part.x + at % self.part.width, self.part.y + at / self.part.width)
    }

    /// The neighbours of a pixel in the part, up to eight.
    fn neighbours(&self, at: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, height) = (self.part.width as usize, self.part.height as usize);
        let (x, y) = (at % width, at / width);
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        rows.flat_map(move |row| {
            (x.saturating_sub(1)..(x + 2).min(width)).map(move |column| row * width + column)
        })
        .filter(move |to| *to != at)
    }

    /// The neighbours that share a side, up to four.
    fn direct(&self, at: usize) -> impl Iterator<Item = usize> + use<> {
        let width = self.part.width as usize;
        self.neighbours(at).filter(move |to| to.abs_diff(at) == width || to.abs_diff(at) == 1)
    }
}

/// Colours at the pixels of a rim, channels 0 to 1.
struct Colors {
    /// For each pixel of the part, its index among the rim's pixels or the pixels beyond; `u32::MAX` for others.
    index: Vec<u32>,
    own: Vec<Vec3>,
    /// Colours of the person behind the rim.
    inside: Vec<Vec3>,
    /// Colours of the picture outside of the mask.
    outside: Vec<Vec3>,
    /// Whether the picture near the mask has exactly one colour.
    is_flat: bool,
}

impl Colors {
    fn new(rim: &Rim, rgb: &RgbImage) -> Self {
        let color = |at: usize| {
            let (x, y) = rim.place(at);
            unit_color(rgb.get_pixel(x, y))
        };
        let mut index = vec![u32::MAX; rim.levels.len()];
        for pixels in [&rim.pixels, &rim.beyond] {
            pixels.iter().enumerate().for_each(|(i, at)| index[*at] = i as u32);
        }
        let own: Vec<Vec3> = rim.pixels.iter().map(|at| color(*at)).collect();
        // The person's colour comes outwards from behind the rim, the background's inwards from beyond it.
        let mut inside = own.clone();
        for (i, &at) in rim.pixels.iter().enumerate().rev() {
            let level = rim.levels[at];
            let of = |to: usize| match rim.levels[to] {
                DEEP => Some(color(to)),
                deeper if deeper == level + 1 => Some(inside[index[to] as usize]),
                _ => None,
            };
            inside[i] = mean(rim.neighbours(at).filter_map(of)).unwrap_or(own[i]);
        }
        let mut beyond: Vec<Vec3> = rim.beyond.iter().map(|at| color(*at)).collect();
        let is_flat = beyond.windows(2).all(|pair| pair[0] == pair[1]);
        for (i, &at) in rim.beyond.iter().enumerate().rev() {
            let farther = rim.neighbours(at).filter(|to| rim.levels[*to] == rim.levels[at] - 1);
            if let Some(color) = mean(farther.map(|to| beyond[index[to] as usize])) {
                beyond[i] = color;
            }
        }
        let mut outside = own.clone();
        for (i, &at) in rim.pixels.iter().enumerate() {
            let before = if rim.levels[at] == 1 { -1 } else { rim.levels[at] - 1 };
            let of = |to: usize| {
                let from = if before < 0 { &beyond } else { &outside };
                (rim.levels[to] == before).then(|| from[index[to] as usize])
            };
            outside[i] = mean(rim.neighbours(at).filter_map(of)).unwrap_or(own[i]);
        }
        Self { index, own, inside, outside, is_flat }
    }

    /// The outline's colour, if it is uniform and the person behind it has other colours.
    fn uniform(&self, rim: &Rim) -> Option<Vec3> {
        let outline = rim.pixels.iter().take_while(|at| rim.levels[**at] == 1).count();
        let color = median(&self.own[..outline])?;
        let share = |colors: &[Vec3]| {
            colors[..outline].iter().filter(|c| c.distance(color) < ALIKE).count() as f32 / outline as f32
        };
        (share(&self.own) >= UNIFORM && share(&self.inside) <= WORN).then_some(color)
    }

    /// The share of `background` in a pixel of the rim, and whether it differs from the person's colour.
    fn share(&self, i: usize, background: Vec3) -> (f32, bool) {
        let (person, line) = (self.inside[i], background - self.inside[i]);
        let length = line.length();
        if length < DISTINCT {
            return (0.0, false);
        }
        let share = (self.own[i] - person).dot(line) / line.length_squared();
        let off = (self.own[i] - person - share * line).length();
        (if off > OFF_LINE.0 * length + OFF_LINE.1 { 0.0 } else { share.clamp(0.0, 1.0) }, true)
    }

    /// The number of levels that mix both colours, from the outline inwards. `None` if the colours are too similar.
    fn mixed(&self, rim: &Rim, reach: f32) -> Option<f32> {
        let mut levels = vec![(0.0, 0); reach as usize + 1];
        let mut distinct = 0;
        let near = |(_, at): &(usize, &usize)| f32::from(rim.levels[**at]) <= reach;
        for (i, &at) in rim.pixels.iter().enumerate().take_while(near) {
            let line = self.outside[i] - self.inside[i];
            if line.length() >= DISTINCT {
                let share = (self.own[i] - self.inside[i]).dot(line) / line.length_squared();
                let (sum, count) = &mut levels[rim.levels[at] as usize];
                (*sum, *count) = (*sum + share.clamp(-1.0, 1.0), *count + 1);
                distinct += usize::from(rim.levels[at] == 1);
            }
        }
        let outline = rim.pixels.iter().take_while(|at| rim.levels[**at] == 1).count();
        let is_mixed = |(sum, count): &&(f32, i32)| *sum > BLEEDS * *count as f32;
        (distinct as f32 >= LEAST_DISTINCT * outline as f32)
            .then(|| (levels[1..].iter().take_while(is_mixed).count() as f32 + 1.0).min(reach))
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

fn pixel(color: Vec3) -> Rgb<u8> {
    Rgb((255.0 * color).to_array().map(|c| c.round() as u8))
}

fn mean(colors: impl Iterator<Item = Vec3>) -> Option<Vec3> {
    let (sum, count) = colors.fold((Vec3::ZERO, 0.0), |(sum, count), color| (sum + color, count + 1.0));
    (count > 0.0).then(|| sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;

    const SIZE: (u32, u32) = (320, 800);

    /// Distance from the outline of an upright ellipse in pixels, above 0 outside.
    fn outside(x: u32, y: u32) -> f32 {
        let place = Vec2::new(x as f32, y as f32) - Vec2::new(159.5, 399.5);
        let radii = Vec2::new(120.0, 370.0);
        let length = (place / radii).length();
        // To first order.
        (length - 1.0) * length / (place / (radii * radii)).length().max(1e-3)
    }

    fn mask(grown: f32) -> GrayImage {
        GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            Luma([(255.0 * (grown + 0.5 - outside(x, y)).clamp(0.0, 1.0)).round() as u8])
        })
    }

    /// A person in four colours with a fine pattern.
    fn person(x: u32, y: u32) -> Vec3 {
        let color =
            [[0.8, 0.6, 0.5], [0.2, 0.3, 0.7], [0.7, 0.2, 0.2], [0.25, 0.2, 0.15]][(y / 200) as usize];
        Vec3::from(color) + 0.05 * ((x * 7 + y * 13) % 5) as f32 - 0.1
    }

    fn picture(background: impl Fn(u32, u32) -> Vec3) -> RgbImage {
        let soft = mask(0.0);
        RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            let share = f32::from(soft.get_pixel(x, y).0[0]) / 255.0;
            let color = background(x, y).lerp(person(x, y), share);
            Rgb((255.0 * color).to_array().map(|c| c.round() as u8))
        })
    }

    /// Mean colour error of the outline.
    fn error(rgb: &RgbImage, mask: &GrayImage) -> f32 {
        let rim = Rim::new(mask, Rect::around(mask, INSIDE).expect("a person"), 1).expect("an outline");
        let error = |at: &usize| {
            let (x, y) = rim.place(*at);
            unit_color(rgb.get_pixel(x, y)).distance(person(x, y))
        };
        rim.pixels.iter().map(error).sum::<f32>() / rim.pixels.len() as f32
    }

    fn area(mask: &GrayImage) -> f32 {
        mask.pixels().map(|share| f32::from(share.0[0]) / 255.0).sum()
    }

    /// Colours and mask stay as they are.
    fn stays(mut rgb: RgbImage, mut mask: GrayImage, what: &str) {
        let same = (rgb.clone(), mask.clone());
        assert_eq!(clean(&mut rgb, &mut mask), 0, "{what}");
        assert!((rgb, mask) == same, "{what}");
    }

    type Behind = fn(u32, u32) -> Vec3;
    const BACKGROUNDS: [(&str, Behind); 4] = [
        ("white", |_, _| Vec3::ONE),
        ("grey", |_, _| Vec3::splat(0.5)),
        ("black", |_, _| Vec3::ZERO),
        ("lawn and sky", |x, y| match y < 400 {
            true => Vec3::new(0.5, 0.7, 0.95) + 0.00015 * x as f32,
            false => Vec3::new(0.3, 0.6, 0.1) + 0.04 * ((x * 31 + y * 17) % 7) as f32 / 7.0,
        }),
    ];

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
                let width = own_colors(&mut rgb, &mask(0.0), Background::OfNetwork, |_| false, |_, _| false);
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
            own_colors(&mut rgb, &mask(0.0), Background::OfNetwork, |_| is_hair, |_, _| false);
            bright(&rgb)
        };
        let all = bright(&taken);
        assert!(
            all > 300 && with(false) > all / 2 && with(true) < all / 4,
            "{all} {} {}",
            with(false),
            with(true)
        );
        let (mut rgb, grown) = (picture(BACKGROUNDS[0].1), mask(5.0));
        own_colors(&mut rgb, &grown, Background::OfNetwork, |_| false, |_, _| false);
        let left = rgb
            .enumerate_pixels()
            .filter(|(x, y, p)| grown.get_pixel(*x, *y)[0] >= INSIDE && p[2] > 240)
            .count();
        assert!(left < 20, "{left}");
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
