//! What a person's joints say of a photograph (docs/method.md, "Joints").

use std::fmt;

use glam::Vec2;
use serde::Serialize;

/// Probability above which a joint is seen.
const SEEN: f32 = 0.5;

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

/// A joint, numbered as in [`snapsnap_net::blazepose::Pose::landmarks`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint {
    /// Column and row in pixels of the photograph. It may lie outside.
    pub at: Vec2,
    /// Probability that the joint is within the picture and not hidden.
    pub seen: f32,
}

/// What the pose network sees in a photograph.
#[derive(Debug, Clone, PartialEq)]
pub enum Sight {
    /// It was not asked.
    Unasked,
    /// Nobody.
    Nobody,
    /// A person. The joints are in pixels of the photograph before it is turned.
    Person(Joints),
}

impl Sight {
    /// The joints, if a person is seen.
    pub fn joints(&self) -> Option<&Joints> {
        if let Self::Person(joints) = self { Some(joints) } else { None }
    }
}

/// The 33 joints of a person.
#[derive(Debug, Clone, PartialEq)]
pub struct Joints(pub Vec<Joint>);

/// Least distance of the shoulders in front and back views, and largest one in side views, as shares of the torso's
/// length (docs/notes/photographs.md, "Joints").
const SHOULDERS: [f32; 2] = [0.5, 0.25];
/// Least angle of the torso to the vertical of somebody who does not stand, in degrees.
const LEANING: f32 = 45.0;
/// Largest drop from hip to knee of somebody who sits, as a share of the torso's length.
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
/// torso's length (perspective moves feet); and joints at the limb's end.
type Limb = (Part, [(usize, f32); 2], [usize; 2]);
const LIMBS: [Limb; 4] = [
    (Part::LeftArm, [(13, 0.5), (15, 0.7)], [15, 19]),
    (Part::RightArm, [(14, 0.5), (16, 0.7)], [16, 20]),
    (Part::LeftLeg, [(25, 0.6), (27, 1.0)], [29, 31]),
    (Part::RightLeg, [(26, 0.6), (28, 1.0)], [30, 32]),
];

impl Joints {
    fn at(&self, joint: usize) -> Vec2 {
        self.0[joint].at
    }

    /// The middles between both shoulders and between both hips.
    fn torso(&self) -> [Vec2; 2] {
        [11, 23].map(|left| 0.5 * (self.at(left) + self.at(left + 1)))
    }

    /// Places all over the torso, away from its outline.
    pub fn on_torso(&self) -> impl Iterator<Item = Vec2> {
        /// Places along an axis.
        const COUNT: usize = 24;
        let [left, right, hip_left, hip_right] = [11, 12, 23, 24].map(|joint| self.at(joint));
        // From a fifth of the way on.
        let share = |i: usize| 0.2 + 0.6 * (i as f32 + 0.5) / COUNT as f32;
        (0..COUNT * COUNT).map(move |i| {
            let across = share(i % COUNT);
            left.lerp(right, across).lerp(hip_left.lerp(hip_right, across), share(i / COUNT))
        })
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
        let limbs = LIMBS.iter().filter(|(.., ends)| ends.iter().any(|end| is_out(self.at(*end))));
        head.chain(limbs.map(|(part, ..)| *part)).collect()
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
            seen > SEEN && place(self, *joint).distance(behind) > *most
        };
        LIMBS.iter().filter(|(_, joints, _)| joints.iter().any(is_moved)).map(|(part, ..)| *part).collect()
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
}
