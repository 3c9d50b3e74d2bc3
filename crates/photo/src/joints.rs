//! Where a network that knows people sees one: the joints and the likely pixels of the person in a photograph.

use std::fmt;

use glam::Vec2;
use image::imageops::{self, FilterType};
use image::{GrayImage, RgbImage};
use serde::Serialize;
use snapsnap_net::blazepose::{Pose, SIDE};

use crate::rect::Rect;
use crate::resize::interpolate;
use crate::specks::pieces;

/// Longest side of the picture in which the network looks for the person.
const LONGEST: u32 = 1024;
/// Sides of the squares that the network sees, as multiples of the picture's and of the person's longer side.
const AROUND: [f32; 2] = [1.05, 1.2];
/// Most looks at a person. The first one is at the whole picture, each further one at the box of the look before.
const LOOKS: usize = 3;
/// Largest change of the box's edges after which no further look is needed, as a share of the square's side.
const STEADY: f32 = 0.05;
/// Brightness of the background of pictures with a mask.
const GREY: f32 = 150.0;
/// Probability above which there is a person, a joint, or a person's pixel.
const LIKELY: f32 = 0.5;

/// Landmarks that are joints, the first ones of [`Pose::landmarks`].
const JOINTS: usize = 33;

/// The signature of [`super::segmenter::pose`].
pub type FindPose<'a> = dyn Fn(&[f32]) -> Pose + 'a;

/// A joint of a person, numbered as in [`Pose::landmarks`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint {
    /// Column and row in pixels of the photograph. It may lie outside.
    pub at: Vec2,
    /// Probability that the joint is within the picture and not hidden.
    pub seen: f32,
}

/// One look at a person.
pub struct Look {
    /// The joints, in pixels of the photograph.
    pub joints: Joints,
    /// The box around the person's joints and likely pixels, in pixels of the photograph.
    pub person: [Vec2; 2],
    /// Upper left corner and sides of the square that the network saw.
    corner: Vec2,
    side: Vec2,
    /// Probability of each pixel of the square to belong to the person, 0 in pieces of others.
    mask: Vec<f32>,
}

impl Look {
    /// Looks for a person in a picture, from near if need be. `None` if there is nobody.
    pub fn find(picture: &RgbImage, network: &FindPose) -> Option<Self> {
        let small = Small::new(picture);
        let whole = [Vec2::ZERO, small.size()];
        let mut last = small.look(whole, AROUND[0], network)?;
        for _ in 1..LOOKS {
            let Some(next) = small.look(last.person.map(|edge| edge / small.scale), AROUND[1], network)
            else {
                break;
            };
            let moved = [0, 1].map(|i| (next.person[i] - last.person[i]).abs().max_element());
            last = next;
            if moved[0].max(moved[1]) < STEADY * last.side.max_element() {
                break;
            }
        }
        Some(last)
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

    /// Probabilities of the pixels of a part of the picture, at this size (rows, columns).
    pub fn probabilities(&self, part: Rect, [rows, columns]: [usize; 2]) -> Vec<f32> {
        let step = self.side / SIDE as f32;
        let at = |first: u32,
                  length: u32,
                  count: usize,
                  corner: f32,
                  step: f32|
         -> Vec<Option<(usize, usize, f32)>> {
            let place =
                |i: usize| (first as f32 + (i as f32 + 0.5) * length as f32 / count as f32 - corner) / step;
            let tap = |place: f32| {
                let low = (place - 0.5).clamp(0.0, (SIDE - 1) as f32);
                let index = (low as usize).min(SIDE - 2);
                (0.0..=SIDE as f32).contains(&place).then_some((index, index + 1, low - index as f32))
            };
            (0..count).map(|i| tap(place(i))).collect()
        };
        let down = at(part.y, part.height, rows, self.corner.y, step.y);
        let across = at(part.x, part.width, columns, self.corner.x, step.x);
        let value = |down: Option<_>, across: Option<_>| match (down, across) {
            (Some(down), Some(across)) => interpolate(&self.mask, SIDE, [down, across]),
            _ => 0.0,
        };
        down.iter().flat_map(|down| across.iter().map(|across| value(*down, *across))).collect()
    }

    /// Pixels of the network's input per row of the photograph.
    pub fn scale(&self) -> f32 {
        SIDE as f32 / self.side.y
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
        let (width, height) = picture.dimensions();
        let longest = width.max(height);
        let reduced = |side: u32| (u64::from(side) * u64::from(LONGEST) / u64::from(longest)).max(1) as u32;
        let small = if longest > LONGEST {
            imageops::thumbnail(picture, reduced(width), reduced(height))
        } else {
            picture.clone()
        };
        let scale = Vec2::new(width as f32 / small.width() as f32, height as f32 / small.height() as f32);
        Self { picture: small, scale }
    }

    fn size(&self) -> Vec2 {
        Vec2::new(self.picture.width() as f32, self.picture.height() as f32)
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
        mask.iter_mut()
            .zip(&found.of)
            .filter(|(_, of)| **of > 0 && !is_own(**of as usize))
            .for_each(|(p, _)| *p = 0.0);

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
            corner: place(0.0, 0.0),
            side: self.scale * side as f32,
            mask,
        })
    }
}

/// The side of the body that a photograph shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Facing {
    /// The person's left is on the right of the picture.
    Front,
    /// The person's left is on the left.
    Back,
    /// One shoulder is behind the other one.
    Side,
}

/// A part of the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// From the crown to the nose.
    Head,
    /// The person's left arm with its hand.
    LeftArm,
    /// The person's right arm with its hand.
    RightArm,
    /// The person's left leg with its foot.
    LeftLeg,
    /// The person's right leg with its foot.
    RightLeg,
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Head => "head",
            Self::LeftArm => "left arm",
            Self::RightArm => "right arm",
            Self::LeftLeg => "left leg",
            Self::RightLeg => "right leg",
        })
    }
}

/// The 33 joints of [`Pose::landmarks`].
#[derive(Debug, Clone, PartialEq)]
pub struct Joints(pub Vec<Joint>);

/// Least distance of the shoulders in front and back views, and largest one in side views, as shares of the torso's
/// length (docs/notes/photographs.md, "Joints").
const SHOULDERS: [f32; 2] = [0.5, 0.25];
/// Least angle of the torso to the vertical of somebody who does not stand, in degrees.
const LEANING: f32 = 45.0;
/// Largest drop from hip to knee of somebody who sits, as a share of the torso's length. Who stands has 0.61 or more.
const SEATED: f32 = 0.4;
/// The crown's distance from the nose, as a share of the nose's distance from the shoulders.
const CROWN: f32 = 0.6;
/// Radius of a circle around the nose that contains the hair, in the same unit.
const HAIR: f32 = 1.6;
/// Radius of a circle around the nose that contains the face, in distances of the farther ear.
const FACE: f32 = 1.2;
/// Distance beyond the border from which a part is outside of the picture, as a share of the torso's length.
const BEYOND: f32 = 0.02;
/// Joints that tell where a limb is, and their largest distances between front and mirrored back, as shares of the
/// torso's length. Perspective moves feet.
const LIMBS: [(Part, [(usize, f32); 2]); 4] = [
    (Part::LeftArm, [(13, 0.5), (15, 0.7)]),
    (Part::RightArm, [(14, 0.5), (16, 0.7)]),
    (Part::LeftLeg, [(25, 0.6), (27, 1.0)]),
    (Part::RightLeg, [(26, 0.6), (28, 1.0)]),
];
/// Joints at the ends of the limbs.
const ENDS: [(Part, [usize; 2]); 4] = [
    (Part::LeftArm, [15, 19]),
    (Part::RightArm, [16, 20]),
    (Part::LeftLeg, [29, 31]),
    (Part::RightLeg, [30, 32]),
];

impl Joints {
    fn at(&self, joint: usize) -> Vec2 {
        self.0[joint].at
    }

    /// The middles between both shoulders and between both hips.
    fn torso(&self) -> [Vec2; 2] {
        [11, 23].map(|left| 0.5 * (self.at(left) + self.at(left + 1)))
    }

    /// Length of the torso in pixels.
    fn length(&self) -> f32 {
        let [shoulders, hips] = self.torso();
        shoulders.distance(hips).max(1.0)
    }

    /// Whether there may be hair at a place: above the shoulders, and around the face unless seen from behind.
    pub fn is_hair(&self, place: Vec2) -> bool {
        let (nose, [shoulders, hips]) = (self.at(0), self.torso());
        let ears = [7, 8].map(|ear| nose.distance(self.at(ear)));
        let face = if self.facing() == Some(Facing::Back) { 0.0 } else { FACE * ears[0].max(ears[1]) };
        (place - shoulders).dot(shoulders - hips) > 0.0
            && (face..HAIR * nose.distance(shoulders)).contains(&nose.distance(place))
    }

    /// `None` between front and side.
    pub fn facing(&self) -> Option<Facing> {
        let [shoulders, hips] = self.torso();
        let up = shoulders - hips;
        let width = (self.at(11) - self.at(12)).dot(Vec2::new(-up.y, up.x)) / self.length().powi(2);
        match width.abs() {
            apart if apart < SHOULDERS[1] => Some(Facing::Side),
            apart if apart < SHOULDERS[0] => None,
            _ => Some(if width > 0.0 { Facing::Front } else { Facing::Back }),
        }
    }

    /// Whether the person lies, is upside down, or leans far.
    pub fn lies(&self) -> bool {
        let [shoulders, hips] = self.torso();
        let up = shoulders - hips;
        up.x.atan2(-up.y).abs().to_degrees() > LEANING
    }

    /// Whether the thighs are level.
    pub fn sits(&self) -> bool {
        [23, 24].into_iter().all(|hip| self.at(hip + 2).y - self.at(hip).y < SEATED * self.length())
    }

    /// Parts outside of a picture of this size.
    pub fn outside(&self, size: [u32; 2]) -> Vec<Part> {
        let beyond = BEYOND * self.length();
        let limit = Vec2::new(size[0] as f32, size[1] as f32) + beyond;
        let is_out = |at: Vec2| at.min_element() < -beyond || at.x > limit.x || at.y > limit.y;
        let nose = self.at(0);
        let crown = nose + CROWN * (nose - self.torso()[0]);
        let head = [crown].into_iter().filter(|at| is_out(*at)).map(|_| Part::Head);
        let limbs = ENDS.into_iter().filter(|(_, ends)| ends.iter().any(|end| is_out(self.at(*end))));
        head.chain(limbs.map(|(part, _)| part)).collect()
    }

    /// Limbs that are elsewhere in the mirrored photograph `back`.
    pub fn moved(&self, back: &Self) -> Vec<Part> {
        // Relative to the torso's middle, in lengths of the torso.
        let place = |joints: &Self, joint: usize| {
            let [shoulders, hips] = joints.torso();
            (joints.at(joint) - 0.5 * (shoulders + hips)) / joints.length()
        };
        let is_moved = |(joint, most): &(usize, f32)| {
            let seen = self.0[*joint].seen.min(back.0[*joint].seen);
            let behind = place(back, *joint) * Vec2::new(-1.0, 1.0);
            seen > LIKELY && place(self, *joint).distance(behind) > *most
        };
        LIMBS.iter().filter(|(_, joints)| joints.iter().any(is_moved)).map(|(part, _)| *part).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Somebody who stands in a picture of 100 × 200 pixels, seen from the front.
    fn standing() -> Joints {
        let mut at = vec![Vec2::new(50.0, 30.0); 33];
        for (left, x, y) in [
            (11, 65.0, 50.0),
            (13, 72.0, 75.0),
            (15, 75.0, 95.0),
            (19, 76.0, 100.0),
            (23, 58.0, 100.0),
            (25, 59.0, 140.0),
            (27, 60.0, 180.0),
            (29, 60.0, 185.0),
            (31, 62.0, 190.0),
            (7, 56.0, 28.0),
        ] {
            (at[left], at[left + 1]) = (Vec2::new(x, y), Vec2::new(100.0 - x, y));
        }
        Joints(at.into_iter().map(|at| Joint { at, seen: 1.0 }).collect())
    }

    fn changed(of: &Joints, change: impl Fn(usize, Vec2) -> Vec2) -> Joints {
        let joint = |(i, joint): (usize, &Joint)| Joint { at: change(i, joint.at), ..*joint };
        Joints(of.0.iter().enumerate().map(joint).collect())
    }

    #[test]
    fn joints_say_what_a_photograph_shows() {
        let front = standing();
        let back = changed(&front, |_, at| Vec2::new(100.0 - at.x, at.y));
        assert_eq!((front.facing(), back.facing()), (Some(Facing::Front), Some(Facing::Back)));
        let thin = |x: f32| 50.0 + 0.2 * (x - 50.0);
        assert_eq!(changed(&front, |_, at| Vec2::new(thin(at.x), at.y)).facing(), Some(Facing::Side));
        // Upside down and lying people keep their side.
        let (turned, lying) =
            (changed(&front, |_, at| 200.0 - at), changed(&front, |_, at| Vec2::new(200.0 - at.y, at.x)));
        assert_eq!((turned.facing(), lying.facing()), (front.facing(), front.facing()));
        assert!(turned.lies() && lying.lies() && !front.lies() && !front.sits());
        assert!(changed(&front, |i, at| if i >= 25 { at - Vec2::new(0.0, 30.0) } else { at }).sits());
        assert_eq!(front.moved(&back), []);
        let raised = changed(&back, |i, at| if i == 15 || i == 19 { Vec2::new(at.x, 20.0) } else { at });
        assert_eq!(front.moved(&raised), [Part::LeftArm]);
        let hidden = Joints(raised.0.iter().map(|joint| Joint { seen: 0.2, ..*joint }).collect());
        assert_eq!(front.moved(&hidden), []);
        assert_eq!(front.outside([100, 200]), []);
        assert_eq!(front.outside([100, 187]), [Part::LeftLeg, Part::RightLeg]);
        assert_eq!(
            changed(&front, |_, at| at - Vec2::new(27.0, 25.0)).outside([100, 200]),
            [Part::Head, Part::RightArm]
        );
        assert!(front.is_hair(Vec2::new(50.0, 12.0)) && !front.is_hair(Vec2::new(52.0, 32.0)));
        assert!(back.is_hair(Vec2::new(50.0, 32.0)) && !back.is_hair(Vec2::new(50.0, 55.0)));
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
                assert!(probabilities.iter().all(|p| *p == 1.0), "{width}×{height}: {probabilities:?}");
                let mask = GrayImage::new(width, height);
                assert!(Look::at(&picture, &mask, whole, &answer(1.0, place)).is_some());
                let _ = (look.joints.facing(), look.joints.outside([width, height]), look.joints.sits());
            }
        }
    }
}
