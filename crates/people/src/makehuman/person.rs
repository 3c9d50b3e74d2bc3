//! A person of MakeHuman's data in a pose, before it becomes a mesh.

use glam::Vec3;
use snapsnap_base::{FileError, random};
use snapsnap_mesh::mesh::bounds;

use super::files::Library;
use super::morph::{Mix, morph};
use super::patch::{HEAD, ORDER, PARTS, Patch, Vertex};
use super::proxy::Worn;
use super::rig::{self, Joints};
use crate::Detail;
use crate::figure::{Build, Figure, Pose};
use crate::poses::Poses;
use crate::skeleton::Placed;
use crate::synth::body::Body;
use crate::synth::outfit::{Lower, Outfit};
use crate::synth::paint::Face as Landmarks;
use crate::synth::part::{Kind, Marks, Part};

/// Longest side of the box around a person, metres. A larger one would not fit in memory as a mesh.
const LARGEST: f32 = 5.0;

/// A posed person.
pub struct Person<'a> {
    pub library: &'a Library,
    pub detail: Detail,
    pub figure: Figure,
    pub outfit: Outfit,
    pub marks: Marks,
    pub body: Body,
    /// Indices into `body.parts`, in the order of [`ORDER`].
    pub rows: [usize; PARTS],
    pub vertices: Vec<Vertex>,
    /// The surface that clothes are cut from.
    pub tights: Patch,
    /// Transforms of the bones.
    pub placed: Vec<Placed>,
    /// Index of the head in `placed`.
    pub head: usize,
    pub worn: Worn,
    pub face: Landmarks,
}

/// A piece of the surface.
pub struct Piece {
    pub patch: Patch,
    /// Index into `body.parts` of each vertex's part.
    pub parts: Vec<u8>,
}

/// Position of a vertex on the chart of a part.
pub struct Place {
    pub kind: Kind,
    pub angle: f32,
    pub along: f32,
    /// Length of the chart.
    pub length: f32,
}

impl<'a> Person<'a> {
    pub fn of(
        library: &'a Library,
        name: &str,
        poses: Option<&Poses>,
        pose: Option<&Pose>,
        detail: Detail,
    ) -> Result<Self, FileError> {
        let mut random = random::stream(&format!("makehuman/{name}"));
        let mix = Mix::draw(&mut random);
        let mut build = Build::draw(&mut random);
        let drawn = Poses::any(poses.or(library.poses.as_ref()), &mut random);
        let mut pose = pose.cloned().unwrap_or(drawn);
        let rest = morph(library, &mix, &mut random)?;
        let (low, high) = bounds(rest.iter().copied());
        let reach = (high - low).max_element();
        if reach > LARGEST || !rest.iter().all(|p| p.is_finite()) {
            let message = format!("a person of {reach} m comes out: one of its targets is damaged");
            return Err(FileError::unsuitable(library.root(), message));
        }
        let skin = || library.groups["body"].iter().flatten().map(|row| rest[*row as usize]);
        let (low, high) = bounds(skin());
        (build.sex, build.stature) = (mix.sex, (high.y - low.y).max(0.5));
        build.girth = 0.8 + 0.4 * mix.weight;
        let mut outfit = Outfit::draw(&mut random, &build);
        outfit.glasses = false;
        if matches!(outfit.lower, Lower::Skirt { .. }) {
            // The base mesh's skirt begins below the waist.
            outfit.top_length = outfit.top_length.max(0.5);
        }
        let is_draped = matches!(outfit.lower, Lower::Skirt { .. }) || outfit.top_length > 1.0;
        let wardrobe = &mut random::stream(&format!("makehuman/wardrobe/{name}"));
        let worn = Worn::draw(&library.wardrobe, &outfit, mix.sex, is_draped, wardrobe);
        pose.spread_arms(0.5 * outfit.breadth());

        let joints = Joints::of(library, &rest);
        let middle = |height: f32| {
            let (low, high) = bounds(skin().filter(|p| p.x.abs() < 0.1 && (p.y - height).abs() < 0.03));
            if low.is_finite() { (low.z + high.z) / 2.0 } else { 0.0 }
        };
        let figure = joints.figure(build, high.y, middle);
        let shares = shares(library);
        let posed = |pose: &Pose| {
            let (positions, placed) = joints.pose(&rest, &figure, pose);
            let places = rest.iter().zip(positions).zip(&shares);
            let vertices = places.map(|((rest, posed), parts)| Vertex { rest: *rest, posed, parts: *parts });
            (vertices.collect::<Vec<_>>(), placed)
        };
        let cloth = 0.01 + outfit.top_thickness + if outfit.breadth() > 0.0 { 0.03 } else { 0.0 };
        let sunk = |(vertices, _): &(Vec<Vertex>, Vec<Placed>)| {
            rig::sunk_hands(&Patch::of(vertices, &library.groups["body"]), cloth)
        };
        let (vertices, placed) = pose.free_hands(posed, sunk);

        let body = Body::new(&figure, &outfit);
        let rows = ORDER.map(|(kind, side)| {
            body.parts.iter().position(|part| part.kind == kind && part.side == side).unwrap_or(0)
        });
        Ok(Self {
            library,
            detail,
            marks: Marks::of(&figure, &outfit),
            rows,
            tights: Patch::of(&vertices, &library.groups["helper-tights"]).subdivided(detail.steps(2)),
            placed,
            head: joints.row("head").unwrap_or(0),
            worn,
            face: landmarks(&body.parts[rows[HEAD]], &joints),
            figure,
            outfit,
            body,
            vertices,
        })
    }

    /// A group of the base mesh.
    pub fn group(&self, name: &str) -> Patch {
        Patch::of(&self.vertices, &self.library.groups[name])
    }

    /// Position of a vertex on the chart of a part, which is an index into [`ORDER`].
    pub fn place_on(&self, part: usize, vertex: &Vertex) -> Place {
        let chart = &self.body.parts[self.rows[part]];
        let (angle, along) = chart.chart(vertex.rest);
        Place { kind: ORDER[part].0, angle, along, length: chart.length }
    }

    /// Position of a vertex on the chart of its own part.
    pub fn place(&self, vertex: &Vertex) -> Place {
        self.place_on(vertex.part(), vertex)
    }
}

/// Positions of the features of the face on the chart of the head.
fn landmarks(head: &Part, joints: &Joints) -> Landmarks {
    let at = |p: Vec3| {
        let (angle, along) = head.chart(p);
        (angle.abs(), along / head.length)
    };
    let eye = at(joints.head("eye.L") + 0.016 * Vec3::Z);
    let (low, high) = joints.mouth();
    let corner = at(Vec3::new(high.x, (low.y + high.y) / 2.0, low.z));
    Landmarks {
        eye,
        brow: eye.1 + 0.075,
        mouth: at((low + high) / 2.0).1,
        lips: [corner.0 * 1.15, (high.y - low.y) / head.length * 0.3],
        painted: false,
    }
}

/// Share of each part of the body in each vertex.
fn shares(library: &Library) -> Vec<[f32; PARTS]> {
    let kinds: Vec<usize> = library.bones.iter().map(|bone| part_of(&bone.name)).collect();
    let shares = library.weights.iter().map(|weights| {
        let mut parts = [0.0; PARTS];
        weights.iter().for_each(|(bone, share)| parts[kinds[*bone as usize]] += share);
        parts
    });
    shares.collect()
}

/// The part of the body that a bone belongs to.
fn part_of(bone: &str) -> usize {
    let side = usize::from(bone.ends_with(".R"));
    let starts = |names: &[&str]| names.iter().any(|name| bone.starts_with(name));
    match bone {
        _ if starts(&["upperarm", "lowerarm"]) => 2 + side,
        _ if starts(&["wrist", "finger", "metacarpal"]) => 4 + side,
        _ if starts(&["upperleg", "lowerleg"]) => 6 + side,
        _ if starts(&["foot", "toe"]) => 8 + side,
        _ if starts(&["root", "spine", "pelvis", "neck", "clavicle", "shoulder", "breast"]) => 0,
        // The head and the face.
        _ => 1,
    }
}
