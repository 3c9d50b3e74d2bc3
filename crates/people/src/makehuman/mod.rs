//! People of MakeHuman's data: bodies mixed from morph targets, posed by skinning, and dressed. Clothes are layers that are
//! cut from the helper surfaces of the base mesh, in colours of [`synth`](crate::synth), or meshes of the asset collection.
//!
//! The place on the resting body alone determines a colour, so that all layers at a place have the same one. Skin under
//! cloth is pressed in, so that it does not come through.

mod dress;
mod files;
mod net;
mod proxy;
mod rig;
mod shape;
#[cfg(test)]
mod tests;
mod wear;

use glam::Vec3;

use crate::math::bounds;
use crate::poses::Poses;
use crate::skeleton::Placed;
use crate::synth::atlas;
use crate::synth::body::Body;
use crate::synth::figure::{Build, Figure, Pose};
use crate::synth::outfit::{Lower, Outfit};
use crate::synth::paint::{Face as Landmarks, Painter};
use crate::synth::part::{Kind, Marks, Part};
use crate::synth::stand;
use crate::synth::surface::Surface;
pub use files::Library;
use net::{Net, PARTS, Vertex};
use rig::Joints;
use shape::{Mix, morph};
use snapsnap_base::FileError;
use snapsnap_base::random::stream;
use snapsnap_mesh::mesh::{Face, Material, Mesh};
use wear::Worn;

/// Kinds and sides of the parts of [`Vertex::parts`].
const ORDER: [(Kind, usize); PARTS] = [
    (Kind::Trunk, 0),
    (Kind::Head, 0),
    (Kind::Arm, 0),
    (Kind::Arm, 1),
    (Kind::Hand, 0),
    (Kind::Hand, 1),
    (Kind::Leg, 0),
    (Kind::Leg, 1),
    (Kind::Foot, 0),
    (Kind::Foot, 1),
];

/// Row of the head in [`ORDER`].
const HEAD: usize = 1;

/// Longest side of the box around a person, metres. A larger one would not fit in memory as a mesh.
const LARGEST: f32 = 5.0;

/// The person of this name: life-size in metres, standing on y = 0 and facing +z. Often in one of `poses`, or else in one of
/// the data's own.
///
/// # Errors
/// [`FileError`] naming a file that is missing or damaged.
pub fn person(library: &Library, name: &str, poses: Option<&Poses>) -> Result<Mesh, FileError> {
    Ok(Person::of(library, name, poses)?.mesh())
}

/// A person in a pose, before it becomes a mesh.
struct Person<'a> {
    library: &'a Library,
    figure: Figure,
    outfit: Outfit,
    marks: Marks,
    body: Body,
    /// Rows of `body.parts` in the order of [`ORDER`].
    rows: [usize; PARTS],
    vertices: Vec<Vertex>,
    /// The surface that clothes are cut from.
    tights: Net,
    /// Places of the bones.
    placed: Vec<Placed>,
    /// Row of the head in `placed`.
    head: usize,
    worn: Worn,
    face: Landmarks,
}

/// A piece of the surface.
struct Piece {
    net: Net,
    /// Row in `body.parts` of the part that each vertex lies on.
    parts: Vec<u8>,
}

/// Place of a vertex on the chart of a part.
struct Place {
    kind: Kind,
    angle: f32,
    along: f32,
    /// Length of the chart.
    length: f32,
}

impl<'a> Person<'a> {
    fn of(library: &'a Library, name: &str, poses: Option<&Poses>) -> Result<Self, FileError> {
        let mut random = stream(&format!("makehuman/{name}"));
        let mix = Mix::draw(&mut random);
        let mut build = Build::draw(&mut random);
        let mut pose = Poses::any(poses.or(library.poses.as_ref()), &mut random);
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
        let wardrobe = &mut stream(&format!("makehuman/wardrobe/{name}"));
        let worn = Worn::draw(library, &outfit, mix.sex, is_draped, wardrobe);
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
            rig::sunk_hands(&group(library, vertices, "body"), cloth)
        };
        let (vertices, placed) = pose.free_hands(posed, sunk);

        let body = Body::new(&figure, &outfit);
        let row = |kind: Kind, side: usize| {
            body.parts.iter().position(|part| part.kind == kind && part.side == side).unwrap_or(0)
        };
        let rows = ORDER.map(|(kind, side)| row(kind, side));
        Ok(Self {
            library,
            marks: Marks::of(&figure, &outfit),
            rows,
            tights: group(library, &vertices, "helper-tights").subdivide().subdivide(),
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

    fn group(&self, name: &str) -> Net {
        group(self.library, &self.vertices, name)
    }

    /// Place of a vertex on the chart of a part, which is a row of [`ORDER`].
    fn place_on(&self, part: usize, vertex: &Vertex) -> Place {
        let chart = &self.body.parts[self.rows[part]];
        let (angle, along) = chart.chart(vertex.rest);
        Place { kind: ORDER[part].0, angle, along, length: chart.length }
    }

    /// Place of a vertex on the chart of its own part.
    fn place(&self, vertex: &Vertex) -> Place {
        self.place_on(vertex.part(), vertex)
    }

    fn mesh(&self) -> Mesh {
        let skin = self.skin();
        let hair = self.hair(&skin).filter(|_| self.worn.hair.is_none());
        let mut garments = Vec::new();
        if self.worn.suit.is_none() {
            garments.extend(self.layers());
        }
        if self.worn.shoes.is_none() {
            garments.push(self.shoes());
        }
        let skirts: Vec<Piece> = self
            .drapes()
            .map(|row| {
                // The tail of a coat hangs over the top, a skirt under it.
                let is_tail = self.body.parts[row].side == 1;
                self.skirt(row, &[&skin, &garments[0], &garments[1]][..if is_tail { 3 } else { 2 }])
            })
            .collect();
        let mut pieces = vec![self.pressed_skin(skin, &garments)];
        pieces.extend(hair);
        pieces.extend(garments);
        pieces.extend(skirts);

        let mut surface = Surface { positions: Vec::new(), faces: Vec::new(), parts: Vec::new() };
        let mut positions = Vec::new();
        for Piece { net, parts } in &pieces {
            let first = positions.len() as u32;
            positions.extend(net.vertices.iter().map(|vertex| vertex.posed));
            surface.positions.extend(net.vertices.iter().map(|vertex| vertex.rest));
            surface.parts.extend(parts);
            surface.faces.extend(net.triangles().map(|face| face.map(|row| row + first)));
        }
        let bare = [self.worn.suit.is_some(), self.worn.shoes.is_some()];
        let painter = Painter::new(&self.figure, &self.outfit, &self.face).bare(bare);
        let mut mesh = atlas::paint(&self.body, &surface, &painter);
        mesh.positions = positions;
        self.add_worn(&mut mesh);
        self.add_eyes(&mut mesh);
        stand(&mut mesh);
        mesh
    }

    fn add_eyes(&self, mesh: &mut Mesh) {
        mesh.colors = vec![Vec3::ONE; mesh.positions.len()];
        mesh.materials.push(Material::default());
        let material = mesh.materials.len() as u32 - 1;
        for name in ["helper-l-eye", "helper-r-eye"] {
            let net = self.group(name).subdivide().subdivide();
            let first = mesh.positions.len() as u32;
            let (low, high) = bounds(net.vertices.iter().map(|vertex| vertex.rest));
            let centre = (low + high) / 2.0;
            for vertex in &net.vertices {
                mesh.positions.push(vertex.posed);
                let way = (vertex.rest - centre).normalize_or_zero().z;
                mesh.colors.push(match way {
                    w if w > 0.975 => Vec3::splat(0.03),
                    w if w > 0.88 => self.outfit.eyes,
                    _ => Vec3::splat(0.88),
                });
            }
            for face in net.triangles() {
                let positions = face.map(|row| row + first);
                mesh.faces.push(Face { positions, texcoords: None, material });
            }
        }
    }
}

/// Places of the features of the face on the chart of the head.
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

/// A group of the base mesh.
fn group(library: &Library, vertices: &[Vertex], name: &str) -> Net {
    Net::of(vertices, &library.groups[name])
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
