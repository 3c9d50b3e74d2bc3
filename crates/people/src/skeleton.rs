//! Names of joints in files, bones of any rig and their transforms in a pose, and hands that sink into the body.

use glam::{Affine3A, Mat3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use crate::figure::{Bone as Limb, Figure, Pose, sign};
use crate::math::{rotate_x, rotate_y, rotate_z};

/// Known joints, from the hips to the ends of the limbs. [`need`] names them as Mixamo does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Name {
    Hips,
    Spine,
    Neck,
    Head,
    Clavicle,
    Shoulder,
    Arm,
    ForeArm,
    Hand,
    /// A joint of the index, middle, ring or small finger, 2 to 5.
    Finger(u8),
    UpLeg,
    Leg,
    Foot,
    Toe,
}

/// The joint that `name` denotes, and its side, by the conventions of Mixamo (`mixamorig:LeftArm`) and MakeHuman
/// (`upperarm01.L`, `upperarm_l`).
pub fn known(name: &str) -> Option<(Name, usize)> {
    let name = name.rsplit(':').next()?.to_lowercase();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name).trim_start_matches('_');
    let mut sides = [("left", 'l'), ("right", 'r')].into_iter().enumerate();
    let sided = sides.find_map(|(side, (word, letter))| {
        let short = || name.strip_suffix(letter)?.strip_suffix(['.', '_']);
        Some((name.strip_prefix(word).or_else(short)?, side))
    });
    let (base, side) = sided.unwrap_or((name, 0));
    let stem = base.trim_end_matches(|c: char| c.is_ascii_digit() || c == '_' || c == '-');
    let name = match stem {
        "hips" | "pelvis" | "root" => Name::Hips,
        "spine" => Name::Spine,
        "neck" => Name::Neck,
        "head" => Name::Head,
        "clavicle" => Name::Clavicle,
        // MakeHuman's shoulder01 lies between collarbone and arm, Mixamo's is the collarbone.
        "shoulder" if base == "shoulder01" => Name::Shoulder,
        "shoulder" => Name::Clavicle,
        "arm" | "upperarm" => Name::Arm,
        "forearm" | "lowerarm" => Name::ForeArm,
        "hand" | "wrist" => Name::Hand,
        "handindex" | "index" => Name::Finger(2),
        "handmiddle" | "middle" => Name::Finger(3),
        "handring" | "ring" => Name::Finger(4),
        "handpinky" | "pinky" => Name::Finger(5),
        "finger" => Name::Finger(base.strip_prefix("finger")?.bytes().next()?.checked_sub(b'0')?),
        "upleg" | "upperleg" | "thigh" => Name::UpLeg,
        "leg" | "lowerleg" | "calf" => Name::Leg,
        "foot" => Name::Foot,
        "toebase" | "toe" | "ball" => Name::Toe,
        _ => return None,
    };
    Some((name, side)).filter(|(name, _)| !matches!(name, Name::Finger(0 | 1 | 6..)))
}

/// Index of the first joint of this name among the [`known`] joints of a file.
pub fn find(joints: &[Option<(Name, usize)>], name: Name, side: usize) -> Option<usize> {
    joints.iter().position(|joint| *joint == Some((name, side)))
}

/// As [`find`].
///
/// # Errors
/// A sentence that names the missing joint.
pub fn need(joints: &[Option<(Name, usize)>], name: Name, side: usize) -> Result<usize, String> {
    let side_word = match name {
        Name::Hips | Name::Spine | Name::Neck | Name::Head => "",
        _ => ["Left", "Right"][side],
    };
    find(joints, name, side).ok_or_else(|| {
        format!("has no joint `{side_word}{name:?}`: expected the joint names of Mixamo or MakeHuman")
    })
}

/// The part of a pose that a bone follows. Sides are 0 for the left (towards +x) and 1 for the right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Joint {
    /// The trunk, from the pelvis (0) to the shoulders (1).
    Trunk(f32),
    /// Neck and head, from the shoulders (0) to the skull (1).
    Head(f32),
    Clavicle(usize),
    /// The upper arm, after n halvings of the rotation from the parent's.
    UpperArm(usize, u8),
    Forearm(usize),
    /// A joint of a finger except the thumb, with the axis around which it bends towards the palm.
    Finger(Vec3),
    /// The thigh, after n halvings of the rotation from the parent's.
    Thigh(usize, u8),
    Calf(usize),
    Foot(usize),
    /// The parent.
    Parent,
}

/// A bone at rest.
#[derive(Debug, Clone)]
pub struct Bone {
    pub joint: Joint,
    /// Index of the parent, which precedes the bone.
    pub parent: Option<usize>,
    /// Start of the bone.
    pub head: Vec3,
    /// Scale of the points that follow the bone.
    pub scale: Mat3,
}

/// Axes of the limbs at rest, by side, and the lift of the arms.
#[derive(Debug, Clone)]
pub struct Rest {
    pub upper_arms: [Mat3; 2],
    pub forearms: [Mat3; 2],
    pub thighs: [Mat3; 2],
    pub calves: [Mat3; 2],
    pub feet: [Mat3; 2],
    /// Degrees by which the shoulders are raised at rest, as [`Pose::lift`].
    pub lift: f32,
}

impl Rest {
    /// The axes of a figure whose toes point outwards by 9°, as in [`Figure::new`].
    pub fn of(figure: &Figure) -> Self {
        let frames = |limbs: &[Limb; 2]| [limbs[0].frame, limbs[1].frame];
        Self {
            upper_arms: frames(&figure.upper_arms),
            forearms: frames(&figure.forearms),
            thighs: frames(&figure.thighs),
            calves: frames(&figure.calves),
            feet: [0, 1].map(|side| rotate_y(sign(side) * 9.0)),
            lift: 0.0,
        }
    }
}

/// Transform of a bone in a pose.
#[derive(Debug, Clone, Copy)]
pub struct Placed {
    /// Rotation.
    pub turn: Mat3,
    /// Rotation and scale.
    matrix: Mat3,
    /// Start of the bone at rest and in the pose.
    rest: Vec3,
    /// Start of the bone in the pose.
    pub head: Vec3,
}

impl Placed {
    /// The transform of a resting point that follows this bone alone.
    pub fn transform(&self) -> Affine3A {
        Affine3A::from_mat3_translation(self.matrix, self.head - self.matrix * self.rest)
    }

    /// Moves a resting point with this bone alone.
    pub fn apply(&self, p: Vec3) -> Vec3 {
        self.matrix * (p - self.rest) + self.head
    }
}

/// Transforms of all bones in `pose`. `goal` is a figure in the same pose, of which only the axes are used.
pub fn placed(bones: &[Bone], rest: &Rest, pose: &Pose, goal: &Figure) -> Vec<Placed> {
    let turned = |goal: &[Limb; 2], rest: &[Mat3; 2], side: usize| goal[side].frame * rest[side].transpose();
    let mut placed: Vec<Placed> = Vec::with_capacity(bones.len());
    for bone in bones {
        let parent = bone.parent.map(|parent| placed[parent]);
        let parent_turn = parent.map_or(pose.trunk_frame(0.0), |parent| parent.turn);
        let halved = |turn: Mat3, times: u8| (0..times).fold(turn, |turn, _| halfway(parent_turn, turn));
        let turn = match bone.joint {
            Joint::Trunk(share) => pose.trunk_frame(share),
            Joint::Head(share) => pose.head_frame(share),
            // Shoulders rise with raised arms.
            Joint::Clavicle(side) => {
                parent_turn * rotate_z(sign(side) * (pose.lift(side) - rest.lift) * 0.35)
            }
            Joint::UpperArm(side, times) => halved(turned(&goal.upper_arms, &rest.upper_arms, side), times),
            Joint::Forearm(side) => turned(&goal.forearms, &rest.forearms, side),
            Joint::Finger(axis) => parent_turn * around(axis, 0.6 * pose.fingers),
            Joint::Thigh(side, times) => halved(turned(&goal.thighs, &rest.thighs, side), times),
            Joint::Calf(side) => turned(&goal.calves, &rest.calves, side),
            Joint::Foot(side) => turned(&goal.feet, &rest.feet, side),
            Joint::Parent => parent_turn,
        };
        let head = parent.map_or(bone.head, |parent| parent.apply(bone.head));
        placed.push(Placed { turn, matrix: turn * bone.scale, rest: bone.head, head });
    }
    placed
}

/// Rotation by degrees around a unit vector; the identity for axis 0.
fn around(axis: Vec3, degrees: f32) -> Mat3 {
    if axis == Vec3::ZERO {
        return Mat3::IDENTITY;
    }
    let up = axis.any_orthonormal_vector();
    let frame = Mat3::from_cols(axis, up, axis.cross(up));
    frame * rotate_x(degrees) * frame.transpose()
}

/// The rotation between two rotations: their mean, made orthonormal.
fn halfway(a: Mat3, b: Mat3) -> Mat3 {
    let mean = (a + b) * 0.5;
    let x = mean.x_axis.normalize_or(a.x_axis);
    let y = (mean.y_axis - mean.y_axis.dot(x) * x).normalize_or(a.y_axis);
    Mat3::from_cols(x, y, x.cross(y))
}

/// Axes of a limb that hangs along `down` and bends around `hinge`.
pub fn hanging(down: Vec3, hinge: Vec3) -> Mat3 {
    let up = (-down).normalize_or(Vec3::Y);
    let right = (hinge - hinge.dot(up) * up).normalize_or(up.any_orthonormal_vector());
    Mat3::from_cols(right, up, right.cross(up))
}

/// A part of the body for [`sunk_hands`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// Trunk or legs.
    Solid,
    /// A hand, by its side.
    Hand(usize),
    Other,
}

/// Whether the left and the right hand lie inside trunk or legs, or less than `gap` metres outside.
pub fn sunk_hands(places: &[Vec3], normals: &[Vec3], owners: &[Owner], gap: f32) -> [bool; 2] {
    /// Every `STEP`-th vertex of a hand is checked.
    const STEP: usize = 4;
    /// Largest distance of a point inside the body from the nearest skin, metres.
    const REACH: f32 = 0.07;
    let of = |owner: Owner| (0..places.len()).filter(move |row| owners[*row] == owner);
    let solid: Vec<usize> = of(Owner::Solid).collect();
    if solid.is_empty() {
        return [false; 2];
    }
    let tree = tree(solid.iter().map(|row| places[*row]));
    [0, 1].map(|side| {
        let hand = coordinates(of(Owner::Hand(side)).step_by(STEP).map(|row| places[row]));
        let found = tree.query_batch(&hand).nearest_one::<SquaredEuclidean<f32>>().execute();
        hand.iter().zip(&found).any(|(place, found)| {
            let nearest = solid[found.item as usize];
            let out = (Vec3::from(*place) - places[nearest]).dot(normals[nearest]);
            found.distance < REACH * REACH && out < gap
        })
    })
}

/// Points as queries of [`tree`].
pub fn coordinates(points: impl IntoIterator<Item = Vec3>) -> Vec<[f32; 3]> {
    points.into_iter().map(|p| p.to_array()).collect()
}

/// A k-d tree for nearest-neighbour searches.
pub fn tree(points: impl IntoIterator<Item = Vec3>) -> ImmutableKdTree<f32, 3> {
    ImmutableKdTree::new_from_slice(&coordinates(points)).expect("fewer points than u32 can number")
}
