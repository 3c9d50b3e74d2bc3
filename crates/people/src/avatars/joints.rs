//! Joints of a character by their names.

use std::collections::HashMap;

use glam::{Mat3, Quat, Vec3};
use snapsnap_mesh::import;

use crate::math::rotate_y;
use crate::skeleton::{Bone, Joint, Rest, hanging};

/// A part of the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Region {
    Trunk,
    Head,
    Arm,
    /// By its side, 0 for the left and 1 for the right.
    Hand(usize),
    Leg,
    Foot,
}

/// Joints that a character has, in the order from the hips to the ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Name {
    Hips,
    Spine,
    Neck,
    Head,
    Clavicle,
    Shoulder,
    UpperArm,
    Forearm,
    Hand,
    /// A joint of the index, middle, ring or small finger, 2 to 5.
    Finger(u8),
    Thigh,
    Calf,
    Foot,
    Toe,
}

/// What `name` calls, and its side, by the conventions of Mixamo (`mixamorig:LeftArm`) and MakeHuman (`upperarm01.L`,
/// `upperarm_l`).
fn known(name: &str) -> Option<(Name, usize)> {
    let name = name.rsplit(':').next()?.to_lowercase();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name).trim_start_matches('_');
    let side = |name: &str| -> (String, usize) {
        for (side, word, letter) in [(0, "left", 'l'), (1, "right", 'r')] {
            if let Some(rest) = name.strip_prefix(word) {
                return (rest.to_owned(), side);
            }
            if let Some(rest) = name.strip_suffix(letter).and_then(|rest| rest.strip_suffix(['.', '_'])) {
                return (rest.to_owned(), side);
            }
        }
        (name.to_owned(), 0)
    };
    let (base, side) = side(name);
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
        "arm" | "upperarm" => Name::UpperArm,
        "forearm" | "lowerarm" => Name::Forearm,
        "hand" | "wrist" => Name::Hand,
        "handindex" | "index" => Name::Finger(2),
        "handmiddle" | "middle" => Name::Finger(3),
        "handring" | "ring" => Name::Finger(4),
        "handpinky" | "pinky" => Name::Finger(5),
        "finger" => Name::Finger(base.strip_prefix("finger")?.bytes().next()?.checked_sub(b'0')?),
        "upleg" | "upperleg" | "thigh" => Name::Thigh,
        "leg" | "lowerleg" | "calf" => Name::Calf,
        "foot" => Name::Foot,
        "toebase" | "toe" | "ball" => Name::Toe,
        _ => return None,
    };
    Some((name, side)).filter(|(name, _)| !matches!(name, Name::Finger(0 | 1 | 6..)))
}

/// Row of the first joint of this name.
fn find(bones: &[import::Bone], name: Name, side: usize) -> Option<usize> {
    let is_it = |bone: &import::Bone| known(&bone.name) == Some((name, side));
    bones.iter().position(is_it)
}

/// As [`find`].
///
/// # Errors
/// A sentence that names the missing joint.
fn need(bones: &[import::Bone], name: Name, side: usize) -> Result<usize, String> {
    let word = match name {
        Name::Hips => "Hips".to_owned(),
        Name::Spine => "Spine".to_owned(),
        Name::Head => "Head".to_owned(),
        _ => {
            let side = if side == 0 { "Left" } else { "Right" };
            let word = match name {
                Name::UpperArm => "Arm",
                Name::Forearm => "ForeArm",
                Name::Hand => "Hand",
                Name::Thigh => "UpLeg",
                Name::Calf => "Leg",
                _ => "Foot",
            };
            format!("{side}{word}")
        }
    };
    find(bones, name, side)
        .ok_or_else(|| format!("has no joint `{word}`: expected the joint names of Mixamo or MakeHuman"))
}

/// Degrees around y by which the character's front is turned from +z.
///
/// # Errors
/// A missing joint.
pub fn facing(bones: &[import::Bone]) -> Result<f32, String> {
    let [left, right] =
        [need(bones, Name::Thigh, 0)?, need(bones, Name::Thigh, 1)?].map(|row| bones[row].place);
    let front = (left - right).cross(Vec3::Y);
    Ok(libm::atan2f(front.x, front.z).to_degrees())
}

/// A character's bones.
pub struct Skeleton {
    /// Bones below the hips.
    pub bones: Vec<Bone>,
    pub rest: Rest,
    /// By bone: its part of the body, and its direction at rest.
    pub regions: Vec<Region>,
    pub axes: Vec<Vec3>,
    /// Row in `bones` of each node of the file.
    pub rows: Vec<Option<usize>>,
}

impl Skeleton {
    /// The skeleton of a character that faces +z.
    ///
    /// # Errors
    /// A sentence that names a missing joint.
    pub fn new(nodes: &[import::Bone]) -> Result<Self, String> {
        let hips = need(nodes, Name::Hips, 0)?;
        need(nodes, Name::Spine, 0)?;
        need(nodes, Name::Head, 0)?;
        let place = |row: usize| nodes[row].place;
        let [mut upper_arms, mut forearms, mut thighs, mut calves, mut feet] = [[Mat3::IDENTITY; 2]; 5];
        let mut palms = [Vec3::ZERO; 2];
        let mut lift = 0.0_f32;
        for side in [0, 1] {
            let joint = |name| need(nodes, name, side).map(place);
            let [shoulder, elbow, wrist] =
                [joint(Name::UpperArm)?, joint(Name::Forearm)?, joint(Name::Hand)?];
            let [hip, knee, ankle] = [joint(Name::Thigh)?, joint(Name::Calf)?, joint(Name::Foot)?];
            let down = (elbow - shoulder).normalize_or(Vec3::NEG_Y);
            // An arm that was raised from its side without a twist.
            let hinge = Quat::from_rotation_arc(Vec3::NEG_Y, down) * Vec3::X;
            upper_arms[side] = hanging(down, hinge);
            forearms[side] = hanging(wrist - elbow, hinge);
            thighs[side] = hanging(knee - hip, Vec3::X);
            calves[side] = hanging(ankle - knee, Vec3::X);
            let toes = find(nodes, Name::Toe, side).map_or(Vec3::Z, |row| place(row) - ankle);
            feet[side] = rotate_y(libm::atan2f(toes.x, toes.z).to_degrees());
            lift += 0.5 * (libm::acosf((-down.y).clamp(-1.0, 1.0)).to_degrees() - 35.0).max(0.0);
            let fingers = [2, 5].map(|finger| find(nodes, Name::Finger(finger), side));
            if let [Some(index), Some(small)] = fingers {
                // Fingers bend towards the palm around this axis.
                let across = (place(small) - place(index)).normalize_or_zero();
                palms[side] = if side == 0 { across } else { -across };
            }
        }
        let mut skeleton = Self {
            bones: Vec::new(),
            rest: Rest { upper_arms, forearms, thighs, calves, feet, lift },
            regions: Vec::new(),
            axes: Vec::new(),
            rows: vec![None; nodes.len()],
        };
        let names: Vec<Option<(Name, usize)>> = nodes.iter().map(|node| known(&node.name)).collect();
        let count = |known: (Name, usize)| names.iter().filter(|name| **name == Some(known)).count();
        // Joints of a limb's or the spine's name that are still to come.
        let chains = [(Name::UpperArm, 0), (Name::UpperArm, 1), (Name::Thigh, 0), (Name::Thigh, 1)];
        let mut left: HashMap<(Name, usize), usize> =
            chains.into_iter().map(|name| (name, count(name))).collect();
        let (spines, mut spine) = (count((Name::Spine, 0)), 0);
        // The first known child of each node.
        let mut children: Vec<Option<usize>> = vec![None; nodes.len()];
        for (row, node) in nodes.iter().enumerate().rev().filter(|(row, _)| names[*row].is_some()) {
            if let Some(parent) = node.parent {
                children[parent] = Some(row);
            }
        }
        for (row, node) in nodes.iter().enumerate() {
            let parent = node.parent.and_then(|parent| skeleton.rows[parent]);
            if row != hips && parent.is_none() {
                continue;
            }
            let above = parent.map_or(Region::Trunk, |row| skeleton.regions[row]);
            // The last joint of a limb's name takes the limb's whole turn, those before it a half of the rest each.
            let mut after = |name: Name, side: usize| {
                let left = left.entry((name, side)).or_default();
                *left = left.saturating_sub(1);
                u8::try_from(*left).unwrap_or(u8::MAX)
            };
            let (joint, region) = match names[row] {
                _ if row == hips => (Joint::Trunk(0.0), Region::Trunk),
                Some((Name::Spine, _)) => {
                    spine += 1;
                    (Joint::Trunk(spine as f32 / spines as f32), Region::Trunk)
                }
                Some((Name::Neck, _)) => (Joint::Head(0.5), Region::Head),
                Some((Name::Head, _)) => (Joint::Head(1.0), Region::Head),
                Some((Name::Clavicle, side)) => (Joint::Clavicle(side), Region::Trunk),
                Some((Name::Shoulder, side)) => (Joint::UpperArm(side, 2), Region::Trunk),
                Some((Name::UpperArm, side)) => {
                    (Joint::UpperArm(side, after(Name::UpperArm, side)), Region::Arm)
                }
                Some((Name::Forearm, side)) => (Joint::Forearm(side), Region::Arm),
                Some((Name::Hand, side)) => (Joint::Parent, Region::Hand(side)),
                Some((Name::Finger(_), side)) => (Joint::Finger(palms[side]), Region::Hand(side)),
                Some((Name::Thigh, side)) => (Joint::Thigh(side, after(Name::Thigh, side)), Region::Leg),
                Some((Name::Calf, side)) => (Joint::Calf(side), Region::Leg),
                Some((Name::Foot, side)) => (Joint::Foot(side), Region::Foot),
                _ => (Joint::Parent, above),
            };
            let axis = children[row].map_or(Vec3::Y, |child| place(child) - node.place).normalize_or(Vec3::Y);
            skeleton.rows[row] = Some(skeleton.bones.len());
            skeleton.bones.push(Bone { joint, parent, head: node.place, scale: Mat3::IDENTITY });
            skeleton.regions.push(region);
            skeleton.axes.push(axis);
        }
        Ok(skeleton)
    }
}
