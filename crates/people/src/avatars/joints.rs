//! The skeleton of a character.

use std::collections::HashMap;

use glam::{Mat3, Quat, Vec3};
use snapsnap_mesh::import;

use crate::math::rotate_y;
use crate::skeleton::{Bone, Joint, Name, Rest, find, hanging, known, need};

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

/// Degrees around y by which the character's front is turned from +z.
///
/// # Errors
/// A missing joint.
pub fn facing(bones: &[import::Bone]) -> Result<f32, String> {
    let names: Vec<Option<(Name, usize)>> = bones.iter().map(|bone| known(&bone.name)).collect();
    let [left, right] =
        [need(&names, Name::UpLeg, 0)?, need(&names, Name::UpLeg, 1)?].map(|row| bones[row].place);
    let front = (left - right).cross(Vec3::Y);
    Ok(libm::atan2f(front.x, front.z).to_degrees())
}

/// A character's bones.
pub struct Skeleton {
    /// The hips and all bones below them.
    pub bones: Vec<Bone>,
    pub rest: Rest,
    /// By bone: part of the body, and direction at rest.
    pub regions: Vec<Region>,
    pub axes: Vec<Vec3>,
    /// Index in `bones` of each node of the file.
    pub rows: Vec<Option<usize>>,
}

impl Skeleton {
    /// The skeleton of a character that faces +z.
    ///
    /// # Errors
    /// A sentence that names a missing joint.
    pub fn new(nodes: &[import::Bone]) -> Result<Self, String> {
        let names: Vec<Option<(Name, usize)>> = nodes.iter().map(|node| known(&node.name)).collect();
        let hips = need(&names, Name::Hips, 0)?;
        need(&names, Name::Spine, 0)?;
        need(&names, Name::Head, 0)?;
        let place = |row: usize| nodes[row].place;
        let [mut upper_arms, mut forearms, mut thighs, mut calves, mut feet] = [[Mat3::IDENTITY; 2]; 5];
        let mut palms = [Vec3::ZERO; 2];
        let mut lift = 0.0_f32;
        for side in [0, 1] {
            let joint = |name| need(&names, name, side).map(place);
            let [shoulder, elbow, wrist] = [joint(Name::Arm)?, joint(Name::ForeArm)?, joint(Name::Hand)?];
            let [hip, knee, ankle] = [joint(Name::UpLeg)?, joint(Name::Leg)?, joint(Name::Foot)?];
            let down = (elbow - shoulder).normalize_or(Vec3::NEG_Y);
            // Assumes that the arm was raised from its side without a twist.
            let hinge = Quat::from_rotation_arc(Vec3::NEG_Y, down) * Vec3::X;
            upper_arms[side] = hanging(down, hinge);
            forearms[side] = hanging(wrist - elbow, hinge);
            thighs[side] = hanging(knee - hip, Vec3::X);
            calves[side] = hanging(ankle - knee, Vec3::X);
            let toes = find(&names, Name::Toe, side).map_or(Vec3::Z, |row| place(row) - ankle);
            feet[side] = rotate_y(libm::atan2f(toes.x, toes.z).to_degrees());
            lift += 0.5 * (libm::acosf((-down.y).clamp(-1.0, 1.0)).to_degrees() - 35.0).max(0.0);
            let fingers = [2, 5].map(|finger| find(&names, Name::Finger(finger), side));
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
        let count = |known: (Name, usize)| names.iter().filter(|name| **name == Some(known)).count();
        // By chain: the number of joints that are still to come.
        let chains = [(Name::Arm, 0), (Name::Arm, 1), (Name::UpLeg, 0), (Name::UpLeg, 1)];
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
            // The last joint of a chain has the limb's rotation. A joint before n others goes 1/2ⁿ of the way to it.
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
                Some((Name::Arm, side)) => (Joint::UpperArm(side, after(Name::Arm, side)), Region::Arm),
                Some((Name::ForeArm, side)) => (Joint::Forearm(side), Region::Arm),
                Some((Name::Hand, side)) => (Joint::Parent, Region::Hand(side)),
                Some((Name::Finger(_), side)) => (Joint::Finger(palms[side]), Region::Hand(side)),
                Some((Name::UpLeg, side)) => (Joint::Thigh(side, after(Name::UpLeg, side)), Region::Leg),
                Some((Name::Leg, side)) => (Joint::Calf(side), Region::Leg),
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
