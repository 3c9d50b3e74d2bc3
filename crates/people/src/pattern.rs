//! Patterns of cloth, with detail that a network cannot guess.

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::math::{hash, noise2, smoothstep};

/// Kinds of weave and print.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Plain,
    Stripes,
    Hoops,
    Checks,
    Tartan,
    Dots,
    Zigzag,
    Diamonds,
    Camouflage,
    Flowers,
    Denim,
    Knit,
}

const KINDS: [Kind; 12] = {
    use Kind::*;
    [Plain, Stripes, Hoops, Checks, Tartan, Dots, Zigzag, Diamonds, Camouflage, Flowers, Denim, Knit]
};
/// Kinds of most tops.
const COMMON: [Kind; 5] = [Kind::Plain, Kind::Plain, Kind::Plain, Kind::Knit, Kind::Denim];
/// Kinds of most trousers and shoes.
const QUIET: [Kind; 6] = [Kind::Plain, Kind::Denim, Kind::Plain, Kind::Knit, Kind::Checks, Kind::Stripes];

/// A cloth.
#[derive(Debug, Clone, PartialEq)]
pub struct Pattern {
    kind: Kind,
    colors: [Vec3; 3],
    /// Metres per repeat.
    scale: f32,
    seed: u32,
}

/// A colour from hue, saturation and value, each 0 to 1.
pub fn hue(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |shift: f32| {
        let at = (hue + shift).rem_euclid(1.0) * 6.0;
        ((at - 3.0).abs() - 1.0).clamp(0.0, 1.0)
    };
    let pure = Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0));
    Vec3::ONE.lerp(pure, saturation) * value
}

impl Pattern {
    /// Any cloth, mostly plain.
    pub fn draw(random: &mut impl Rng) -> Self {
        let kinds = if random.random_range(0.0..1.0_f32) < 0.6 { &COMMON[..] } else { &KINDS };
        Self::of(kinds[random.random_range(0..kinds.len())], random, 1.0)
    }

    /// A cloth for trousers and shoes.
    pub fn draw_quiet(random: &mut impl Rng) -> Self {
        Self::of(QUIET[random.random_range(0..QUIET.len())], random, 0.6)
    }

    /// `strength` scales the saturation, except of grey cloth.
    fn of(kind: Kind, random: &mut impl Rng, strength: f32) -> Self {
        let base: f32 = random.random_range(0.0..1.0);
        // Much cloth is black, white or grey.
        let is_grey = random.random_range(0.0..1.0_f64) < 0.3;
        let mut between = |low: f32, high: f32| random.random_range(low..high);
        let saturation = if is_grey { 0.06 } else { between(0.25, 0.85) * strength };
        let value = between(0.05, 0.97);
        let contrast = if value > 0.5 { -0.45 } else { 0.45 };
        let second = hue(base + between(-0.15, 0.5), saturation * 0.9, (value + contrast).clamp(0.05, 1.0));
        let third = hue(base + between(0.2, 0.8), (saturation + 0.2).min(0.9), between(0.3, 0.95));
        let first = if kind == Kind::Denim {
            hue(between(0.57, 0.63), between(0.35, 0.6), between(0.2, 0.6))
        } else {
            hue(base, saturation, value)
        };
        let scale = between(0.02, 0.08);
        Self { kind, colors: [first, second, third], scale, seed: random.random() }
    }

    pub fn main(&self) -> Vec3 {
        self.colors[0]
    }

    /// Colour at `at`, metres of cloth to the right and up.
    pub fn color(&self, at: Vec2) -> Vec3 {
        let [a, b, c] = self.colors;
        let p = at / self.scale;
        let f = p - p.floor();
        // Half the width of an edge, 0.8 mm of cloth.
        let soft = 0.0008 / self.scale;
        let band = |x: f32, from: f32, to: f32| {
            smoothstep(from - soft, from + soft, x) * (1.0 - smoothstep(to - soft, to + soft, x))
        };
        let color = match self.kind {
            Kind::Plain => a,
            Kind::Stripes => a.lerp(b, band(f.x, 0.25, 0.62)).lerp(c, band(f.x, 0.78, 0.86)),
            Kind::Hoops => a.lerp(b, band(f.y, 0.25, 0.7)),
            Kind::Checks => {
                let (x, y) = (band(f.x, 0.25, 0.75), band(f.y, 0.25, 0.75));
                a.lerp(b, x + y - 2.0 * x * y)
            }
            Kind::Tartan => a
                .lerp(b, 0.5 * band(f.x, 0.1, 0.5))
                .lerp(b, 0.5 * band(f.y, 0.1, 0.5))
                .lerp(c, 0.8 * band(f.x, 0.72, 0.78))
                .lerp(c, 0.8 * band(f.y, 0.72, 0.78)),
            Kind::Dots => {
                let shift = if p.y.floor() as i32 & 1 == 0 { 0.0 } else { 0.5 };
                let centre = Vec2::new((p.x + shift).rem_euclid(1.0), f.y) - Vec2::splat(0.5);
                a.lerp(b, 1.0 - smoothstep(0.26 - soft, 0.26 + soft, centre.length()))
            }
            Kind::Zigzag => {
                let wave = (f.x - 0.5).abs();
                let y = (p.y + wave).rem_euclid(1.0);
                a.lerp(b, band(y, 0.2, 0.5)).lerp(c, band(y, 0.7, 0.85))
            }
            Kind::Diamonds => {
                let d = (f.x - 0.5).abs() + (f.y - 0.5).abs();
                let line =
                    ((p.x + p.y).rem_euclid(1.0) - 0.5).abs().min(((p.x - p.y).rem_euclid(1.0) - 0.5).abs());
                a.lerp(b, 1.0 - smoothstep(0.45 - soft, 0.45 + soft, d))
                    .lerp(c, 1.0 - smoothstep(0.02, 0.02 + soft, line))
            }
            Kind::Camouflage => {
                let n = 0.7 * noise2(p * 0.8, self.seed) + 0.3 * noise2(p * 2.3, self.seed ^ 5);
                let m = noise2(p * 0.9 + Vec2::splat(40.0), self.seed);
                a.lerp(b, smoothstep(0.52, 0.52 + 2.0 * soft, n))
                    .lerp(c, smoothstep(0.62, 0.62 + 2.0 * soft, m))
            }
            Kind::Flowers => {
                let cell = p.floor();
                let (x, y) = (cell.x as i32, cell.y as i32);
                let jitter = |k: u32| 0.3 * (hash(x, y, 0, self.seed ^ k) - 0.5);
                let d = f - Vec2::splat(0.5) - Vec2::new(jitter(1), jitter(2));
                let angle = libm::atan2f(d.y, d.x);
                let petals = 0.2 + 0.1 * libm::sincosf(5.0 * angle + 6.0 * jitter(3)).1;
                let petal = 1.0 - smoothstep(petals, petals + 2.0 * soft, d.length());
                a.lerp(b, petal).lerp(c, 1.0 - smoothstep(0.07, 0.07 + 2.0 * soft, d.length()))
            }
            Kind::Denim => {
                let twill = ((at.x + at.y) * 700.0).rem_euclid(1.0);
                let worn = noise2(at * 9.0, self.seed);
                a * (0.86 + 0.18 * twill) + Vec3::splat(0.12 * smoothstep(0.55, 0.9, worn))
            }
            Kind::Knit => {
                let rib = ((at.x * 160.0).rem_euclid(1.0) - 0.5).abs();
                let row = ((at.y * 220.0 + rib).rem_euclid(1.0) - 0.5).abs();
                a * (0.8 + 0.25 * rib + 0.25 * row)
            }
        };
        // Threads, and light and dark patches of worn cloth.
        let thread = noise2(at * 900.0, self.seed ^ 77) - 0.5;
        let patch = noise2(at * 14.0, self.seed ^ 99) - 0.5;
        (color * (1.0 + 0.10 * thread + 0.12 * patch)).clamp(Vec3::ZERO, Vec3::ONE)
    }
}

/// A picture on a garment.
#[derive(Debug, Clone)]
pub struct Print {
    /// Colours of the picture.
    colors: [Vec3; 2],
    /// Number of two digits; `None` for a sign.
    number: Option<u32>,
    sign: u32,
    /// Height in metres.
    size: f32,
}

/// Digits as 3 × 5 dots: rows from the top, one octal digit each.
const DIGITS: [u16; 10] =
    [0o75557, 0o26227, 0o71747, 0o71317, 0o55711, 0o74717, 0o74757, 0o71222, 0o75757, 0o75717];

impl Print {
    /// A picture that contrasts with cloth of the colour `on`.
    pub fn draw(random: &mut impl Rng, on: Vec3) -> Self {
        let bright = on.element_sum() > 1.4;
        let value = if bright { random.random_range(0.05..0.4) } else { random.random_range(0.75..1.0) };
        let colors =
            [(); 2].map(|()| hue(random.random_range(0.0..1.0), random.random_range(0.2..0.9), value));
        let number = (random.random_range(0.0..1.0) < 0.5).then(|| random.random_range(0..100));
        Self { colors, number, sign: random.random_range(0..4), size: random.random_range(0.1..0.22) }
    }

    /// The picture, centred at 0, over `color` at `at` (metres to the viewer's right and up).
    pub fn over(&self, color: Vec3, at: Vec2) -> Vec3 {
        let p = at / self.size;
        if p.abs().max_element() > 0.75 {
            return color;
        }
        let [first, second] = self.colors;
        match self.number {
            Some(number) => {
                // Two digits of 3 × 5 dots with one empty column between them.
                let (column, row) = ((p.x / 0.15 + 3.5).floor(), ((0.5 - p.y) * 5.0).floor());
                if !(0.0..7.0).contains(&column) || !(0.0..5.0).contains(&row) || column == 3.0 {
                    return color;
                }
                let (digit, dot) = if column < 3.0 {
                    (number / 10, column as u32)
                } else {
                    (number % 10, column as u32 - 4)
                };
                let lit = DIGITS[digit as usize] >> (3 * (4 - row as u32) + 2 - dot) & 1 == 1;
                if lit { first } else { color }
            }
            None => {
                let (r, angle) = (p.length(), libm::atan2f(p.x, p.y));
                let edge = match self.sign {
                    0 => 0.45,
                    1 => 0.33 + 0.14 * libm::sincosf(5.0 * angle).1,
                    2 => 0.5 / (p.x.abs().max(p.y.abs()) / r.max(1e-6)) * 0.8,
                    _ => 0.3 + 0.18 * libm::sincosf(3.0 * angle).1,
                };
                match r {
                    r if r < 0.5 * edge => second,
                    r if r < edge => first,
                    _ => color,
                }
            }
        }
    }
}
