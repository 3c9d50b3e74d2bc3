//! The skeleton: joints at fixed places beside the landmarks, and the bones between them.

use std::ops::RangeInclusive;

use glam::{Affine3A, Mat3, Quat, Vec3};
use snapsnap_mesh::export::Joint;
use snapsnap_mesh::import;

use crate::body::Body;
use crate::landmarks::Landmark;
use crate::weights::Source;

/// A joint or an end of a limb: its name, its parent, the landmarks whose mean it starts from, the landmarks between which
/// the limb leads, and its distance from the mean: left, up and forwards along the trunk, and along the limb, in lengths
/// of the trunk. Distances are fits to 60 people of MakeHuman's data (docs/method.md, "Skeletons").
type Row = (&'static str, &'static str, &'static [usize], Option<[usize; 2]>, [f32; 4]);
const TRUNK: [Row; 6] = [
    ("Hips", "", &[23, 24], None, [0.0, 0.06, -0.1, 0.0]),
    ("Spine", "Hips", &[23, 24], None, [0.0, 0.23, -0.1, 0.0]),
    ("Spine1", "Spine", &[23, 24], None, [0.0, 0.36, -0.07, 0.0]),
    ("Spine2", "Spine1", &[11, 12], None, [0.0, -0.22, -0.08, 0.0]),
    ("Neck", "Spine2", &[11, 12], None, [0.0, 0.12, -0.02, 0.0]),
    ("Head", "Neck", &[7, 8], None, [0.0, -0.03, -0.06, 0.0]),
];
/// Those of the left side. Landmarks of the right side have the next number.
const LIMBS: [Row; 8] = [
    ("Shoulder", "Spine2", &[11, 12], None, [0.045, -0.02, 0.01, 0.0]),
    ("Arm", "Shoulder", &[11], None, [-0.02, -0.07, 0.0, 0.0]),
    ("ForeArm", "Arm", &[13], Some([11, 13]), [0.01, -0.015, 0.005, -0.02]),
    ("Hand", "ForeArm", &[15], Some([13, 15]), [0.01, 0.04, 0.01, -0.01]),
    ("UpLeg", "Hips", &[23], Some([23, 25]), [0.01, 0.01, -0.035, -0.045]),
    ("Leg", "UpLeg", &[25], Some([23, 25]), [0.01, -0.01, 0.01, -0.03]),
    ("Foot", "Leg", &[27], Some([25, 27]), [0.0, 0.08, 0.02, 0.13]),
    ("ToeBase", "Foot", &[31], Some([27, 31]), [0.01, -0.05, 0.08, -0.12]),
];
/// Ends of limbs without a further joint, of the left side.
const ENDS: [Row; 2] = [
    ("", "Hand", &[17, 19], Some([13, 15]), [-0.03, 0.06, 0.03, 0.11]),
    ("", "ToeBase", &[31], Some([27, 31]), [0.01, -0.04, 0.11, -0.08]),
];
/// What precedes the names in Mixamo's files. Blender and Unity know them with it.
const PREFIX: &str = "mixamorig:";
/// Length of the skull above its joint, in lengths of the trunk.
const SKULL: f32 = 0.4;
/// Least certainty of a landmark whose limb moves.
const SURE: f32 = 0.2;
/// Distances of the skin from the bone of a leg, in lengths of the trunk. What is farther away is cloth.
const THIGH: f32 = 0.24;
const CALF: f32 = 0.2;

/// Parts of limbs: rows of [`LIMBS`] at both ends and of the last joint, and the limb's largest radius at the far end, in
/// lengths of the trunk.
const PARTS: [(usize, usize, usize, f32); 4] =
    [(1, 2, 3, 0.16), (2, 3, 3, 0.12), (4, 5, 7, 0.2), (5, 6, 7, 0.16)];

/// A bone of a person.
#[derive(Debug, Clone)]
pub struct Bone {
    /// Name, as Mixamo's.
    pub name: String,
    /// Row of the parent, which precedes the bone.
    pub parent: Option<usize>,
    /// Joint and far end, metres in the world of the Gaussians.
    pub ends: [Vec3; 2],
    /// Whether its joint was seen; otherwise the bone moves with its parent alone.
    pub is_sure: bool,
}

impl Bone {
    /// The name without Mixamo's prefix.
    pub fn short(&self) -> &str {
        self.name.trim_start_matches(PREFIX)
    }
}

/// The bones of a person with these landmarks. Elbows, wrists, knees and ankles go to the middle of the limb, if the body
/// has one there, and limbs of both sides get the mean of their lengths, weighted by certainty.
pub fn bones(landmarks: &[Landmark], body: &Body) -> Vec<Bone> {
    let at = |row: usize| landmarks[row].at;
    let middle = |rows: &[usize]| rows.iter().map(|row| at(*row)).sum::<Vec3>() / rows.len() as f32;
    let (shoulders, hips) = (middle(&[11, 12]), middle(&[23, 24]));
    let up = (shoulders - hips).normalize_or(Vec3::Y);
    let left = (at(11) - at(12) + at(23) - at(24)).reject_from_normalized(up).normalize_or(Vec3::X);
    let frame = shoulders.distance(hips) * Mat3::from_cols(left, up, left.cross(up));
    let place = |(_, _, from, way, [x, y, z, along]): &Row, side: usize| {
        let row = |row: &usize| if from.len() == 2 && way.is_none() { *row } else { row + side };
        let from: Vec<usize> = from.iter().map(row).collect();
        let way = way.map_or(Vec3::ZERO, |[a, b]| (at(b + side) - at(a + side)).normalize_or_zero());
        let across = if side == 0 { *x } else { -x };
        middle(&from) + frame * Vec3::new(across, *y, *z) + shoulders.distance(hips) * *along * way
    };
    let is_sure =
        |(_, _, from, ..): &Row, side: usize| from.iter().all(|row| landmarks[row + side].sure >= SURE);

    let mut bones: Vec<Bone> = Vec::new();
    let mut add = |row: &Row, side: usize, word: &str| {
        let is_limb = |name: &str| LIMBS.iter().any(|row| row.0 == name);
        let parent = format!("{PREFIX}{}{}", if is_limb(row.1) { word } else { "" }, row.1);
        let parent = bones.iter().position(|bone| bone.name == parent);
        let start = place(row, side);
        // Shoulders and trunk are always seen well enough.
        let is_sure = row.3.is_none() || is_sure(row, side);
        bones.push(Bone { name: format!("{PREFIX}{word}{}", row.0), parent, ends: [start; 2], is_sure });
    };
    TRUNK.iter().for_each(|row| add(row, 0, ""));
    for (side, word) in ["Left", "Right"].into_iter().enumerate() {
        LIMBS.iter().for_each(|row| add(row, side, word));
    }
    let mut moved = vec![Vec3::ZERO; bones.len()];
    let mut shift = |bones: &mut [Bone], rows: RangeInclusive<usize>, step: Vec3| {
        for row in rows {
            bones[row].ends[0] += step;
            moved[row] += step;
        }
    };
    for (start, end, last, radius) in PARTS {
        let ways = [0, 1].map(|side| {
            let row = |row: usize| TRUNK.len() + side * LIMBS.len() + row;
            let place = bones[row(end)].ends[0];
            let along = (place - bones[row(start)].ends[0]).normalize_or(Vec3::NEG_Y);
            let middle = body.middle(place, along, radius * shoulders.distance(hips)).unwrap_or(place);
            shift(&mut bones, row(end)..=row(last), middle - place);
            (middle - bones[row(start)].ends[0], landmarks[LIMBS[end].2[0] + side].sure)
        });
        let [left, right] = ways.map(|(way, _)| way.length().max(1e-6));
        let share = ways[0].1 / (ways[0].1 + ways[1].1).max(1e-6);
        let length = right + share * (left - right);
        for (side, own) in [left, right].into_iter().enumerate() {
            let first = TRUNK.len() + side * LIMBS.len();
            shift(&mut bones, first + end..=first + last, (length / own - 1.0) * ways[side].0);
        }
    }
    // A bone ends at the first of the bones that it bears.
    for row in (1..bones.len()).rev() {
        let (start, parent) = (bones[row].ends[0], bones[row].parent.expect("only the hips have none"));
        bones[parent].ends[1] = start;
        bones[row].is_sure &= bones[parent].is_sure;
    }
    for (row, side) in ENDS.iter().flat_map(|row| [(row, 0), (row, 1)]) {
        let name = format!("{PREFIX}{}{}", ["Left", "Right"][side], row.1);
        let bone = bones.iter().position(|bone| bone.name == name).expect("a limb of this name");
        bones[bone].ends[1] = place(row, side) + moved[bone];
    }
    bones[5].ends[1] = bones[5].ends[0] + SKULL * frame.y_axis;
    bones
}

/// The bones as nodes of a file without rotations.
pub fn nodes(bones: &[Bone]) -> Vec<import::Bone> {
    let node = |Bone { name, parent, ends, .. }: &Bone| import::Bone {
        name: name.clone(),
        parent: *parent,
        place: ends[0],
    };
    bones.iter().map(node).collect()
}

/// The bones as joints of a skin: y leads along the bone, and z to the front, or upwards in feet.
pub fn joints(bones: &[Bone]) -> Vec<Joint> {
    let joint = |Bone { name, parent, ends: [start, end], .. }: &Bone| {
        let along = (end - start).normalize_or(Vec3::Y);
        let is_foot = name.ends_with("Foot") || name.ends_with("ToeBase");
        let front = if is_foot { Vec3::Y } else { Vec3::Z };
        let left = along.cross(front).normalize_or(Vec3::X);
        let turn = Quat::from_mat3(&Mat3::from_cols(left, along, left.cross(along)));
        Joint { name: name.clone(), parent: *parent, rest: Affine3A::from_rotation_translation(turn, *start) }
    };
    bones.iter().map(joint).collect()
}

/// The bones as sources of heat. Bones that were not seen warm what their parents move.
pub fn sources(bones: &[Bone]) -> Vec<Source> {
    let trunk = bones[0].ends[0].distance(bones[4].ends[0]);
    let mover = |mut row: usize| {
        while let (false, Some(parent)) = (bones[row].is_sure, bones[row].parent) {
            row = parent;
        }
        row
    };
    let source = |(row, Bone { name, ends, .. }): (usize, &Bone)| {
        let is = |word: &str| name.ends_with(word);
        let skin = if is("UpLeg") { Some(THIGH) } else { is("Leg").then_some(CALF) };
        Source { bone: mover(row), ends: *ends, cloth: skin.map(|skin| (skin * trunk, 0)) }
    };
    let mut sources: Vec<Source> = bones.iter().enumerate().map(source).collect();
    // The hips reach to both legs.
    for bone in bones.iter().filter(|bone| bone.name.ends_with("UpLeg")) {
        let end = bones[0].ends[0].lerp(bone.ends[0], 0.6);
        sources.push(Source { bone: 0, ends: [bones[0].ends[0], end], cloth: None });
    }
    sources
}
