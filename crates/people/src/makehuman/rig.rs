//! Bones of a morphed body, the body in another pose (linear blend skinning), and hands that sink into it.

use glam::{Mat3, Vec3};
use kiddo::SquaredEuclidean;

use super::ORDER;
use super::files::Library;
use super::net::{Net, coordinates, tree};
use crate::math::{bounds, rotate_x, rotate_y, rotate_z};
use crate::synth::figure::{Bone, Build, Figure, Pose, sign};
use crate::synth::part::Kind;

/// Joints of a morphed body in the pose of the base mesh.
pub struct Joints<'a> {
    library: &'a Library,
    heads: Vec<Vec3>,
    tails: Vec<Vec3>,
}

impl<'a> Joints<'a> {
    pub fn of(library: &'a Library, positions: &[Vec3]) -> Self {
        let mean = |rows: &Vec<u32>| {
            rows.iter().map(|row| positions[*row as usize]).sum::<Vec3>() / rows.len() as f32
        };
        let heads = library.bones.iter().map(|bone| mean(&bone.head)).collect();
        let tails = library.bones.iter().map(|bone| mean(&bone.tail)).collect();
        Self { library, heads, tails }
    }

    fn row(&self, name: &str) -> Option<usize> {
        self.library.bones.iter().position(|bone| bone.name == name)
    }

    /// Start of a bone; the origin if the rig has no such bone.
    pub fn head(&self, name: &str) -> Vec3 {
        self.row(name).map_or(Vec3::ZERO, |row| self.heads[row])
    }

    fn tail(&self, name: &str) -> Vec3 {
        self.row(name).map_or(Vec3::ZERO, |row| self.tails[row])
    }

    /// The box around the joints of the lips.
    pub fn mouth(&self) -> (Vec3, Vec3) {
        let lips =
            self.library.bones.iter().zip(&self.heads).filter(|(bone, _)| bone.name.starts_with("oris"));
        bounds(lips.map(|(_, head)| *head))
    }

    /// The figure of the body. `crown` is the height of the top of the head. `middle` returns z halfway between belly and
    /// back at a height, since the spine lies close to the back.
    pub fn figure(&self, build: Build, crown: f32, middle: impl Fn(f32) -> f32) -> Figure {
        let sides = [0, 1];
        let hips = sides.map(|side| self.head(&sided("upperleg01", side)));
        let inside = |joint: Vec3, share: f32| {
            Vec3::new(joint.x, joint.y, joint.z + share * (middle(joint.y) - joint.z))
        };
        let crotch = inside((hips[0] + hips[1]) / 2.0, 1.0);
        let waist = inside((self.head("spine03") + self.tail("spine03")) / 2.0, 1.0);
        let base = inside(self.head("neck01"), 0.5);
        let skull = self.head("head");
        let chin = Vec3::new(skull.x, self.tail("jaw").y, skull.z);
        let limb = |first: &str, last: &str, side: usize, hinge: Vec3| {
            let (start, end) = (self.head(&sided(first, side)), self.head(&sided(last, side)));
            Bone { start, end, frame: hanging(end - start, hinge) }
        };
        let hinges = sides.map(|side| {
            let [a, b, c] = ["upperarm01", "lowerarm01", "wrist"].map(|name| self.head(&sided(name, side)));
            // The axis of the elbow, from its bend in the base mesh.
            -(b - a).cross(c - b)
        });
        Figure {
            fingers: 0.0,
            pelvis: Bone::straight(crotch, waist),
            chest: Bone::straight(waist, base),
            neck: Bone::straight(base, chin),
            head: Bone::straight(chin, Vec3::new(chin.x, crown, chin.z)),
            upper_arms: sides.map(|side| limb("upperarm01", "lowerarm01", side, hinges[side])),
            forearms: sides.map(|side| limb("lowerarm01", "wrist", side, hinges[side])),
            hands: sides.map(|side| {
                let (start, end) = (self.head(&sided("wrist", side)), self.tail(&sided("finger3-3", side)));
                Bone { start, end, frame: hanging(end - start, hinges[side]) }
            }),
            thighs: sides.map(|side| limb("upperleg01", "lowerleg01", side, Vec3::X)),
            calves: sides.map(|side| limb("lowerleg01", "foot", side, Vec3::X)),
            feet: sides.map(|side| {
                let start = self.head(&sided("foot", side));
                Bone::straight(start, start - 0.039 * build.stature * Vec3::Y)
            }),
            build,
        }
    }

    /// `positions` in `pose`, and the rotation and translation of the head. `rest` is the figure of the resting body.
    pub fn pose(&self, positions: &[Vec3], rest: &Figure, pose: &Pose) -> (Vec<Vec3>, (Mat3, Vec3)) {
        let bones = &self.library.bones;
        let goal = Figure::new(rest.build.clone(), pose);
        let turned = |goal: &Bone, rest: &Bone| goal.frame * rest.frame.transpose();
        let mut turns: Vec<Mat3> = Vec::with_capacity(bones.len());
        let mut heads: Vec<Vec3> = Vec::with_capacity(bones.len());
        for (row, bone) in bones.iter().enumerate() {
            let (parent_turn, parent_head, parent_rest) =
                bone.parent.map_or((pose.trunk_frame(0.0), self.heads[row], self.heads[row]), |parent| {
                    (turns[parent], heads[parent], self.heads[parent])
                });
            let (name, side) = match bone.name.rsplit_once('.') {
                Some((name, "L")) => (name, 0),
                Some((name, _)) => (name, 1),
                None => (bone.name.as_str(), 0),
            };
            let half = |turn: Mat3| halfway(parent_turn, turn);
            let turn = match name {
                "root" | "pelvis" => pose.trunk_frame(0.0),
                "spine05" => pose.trunk_frame(0.15),
                "spine04" => pose.trunk_frame(0.35),
                "spine03" => pose.trunk_frame(0.6),
                "spine02" => pose.trunk_frame(0.85),
                "spine01" => pose.trunk_frame(1.0),
                "neck01" => pose.head_frame(0.25),
                "neck02" => pose.head_frame(0.5),
                "neck03" => pose.head_frame(0.75),
                "head" => pose.head_frame(1.0),
                // Shoulders rise with raised arms.
                "clavicle" => parent_turn * rotate_z(sign(side) * pose.lift(side) * 0.35),
                "shoulder01" => half(half(turned(&goal.upper_arms[side], &rest.upper_arms[side]))),
                "upperarm01" => half(turned(&goal.upper_arms[side], &rest.upper_arms[side])),
                "upperarm02" => turned(&goal.upper_arms[side], &rest.upper_arms[side]),
                "lowerarm01" | "lowerarm02" => turned(&goal.forearms[side], &rest.forearms[side]),
                "upperleg01" => half(turned(&goal.thighs[side], &rest.thighs[side])),
                "upperleg02" => turned(&goal.thighs[side], &rest.thighs[side]),
                "lowerleg01" | "lowerleg02" => turned(&goal.calves[side], &rest.calves[side]),
                // The toes of the base mesh point a little outwards.
                "foot" => goal.feet[side].frame * rotate_y(-sign(side) * 9.0),
                _ if name.starts_with("finger") && !name.starts_with("finger1") => {
                    parent_turn * self.curl(name, side, pose.fingers)
                }
                _ => parent_turn,
            };
            heads.push(parent_head + parent_turn * (self.heads[row] - parent_rest));
            turns.push(turn);
        }
        let moved = |row: usize| {
            let p = positions[row];
            let at = |bone: usize| turns[bone] * (p - self.heads[bone]) + heads[bone];
            self.library.weights[row].iter().map(|(bone, share)| *share * at(*bone as usize)).sum()
        };
        let head = self.row("head").unwrap_or(0);
        let shift = heads[head] - turns[head] * self.heads[head];
        ((0..positions.len()).map(moved).collect(), (turns[head], shift))
    }

    /// Rotation of a finger's joint towards the palm, around the axis of its bend in the base mesh.
    fn curl(&self, name: &str, side: usize, degrees: f32) -> Mat3 {
        let finger = name.split('-').next().unwrap_or(name);
        let [a, b, c] = ["1", "2", "3"].map(|joint| self.head(&sided(&format!("{finger}-{joint}"), side)));
        let axis = (b - a).cross(c - b).normalize_or_zero();
        around(axis, 0.6 * degrees)
    }
}

/// A bone's name on one side.
fn sided(name: &str, side: usize) -> String {
    format!("{name}.{}", if side == 0 { 'L' } else { 'R' })
}

/// Axes of a limb that hangs along `down` and bends around `hinge`.
fn hanging(down: Vec3, hinge: Vec3) -> Mat3 {
    let up = -down.normalize_or_zero();
    let right = (hinge - hinge.dot(up) * up).normalize_or(up.any_orthonormal_vector());
    Mat3::from_cols(right, up, right.cross(up))
}

/// A rotation around an axis of length 1; the identity for axis 0.
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

/// Whether the left and the right hand of `body` lie in trunk or legs, or nearer to them than `gap` metres.
pub fn sunk_hands(body: &Net, gap: f32) -> [bool; 2] {
    /// One in so many vertices of a hand is checked.
    const STEP: usize = 4;
    /// Largest distance of a place inside the body from the nearest skin, metres.
    const REACH: f32 = 0.07;
    let normals = body.normals();
    let owner = |row: &usize| ORDER[body.vertices[*row].part()];
    let rows = 0..body.vertices.len();
    let solid: Vec<usize> =
        rows.clone().filter(|row| matches!(owner(row).0, Kind::Trunk | Kind::Leg)).collect();
    if solid.is_empty() {
        return [false; 2];
    }
    let tree = tree(solid.iter().map(|row| body.vertices[*row].posed));
    [0, 1].map(|side| {
        let hand = rows.clone().filter(|row| owner(row) == (Kind::Hand, side)).step_by(STEP);
        let places = coordinates(hand.map(|row| body.vertices[row].posed));
        let found = tree.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
        places.iter().zip(&found).any(|(place, found)| {
            let nearest = solid[found.item as usize];
            let out = (Vec3::from(*place) - body.vertices[nearest].posed).dot(normals[nearest]);
            found.distance < REACH * REACH && out < gap
        })
    })
}
