//! Bones of a morphed body, and the body in another pose (linear blend skinning).

use glam::{Mat3, Vec3};
use snapsnap_mesh::mesh::bounds;

use super::files::Library;
use super::patch::{ORDER, Patch};
use crate::figure::{Bone, Build, Figure, Pose};
use crate::skeleton::{self, Joint, Owner, Placed, Rest, hanging};
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

    pub fn row(&self, name: &str) -> Option<usize> {
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

    /// The figure of the body. `crown` is the height of the top of the head. `middle` returns z halfway between belly
    /// and back at a height, since the spine lies close to the back.
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

    /// `positions` in `pose`, and the transforms of the bones. `rest` is the figure of the resting body.
    pub fn pose(&self, positions: &[Vec3], rest: &Figure, pose: &Pose) -> (Vec<Vec3>, Vec<Placed>) {
        let bones = self.library.bones.iter().enumerate().map(|(row, bone)| skeleton::Bone {
            joint: self.joint(&bone.name),
            parent: bone.parent,
            head: self.heads[row],
            scale: Mat3::IDENTITY,
        });
        let bones: Vec<skeleton::Bone> = bones.collect();
        let goal = Figure::new(rest.build.clone(), pose);
        let placed = skeleton::placed(&bones, &Rest::of(rest), pose, &goal);
        let moved = |row: usize| {
            let weights = self.library.weights[row].iter();
            weights.map(|(bone, share)| *share * placed[*bone as usize].apply(positions[row])).sum()
        };
        ((0..positions.len()).map(moved).collect(), placed)
    }

    /// The part of a pose that a bone of the default rig follows.
    fn joint(&self, bone: &str) -> Joint {
        let (name, side) = match bone.rsplit_once('.') {
            Some((name, "L")) => (name, 0),
            Some((name, _)) => (name, 1),
            None => (bone, 0),
        };
        match name {
            "root" | "pelvis" => Joint::Trunk(0.0),
            "spine05" => Joint::Trunk(0.15),
            "spine04" => Joint::Trunk(0.35),
            "spine03" => Joint::Trunk(0.6),
            "spine02" => Joint::Trunk(0.85),
            "spine01" => Joint::Trunk(1.0),
            "neck01" => Joint::Head(0.25),
            "neck02" => Joint::Head(0.5),
            "neck03" => Joint::Head(0.75),
            "head" => Joint::Head(1.0),
            "clavicle" => Joint::Clavicle(side),
            "shoulder01" => Joint::UpperArm(side, 2),
            "upperarm01" => Joint::UpperArm(side, 1),
            "upperarm02" => Joint::UpperArm(side, 0),
            "lowerarm01" | "lowerarm02" => Joint::Forearm(side),
            "upperleg01" => Joint::Thigh(side, 1),
            "upperleg02" => Joint::Thigh(side, 0),
            "lowerleg01" | "lowerleg02" => Joint::Calf(side),
            "foot" => Joint::Foot(side),
            _ if name.starts_with("finger") && !name.starts_with("finger1") => {
                Joint::Finger(self.bend(name, side))
            }
            _ => Joint::Parent,
        }
    }

    /// The axis of a finger's bend towards the palm, from its bend in the base mesh.
    fn bend(&self, name: &str, side: usize) -> Vec3 {
        let finger = name.split('-').next().unwrap_or(name);
        let [a, b, c] = ["1", "2", "3"].map(|joint| self.head(&sided(&format!("{finger}-{joint}"), side)));
        (b - a).cross(c - b).normalize_or_zero()
    }
}

fn sided(name: &str, side: usize) -> String {
    format!("{name}.{}", if side == 0 { 'L' } else { 'R' })
}

/// Whether the left and the right hand of `body` lie inside trunk or legs, or less than `gap` metres outside.
pub fn sunk_hands(body: &Patch, gap: f32) -> [bool; 2] {
    let owners = body.vertices.iter().map(|vertex| match ORDER[vertex.part()] {
        (Kind::Trunk | Kind::Leg, _) => Owner::Solid,
        (Kind::Hand, side) => Owner::Hand(side),
        _ => Owner::Other,
    });
    let places: Vec<Vec3> = body.vertices.iter().map(|vertex| vertex.posed).collect();
    skeleton::sunk_hands(&places, &body.normals(), &owners.collect::<Vec<_>>(), gap)
}
