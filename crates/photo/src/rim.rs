//! Pixels near the outline of a mask, and their colours (docs/method.md, "Rims").

use glam::Vec3;
use image::{GrayImage, Rgb, RgbImage};

use crate::rect::Rect;
use crate::{INSIDE, unit_color};

/// Width of the rim in pixels for a person of [`HEIGHT`] pixels.
pub const REACH: u32 = 6;
/// Height of the person that [`REACH`] refers to, in pixels.
pub const HEIGHT: u32 = 739;
/// Largest width of the rim, in pixels of the photograph.
pub const MAX_REACH: u32 = 64;
/// Least distance of the colours of person and background at which they are told apart. Channels are 0 to 1.
pub const DISTINCT: f32 = 0.12;
/// Least share of the outline with distinct colours.
pub const LEAST_DISTINCT: f32 = 0.25;
/// Largest distance of a mixed colour from the line between both colours: a share of its length, plus a constant.
const OFF_LINE: (f32, f32) = (0.35, 0.03);
/// Longest outline of a person: the larger of the first number, in pixels, and the box's area over the second number.
const LONGEST: (usize, usize) = (50_000, 20);

/// Pixels near the outline of a mask, in a part of the picture.
pub struct Rim {
    part: Rect,
    /// Level of each pixel of the part. Inside: 1, 2, … from the outline, [`DEEP`] behind the rim. Outside: −1, −2, …,
    /// and 0 farther away.
    pub levels: Vec<i8>,
    /// Pixels inside, level by level.
    pub pixels: Vec<usize>,
    /// Pixels outside, level by level.
    pub beyond: Vec<usize>,
}

/// Level of pixels behind the rim.
const DEEP: i8 = i8::MAX;

impl Rim {
    /// `None` if the outline is too long for a person.
    pub fn new(mask: &GrayImage, person: Rect, reach: i8) -> Option<Self> {
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
    pub fn place(&self, at: usize) -> (u32, u32) {
        let at = at as u32;
        (self.part.x + at % self.part.width, self.part.y + at / self.part.width)
    }

    /// Colour of a pixel of the part in the picture, channels 0 to 1.
    pub fn color(&self, rgb: &RgbImage, at: usize) -> Vec3 {
        let (x, y) = self.place(at);
        unit_color(rgb.get_pixel(x, y))
    }

    /// Number of pixels of the outline, the first ones of [`Self::pixels`].
    pub fn outline(&self) -> usize {
        self.pixels.iter().take_while(|at| self.levels[**at] == 1).count()
    }

    /// The neighbours of a pixel in the part, up to eight.
    pub fn neighbours(&self, at: usize) -> impl Iterator<Item = usize> + use<> {
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
pub struct Colors {
    /// For each pixel of the part, its index among the rim's pixels or the pixels beyond; `u32::MAX` for others.
    pub index: Vec<u32>,
    pub own: Vec<Vec3>,
    /// Colours of the person behind the rim.
    pub inside: Vec<Vec3>,
    /// Colours of the picture outside of the mask.
    pub outside: Vec<Vec3>,
    /// Whether the picture near the mask has exactly one colour.
    pub is_flat: bool,
}

impl Colors {
    pub fn new(rim: &Rim, rgb: &RgbImage) -> Self {
        let color = |at: usize| rim.color(rgb, at);
        let mut index = vec![u32::MAX; rim.levels.len()];
        for pixels in [&rim.pixels, &rim.beyond] {
            pixels.iter().enumerate().for_each(|(i, at)| index[*at] = i as u32);
        }
        let own: Vec<Vec3> = rim.pixels.iter().map(|at| color(*at)).collect();
        // The person's colour comes outwards from behind the rim, the background's inwards from beyond it.
        let inside = carried(rim, &rim.pixels, rgb, &index, own.clone());
        let beyond: Vec<Vec3> = rim.beyond.iter().map(|at| color(*at)).collect();
        let is_flat = beyond.windows(2).all(|pair| pair[0] == pair[1]);
        let beyond = carried(rim, &rim.beyond, rgb, &index, beyond);
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

    /// [`Self::inside`] for strands of hair: the colour of a part that is thinner than the rim comes from behind the rim
    /// on the shortest way through the mask, and is not the part's own.
    pub fn strands(&self, rim: &Rim, rgb: &RgbImage) -> Vec<Vec3> {
        let mut found: Vec<Option<Vec3>> = vec![None; rim.pixels.len()];
        let in_rim = |at: usize| rim.neighbours(at).filter(|to| (1..DEEP).contains(&rim.levels[*to]));
        let behind = |at: usize| rim.neighbours(at).filter(|to| rim.levels[*to] == DEEP);
        let first =
            rim.pixels.iter().filter_map(|at| Some((*at, mean(behind(*at).map(|to| rim.color(rgb, to)))?)));
        let mut last: Vec<(usize, Vec3)> = first.collect();
        while !last.is_empty() {
            last.iter().for_each(|(at, color)| found[self.index[*at] as usize] = Some(*color));
            let reached = |to: usize| found[self.index[to] as usize];
            let mut next: Vec<usize> = last.iter().flat_map(|(at, _)| in_rim(*at)).collect();
            next.retain(|to| reached(*to).is_none());
            next.sort_unstable();
            next.dedup();
            last =
                next.into_iter().filter_map(|at| Some((at, mean(in_rim(at).filter_map(reached))?))).collect();
        }
        let found = found.iter().zip(&self.own).map(|(found, own)| found.unwrap_or(*own)).collect();
        carried(rim, &rim.pixels, rgb, &self.index, found)
    }

    /// The share of `background` in a pixel of the rim, and whether it differs from the person's colour.
    pub fn share(&self, i: usize, background: Vec3) -> (f32, bool) {
        let (person, line) = (self.inside[i], background - self.inside[i]);
        let length = line.length();
        if length < DISTINCT {
            return (0.0, false);
        }
        let share = (self.own[i] - person).dot(line) / line.length_squared();
        let off = (self.own[i] - person - share * line).length();
        (if off > OFF_LINE.0 * length + OFF_LINE.1 { 0.0 } else { share.clamp(0.0, 1.0) }, true)
    }
}

/// Colours carried from level to level towards the outline, from behind the rim to its `pixels`, or from far outside to
/// the pixels beyond. Pixels without neighbours farther from the outline keep `colors`.
fn carried(rim: &Rim, pixels: &[usize], rgb: &RgbImage, index: &[u32], mut colors: Vec<Vec3>) -> Vec<Vec3> {
    for (i, &at) in pixels.iter().enumerate().rev() {
        let level = rim.levels[at];
        let of = |to: usize| match rim.levels[to] {
            DEEP if level > 0 => Some(rim.color(rgb, to)),
            farther if farther == level + level.signum() => Some(colors[index[to] as usize]),
            _ => None,
        };
        if let Some(color) = mean(rim.neighbours(at).filter_map(of)) {
            colors[i] = color;
        }
    }
    colors
}

/// A colour with channels in [0, 1] as a pixel.
pub fn pixel(color: Vec3) -> Rgb<u8> {
    Rgb((255.0 * color).to_array().map(|c| c.round() as u8))
}

/// The mean colour; `None` without colours.
pub fn mean(colors: impl Iterator<Item = Vec3>) -> Option<Vec3> {
    let (sum, count) = colors.fold((Vec3::ZERO, 0.0), |(sum, count), color| (sum + color, count + 1.0));
    (count > 0.0).then(|| sum / count)
}

/// An upright ellipse in four colours before backgrounds.
#[cfg(test)]
pub mod tests {
    use super::*;
    use glam::Vec2;
    use image::Luma;

    pub const SIZE: (u32, u32) = (320, 800);

    /// Distance from the outline of an upright ellipse in pixels, above 0 outside.
    pub fn outside(x: u32, y: u32) -> f32 {
        let place = Vec2::new(x as f32, y as f32) - Vec2::new(159.5, 399.5);
        let radii = Vec2::new(120.0, 370.0);
        let length = (place / radii).length();
        // To first order.
        (length - 1.0) * length / (place / (radii * radii)).length().max(1e-3)
    }

    pub fn mask(grown: f32) -> GrayImage {
        GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            Luma([(255.0 * (grown + 0.5 - outside(x, y)).clamp(0.0, 1.0)).round() as u8])
        })
    }

    /// A person in four colours with a fine pattern.
    pub fn person(x: u32, y: u32) -> Vec3 {
        let color =
            [[0.8, 0.6, 0.5], [0.2, 0.3, 0.7], [0.7, 0.2, 0.2], [0.25, 0.2, 0.15]][(y / 200) as usize];
        Vec3::from(color) + 0.05 * ((x * 7 + y * 13) % 5) as f32 - 0.1
    }

    pub fn picture(background: impl Fn(u32, u32) -> Vec3) -> RgbImage {
        let soft = mask(0.0);
        RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            let share = f32::from(soft.get_pixel(x, y).0[0]) / 255.0;
            let color = background(x, y).lerp(person(x, y), share);
            Rgb((255.0 * color).to_array().map(|c| c.round() as u8))
        })
    }

    /// Mean colour error of the outline.
    pub fn error(rgb: &RgbImage, mask: &GrayImage) -> f32 {
        let rim = Rim::new(mask, Rect::around(mask, INSIDE).expect("a person"), 1).expect("an outline");
        let error = |at: &usize| {
            let (x, y) = rim.place(*at);
            unit_color(rgb.get_pixel(x, y)).distance(person(x, y))
        };
        rim.pixels.iter().map(error).sum::<f32>() / rim.pixels.len() as f32
    }

    pub fn area(mask: &GrayImage) -> f32 {
        mask.pixels().map(|share| f32::from(share.0[0]) / 255.0).sum()
    }

    pub type Behind = fn(u32, u32) -> Vec3;
    pub const BACKGROUNDS: [(&str, Behind); 4] = [
        ("white", |_, _| Vec3::ONE),
        ("grey", |_, _| Vec3::splat(0.5)),
        ("black", |_, _| Vec3::ZERO),
        ("lawn and sky", |x, y| match y < 400 {
            true => Vec3::new(0.5, 0.7, 0.95) + 0.00015 * x as f32,
            false => Vec3::new(0.3, 0.6, 0.1) + 0.04 * ((x * 31 + y * 17) % 7) as f32 / 7.0,
        }),
    ];
}
