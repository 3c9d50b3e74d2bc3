//! One look of the network that knows people at a photograph: joints and likely pixels of the person.

use glam::Vec2;
use image::imageops::{self, FilterType};
use image::{GrayImage, RgbImage};
use snapsnap_net::blazepose::{Pose, SIDE};

use crate::joints::{Joint, Joints};
use crate::rect::Rect;
use crate::resize::{interpolate, reduced};
use crate::specks::pieces;

/// Longest side of the picture in which the network looks for the person.
const LONGEST: u32 = 1024;
/// Sides of the squares that the network sees, as multiples of the picture's and of the person's longer side.
const AROUND: [f32; 2] = [1.05, 1.2];
/// Most looks at a person. The first one is at the whole picture, each further one at the box of the look before.
const LOOKS: usize = 3;
/// Largest change of the box's edges after which no further look is needed, as a share of the square's side.
const STEADY: f32 = 0.05;
/// Probability above which there certainly is a person.
const CERTAIN: f32 = 0.9;
/// Least width of the space beside a person in which another person is looked for, as a share of the person's height.
const BESIDE: f32 = 0.2;
/// Least width of a picture, as a share of its height, in which several squares are looked at, and most steps between
/// them.
const WIDE: f32 = 1.2;
const MOST_STEPS: f32 = 8.0;
/// Squares of further looks, as multiples of the person's longer side, and whether the network sees the mirrored picture.
/// The mean of all looks is steadier than one look.
const AGAIN: [(f32, bool); 3] = [(1.2, true), (1.05, false), (1.05, true)];
/// Largest change of the box's edges between looks at one person, in the same unit.
const SAME: f32 = 0.2;
/// Brightness of the background of pictures with a mask.
const GREY: f32 = 150.0;
/// Probability above which there is a person, a joint, or a person's pixel.
const LIKELY: f32 = 0.5;

/// Landmarks that are joints, the first ones of [`Pose::landmarks`].
const JOINTS: usize = 33;

/// The signature of [`super::segmenter::pose`].
pub type FindPose<'a> = dyn Fn(&[f32]) -> Pose + 'a;

/// One look at a person.
pub struct Look {
    /// The joints, in pixels of the photograph.
    pub joints: Joints,
    /// The box around the person's joints and likely pixels, in pixels of the photograph.
    pub person: [Vec2; 2],
    /// Probability that there is a person.
    presence: f32,
    /// What each look saw of the person.
    seen: Vec<Seen>,
}

/// The person's pixels in a square.
struct Seen {
    /// Upper left corner and sides of the square, in pixels of the photograph.
    corner: Vec2,
    side: Vec2,
    /// Probability of each pixel of the square to belong to the person, 0 in pieces of others.
    mask: Vec<f32>,
}

impl Look {
    /// Looks for a person in a picture, from near if need be. `None` if there is nobody.
    pub fn find(picture: &RgbImage, network: &FindPose) -> Option<Self> {
        let small = Small::new(picture);
        let mut last = match small.largest(network) {
            Some(look) => look,
            None => small.look([Vec2::ZERO, small.size()], AROUND[0], network)?,
        };
        for _ in 1..LOOKS {
            let Some(next) = small.look_near(&last, network) else { break };
            let moved = next.moved(&last);
            last = next;
            if moved < STEADY * last.seen[0].side.max_element() {
                break;
            }
        }
        let mirrored = Small { picture: imageops::flip_horizontal(&small.picture), ..small };
        for (around, is_mirrored) in AGAIN {
            let person = if is_mirrored { flipped(last.person, picture.width()) } else { last.person };
            let from = if is_mirrored { &mirrored } else { &small };
            let again = from.look(person.map(|edge| edge / small.scale), around, network);
            let again = again.map(|look| if is_mirrored { look.mirrored(picture.width()) } else { look });
            let again = again.filter(|look| look.moved(&last) < SAME * last.seen[0].side.max_element());
            last.seen.extend(again.into_iter().flat_map(|look| look.seen));
        }
        Some(last)
    }

    /// Largest distance of an edge of the person's box from the edge in another look, in pixels of the photograph.
    fn moved(&self, other: &Self) -> f32 {
        let moved = [0, 1].map(|i| (self.person[i] - other.person[i]).abs().max_element());
        moved[0].max(moved[1])
    }

    /// The person's box and pixels in the mirrored picture, whose width is given. Joints stay.
    fn mirrored(mut self, width: u32) -> Self {
        self.person = flipped(self.person, width);
        for seen in &mut self.seen {
            seen.corner.x = width as f32 - seen.corner.x - seen.side.x;
            seen.mask.chunks_exact_mut(SIDE).for_each(<[f32]>::reverse);
        }
        self
    }

    /// Whether another person stands beside this one in the picture.
    pub fn is_accompanied(&self, picture: &RgbImage, network: &FindPose) -> bool {
        let [low, high] = self.person.map(Vec2::as_uvec2);
        let (width, height) = picture.dimensions();
        let least = BESIDE * (self.person[1] - self.person[0]).y;
        [[0, low.x], [high.x, width]].into_iter().any(|[left, right]| {
            let across = right.saturating_sub(left);
            if across == 0 || (across as f32) < least {
                return false;
            }
            let beside = Small::new(&imageops::crop_imm(picture, left, 0, across, height).to_image());
            let is_certain = |look: &Self| look.presence > CERTAIN;
            let whole = beside.look([Vec2::ZERO, beside.size()], AROUND[0], network).filter(is_certain);
            let near = whole.and_then(|look| beside.look_near(&look, network));
            near.is_some_and(|look| is_certain(&look))
        })
    }

    /// Looks at the person in a box of a picture whose mask is known, before grey.
    pub fn at(picture: &RgbImage, mask: &GrayImage, person: Rect, network: &FindPose) -> Option<Self> {
        let mut small = Small::new(picture);
        let (width, height) = small.picture.dimensions();
        let mask = imageops::thumbnail(mask, width, height);
        for (pixel, share) in small.picture.pixels_mut().zip(mask.pixels()) {
            let share = super::unit(share[0]);
            pixel.0 = pixel.0.map(|v| (share * f32::from(v) + (1.0 - share) * GREY).round() as u8);
        }
        let corner = Vec2::new(person.x as f32, person.y as f32);
        let size = Vec2::new(person.width as f32, person.height as f32);
        small.look([corner, corner + size].map(|edge| edge / small.scale), AROUND[1], network)
    }

    /// Probabilities of the pixels of a part of the picture, at this size (rows, columns): means of the looks that saw
    /// the pixel, 0 where none did.
    pub fn probabilities(&self, part: Rect, size: [usize; 2]) -> Vec<f32> {
        let mut sums = vec![(0.0, 0.0_f32); size[0] * size[1]];
        for seen in &self.seen {
            for ((sum, count), p) in sums.iter_mut().zip(seen.probabilities(part, size)) {
                (*sum, *count) = (*sum + p.unwrap_or(0.0), *count + f32::from(u8::from(p.is_some())));
            }
        }
        sums.into_iter().map(|(sum, count)| sum / count.max(1.0)).collect()
    }

    /// Pixels of the network's input per row of the photograph.
    pub fn scale(&self) -> f32 {
        SIDE as f32 / self.seen[0].side.y
    }
}

/// A box in the mirrored picture, whose width is given.
fn flipped([low, high]: [Vec2; 2], width: u32) -> [Vec2; 2] {
    [Vec2::new(width as f32 - high.x, low.y), Vec2::new(width as f32 - low.x, high.y)]
}

impl Seen {
    /// Probabilities of the pixels of a part of the picture; `None` outside of the square.
    fn probabilities(&self, part: Rect, [rows, columns]: [usize; 2]) -> Vec<Option<f32>> {
        let step = self.side / SIDE as f32;
        let at = |[first, length]: [u32; 2], count: usize, [corner, step]: [f32; 2]| -> Vec<_> {
            let place =
                |i: usize| (first as f32 + (i as f32 + 0.5) * length as f32 / count as f32 - corner) / step;
            let tap = |place: f32| {
                let low = (place - 0.5).clamp(0.0, (SIDE - 1) as f32);
                let index = (low as usize).min(SIDE - 2);
                (0.0..=SIDE as f32).contains(&place).then_some((index, index + 1, low - index as f32))
            };
            (0..count).map(|i| tap(place(i))).collect()
        };
        let down = at([part.y, part.height], rows, [self.corner.y, step.y]);
        let across = at([part.x, part.width], columns, [self.corner.x, step.x]);
        let value =
            |down: Option<_>, across: Option<_>| Some(interpolate(&self.mask, SIDE, [down?, across?]));
        down.iter().flat_map(|down| across.iter().map(|across| value(*down, *across))).collect()
    }
}

/// A reduced picture.
struct Small {
    picture: RgbImage,
    /// Pixels of the photograph per pixel.
    scale: Vec2,
}

impl Small {
    fn new(picture: &RgbImage) -> Self {
        let small = reduced(picture, LONGEST).unwrap_or_else(|| picture.clone());
        let size = |picture: &RgbImage| Vec2::new(picture.width() as f32, picture.height() as f32);
        Self { scale: size(picture) / size(&small), picture: small }
    }

    fn size(&self) -> Vec2 {
        Vec2::new(self.picture.width() as f32, self.picture.height() as f32)
    }

    /// The largest person of a picture that is wider than high. The network looks for somebody in the middle: between
    /// two people it sees nobody.
    fn largest(&self, network: &FindPose) -> Option<Look> {
        let Vec2 { x: width, y: height } = self.size();
        if width < WIDE * height {
            return None;
        }
        let steps = (2.0 * width / height).ceil().min(MOST_STEPS);
        let squares = (0..=steps as usize).map(|step| {
            let left = (width - height) * step as f32 / steps;
            [Vec2::new(left, 0.0), Vec2::new(left + height, height)]
        });
        let near = |square| self.look_near(&self.look(square, 1.0, network)?, network);
        let tall = |look: &Look| look.person[1].y - look.person[0].y;
        let certain = squares.filter_map(near).filter(|look| look.presence > CERTAIN);
        certain.max_by(|a, b| tall(a).total_cmp(&tall(b)))
    }

    /// Looks at the person of a look before.
    fn look_near(&self, before: &Look, network: &FindPose) -> Option<Look> {
        self.look(before.person.map(|edge| edge / self.scale), AROUND[1], network)
    }

    /// Looks at a square around a box, both in pixels of the reduced picture. The square is black outside.
    fn look(&self, [low, high]: [Vec2; 2], around: f32, network: &FindPose) -> Option<Look> {
        let side = ((around * (high - low).max_element()).ceil() as u32).clamp(1, 2 * LONGEST);
        let corner = (0.5 * (low + high - side as f32)).round().as_ivec2();
        let mut square = RgbImage::new(side, side);
        imageops::overlay(&mut square, &self.picture, -i64::from(corner.x), -i64::from(corner.y));
        let input = imageops::resize(&square, SIDE as u32, SIDE as u32, FilterType::CatmullRom);
        let plane = |channel: usize| input.pixels().map(move |pixel| super::unit(pixel[channel]));
        let Pose { landmarks, presence, mut mask } = network(&(0..3).flat_map(plane).collect::<Vec<f32>>());
        if presence < LIKELY {
            return None;
        }
        let likely: Vec<bool> = mask.iter().map(|p| *p > LIKELY).collect();
        let found = pieces(&likely, SIDE as u32);
        // Hidden joints count too: a hand may be a piece of its own.
        let piece_at = |[x, y, ..]: &[f32; 5]| {
            let is_inside = |v: f32| (0.0..SIDE as f32).contains(&v);
            (is_inside(*x) && is_inside(*y)).then(|| found.of[*y as usize * SIDE + *x as usize] as usize)
        };
        let mut joints_in = vec![0; found.pieces.len() + 1];
        landmarks[..JOINTS].iter().filter_map(piece_at).for_each(|piece| joints_in[piece] += 1);
        let rank = |piece: &usize| (joints_in[*piece], found.pieces[*piece - 1].0);
        let main = (1..joints_in.len()).max_by_key(rank)?;
        let is_own = |piece: usize| piece == main || joints_in[piece] > 0;
        // Soft pixels belong to no piece; they stay.
        let others = mask.iter_mut().zip(&found.of).filter(|(_, of)| **of > 0 && !is_own(**of as usize));
        others.for_each(|(p, _)| *p = 0.0);

        let step = side as f32 / SIDE as f32;
        let place = |x: f32, y: f32| self.scale * (corner.as_vec2() + step * Vec2::new(x, y));
        let probability = |logit: f32| 1.0 / (1.0 + (-logit).exp());
        let joint = |[x, y, _, visible, present]: &[f32; 5]| Joint {
            at: place(*x, *y),
            seen: probability(*visible).min(probability(*present)),
        };
        let joints = Joints(landmarks[..JOINTS].iter().map(joint).collect());
        let edges = |piece: usize| {
            let Rect { x, y, width, height } = found.pieces[piece - 1].1;
            [place(x as f32, y as f32), place((x + width) as f32, (y + height) as f32)]
        };
        let pieces = (1..joints_in.len()).filter(|piece| is_own(*piece)).flat_map(edges);
        let seen = joints.0.iter().filter(|joint| joint.seen > LIKELY).map(|joint| joint.at);
        let around = |[low, high]: [Vec2; 2], at: Vec2| [low.min(at), high.max(at)];
        let person = pieces.chain(seen).fold(edges(main), around);
        let limit = self.scale * self.size();
        Some(Look {
            joints,
            person: person.map(|edge| edge.clamp(Vec2::ZERO, limit)),
            presence,
            seen: vec![Seen { corner: place(0.0, 0.0), side: self.scale * side as f32, mask }],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A person on the left of a picture: mirrored looks find it there as well.
    #[test]
    fn mirrored_looks_see_the_same_pixels() {
        let is_person = |x: u32, y: u32| (20..60).contains(&x) && (30..170).contains(&y);
        let picture =
            RgbImage::from_fn(200, 200, |x, y| image::Rgb([if is_person(x, y) { 255 } else { 0 }; 3]));
        let network = |rgb: &[f32]| Pose {
            landmarks: vec![[-1.0, -1.0, 0.0, -9.0, -9.0]; 39],
            presence: 1.0,
            mask: rgb[..SIDE * SIDE].to_vec(),
        };
        let look = Look::find(&picture, &network).expect("a person");
        assert_eq!(look.seen.len(), 4);
        let found = look.probabilities(Rect { x: 0, y: 0, width: 200, height: 200 }, [200; 2]);
        let wrong = |(i, p): (usize, &f32)| (*p > 0.5) != is_person(i as u32 % 200, i as u32 / 200);
        let wrong = found.iter().enumerate().filter(|(i, p)| wrong((*i, *p))).count();
        assert!(wrong < 100, "{wrong} pixels");
    }

    /// Pictures of extreme sizes, with a network that answers anything.
    #[test]
    fn extreme_pictures_and_answers_do_no_harm() {
        let answer = |mask: f32, place: f32| {
            move |_: &[f32]| Pose {
                landmarks: vec![[place; 5]; 39],
                presence: 1.0,
                mask: vec![mask; SIDE * SIDE],
            }
        };
        for (width, height) in [(1, 1), (1, 70_000), (70_000, 64), (300, 200)] {
            let picture = RgbImage::new(width, height);
            for place in [128.0, -1e9, f32::NAN, f32::INFINITY] {
                assert!(Look::find(&picture, &answer(0.0, place)).is_none(), "no pixel of a person");
                let look = Look::find(&picture, &answer(1.0, place)).expect("a person");
                let whole = Rect { x: 0, y: 0, width, height };
                let probabilities = look.probabilities(whole, [5, 7]);
                // Of a wide picture, only the person's square is seen.
                let is_right = |p: &f32| *p == 1.0 || width > height && *p == 0.0;
                assert!(probabilities.iter().all(is_right), "{width}×{height}: {probabilities:?}");
                let mask = GrayImage::new(width, height);
                assert!(Look::at(&picture, &mask, whole, &answer(1.0, place)).is_some());
                let _ = (look.joints.facing(), look.joints.outside([width, height]), look.joints.sits());
            }
        }
    }
}
