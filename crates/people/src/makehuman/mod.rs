//! MakeHuman people: bodies mixed from morph targets, posed by skinning, dressed in layers cut from the base mesh's own
//! helper surfaces, in the clothes and colours of the synthetic people.
//!
//! Colour follows from the place on the resting body alone, so that whatever layer is seen somewhere has the right one;
//! skin under cloth is pressed in, so that it cannot come through.

mod dress;
mod files;
mod hands;
mod net;
mod rig;
mod shape;
#[cfg(test)]
mod tests;

use glam::{Mat3, Vec3};

use crate::synth::MOVES;
use crate::synth::atlas;
use crate::synth::body::Body;
use crate::synth::figure::{Build, Figure, Pose};
use crate::synth::outfit::{Lower, Outfit};
use crate::synth::paint::{Face as Landmarks, Painter};
use crate::synth::part::{Kind, Marks};
use crate::synth::surface::Surface;
pub use files::Library;
use net::{Net, PARTS, Vertex};
use rig::{Joints, Posed};
use shape::{Mix, morph};
use snapsnap_base::FileError;
use snapsnap_base::random::stream;
use snapsnap_mesh::mesh::{Face, Material, Mesh};

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

/// Longest side of the box around a person and all that may be worn, metres: what is larger no memory could mesh.
const LARGEST: f32 = 5.0;

/// The person of this name: life-size in metres, standing on y = 0 and
/// facing +z.
///
/// # Errors
/// [`FileError`] naming a file that is missing or damaged.
pub fn person(library: &Library, name: &str) -> Result<Mesh, FileError> {
    with_person(library, name, |person| person.mesh())
}

fn with_person<T>(library: &Library, name: &str, then: impl FnOnce(&Person) -> T) -> Result<T, FileError> {
    let mut random = stream(&format!("makehuman/{name}"));
    let mix = Mix::draw(&mut random);
    let mut build = Build::draw(&mut random);
    let mut pose = Pose::draw(&mut random);
    let rest = morph(library, &mix, &mut random)?;
    let (low, high) = bounds(rest.iter().copied());
    let reach = (high - low).max_element();
    if reach > LARGEST || !rest.iter().all(|p| p.is_finite()) {
        let message = format!("a person of {reach} m comes out: one of its targets is damaged");
        return Err(FileError::unsuitable(library.root(), message));
    }
    let body = || library.groups.get("body").into_iter().flatten().flatten().map(|row| rest[*row as usize]);
    let (low, high) = bounds(body());
    (build.sex, build.stature) = (mix.sex, (high.y - low.y).max(0.5));
    build.girth = 0.8 + 0.4 * mix.weight;
    let mut outfit = Outfit::draw(&mut random, &build);
    outfit.glasses = false;
    if matches!(outfit.lower, Lower::Skirt { .. }) {
        // The base mesh's skirt begins below the waist.
        outfit.top_length = outfit.top_length.max(0.5);
    }
    pose.spread_arms(0.5 * outfit.breadth());
    let joints = Joints::of(library, &rest);
    let middle = |height: f32| {
        let (low, high) = bounds(body().filter(|p| p.x.abs() < 0.1 && (p.y - height).abs() < 0.03));
        if low.is_finite() { (low.z + high.z) / 2.0 } else { 0.0 }
    };
    let figure = joints.figure(build, high.y, middle);
    let cloth = 0.01 + outfit.top_thickness + if outfit.breadth() > 0.0 { 0.03 } else { 0.0 };
    let shares = shares(library);
    let vertices = |posed: &Posed| -> Vec<Vertex> {
        let places = rest.iter().zip(&posed.positions).zip(&shares);
        places.map(|((rest, posed), parts)| Vertex { rest: *rest, posed: *posed, parts: *parts }).collect()
    };
    let mut posed = joints.pose(&rest, &figure, &pose);
    for _ in 0..MOVES {
        let vertices = vertices(&posed);
        let sunk = hands::sunk(&group(library, &vertices, "body"), cloth);
        if sunk == [false; 2] {
            break;
        }
        (0..2).filter(|side| sunk[*side]).for_each(|side| pose.ease_arm(side));
        posed = joints.pose(&rest, &figure, &pose);
    }
    Ok(then(&Person::new(library, vertices(&posed), posed.head, &figure, &outfit, &joints)))
}

fn bounds(points: impl Iterator<Item = Vec3>) -> (Vec3, Vec3) {
    points.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

struct Person<'a> {
    library: &'a Library,
    figure: &'a Figure,
    outfit: &'a Outfit,
    marks: Marks,
    body: Body,
    /// Rows of `body` of the parts of [`ORDER`].
    rows: [usize; PARTS],
    vertices: Vec<Vertex>,
    /// The surface that clothes are cut from.
    tights: Net,
    /// How the head moved: turn, then shift.
    head: (Mat3, Vec3),
    eyes: [Vec3; 2],
    mouth: (Vec3, Vec3),
}

/// A piece with the row of the body's part that each vertex lies on.
struct Piece {
    net: Net,
    parts: Vec<u8>,
}

impl<'a> Person<'a> {
    fn new(
        library: &'a Library,
        vertices: Vec<Vertex>,
        head: (Mat3, Vec3),
        figure: &'a Figure,
        outfit: &'a Outfit,
        joints: &Joints,
    ) -> Self {
        let body = Body::new(figure, outfit);
        let row = |kind: Kind, side: usize| {
            body.parts.iter().position(|part| part.kind == kind && part.side == side).unwrap_or(0)
        };
        let tights = group(library, &vertices, "helper-tights").subdivide().subdivide();
        Self {
            library,
            figure,
            outfit,
            marks: Marks::of(figure, outfit),
            rows: ORDER.map(|(kind, side)| row(kind, side)),
            body,
            vertices,
            tights,
            head,
            eyes: [joints.eye(0), joints.eye(1)],
            mouth: joints.mouth(),
        }
    }

    fn group(&self, name: &str) -> Net {
        group(self.library, &self.vertices, name)
    }

    /// Kind of part, and place on its chart.
    fn place(&self, vertex: &Vertex) -> (Kind, f32, f32, f32) {
        let part = vertex.part();
        let chart = &self.body.parts[self.rows[part]];
        let (angle, along) = chart.chart(vertex.rest);
        (ORDER[part].0, angle, along, chart.length)
    }

    fn mesh(&self) -> Mesh {
        let skin = self.skin();
        let hair = self.hair(&skin);
        let garments = vec![self.bottom(), self.top(), self.shoes()];
        let skirts: Vec<Piece> = self
            .drapes()
            .map(|row| {
                // Tails belong to the top; skirts begin under it.
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
            for face in &net.faces {
                surface
                    .faces
                    .extend((1..face.len() - 1).map(|i| [face[0], face[i], face[i + 1]].map(|r| r + first)));
            }
        }
        let mut painter = Painter::new(self.figure, self.outfit);
        painter.face = self.landmarks();
        let mut mesh = atlas::paint(&self.body, &surface, &painter);
        mesh.positions = positions;
        self.add_eyes(&mut mesh);
        let floor = mesh.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
        mesh.positions.iter_mut().for_each(|p| p.y -= floor);
        mesh
    }

    /// Where the features of the face are, on the chart of the head.
    fn landmarks(&self) -> Landmarks {
        let head = &self.body.parts[self.rows[1]];
        let size = (self.figure.head.end - self.figure.head.start).length();
        let at = |p: Vec3| {
            let (angle, along) = head.chart(p);
            (angle.abs(), along / size)
        };
        let eye = at(self.eyes[0] + 0.016 * Vec3::Z);
        let (low, high) = self.mouth;
        let mouth = at((low + high) / 2.0);
        let corner = at(Vec3::new(high.x, (low.y + high.y) / 2.0, low.z));
        Landmarks {
            eye,
            brow: eye.1 + 0.075,
            mouth: mouth.1,
            lips: [corner.0 * 1.15, (high.y - low.y) / size * 0.3],
            nose: None,
            painted_eyes: false,
        }
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
            for face in &net.faces {
                for i in 1..face.len() - 1 {
                    let positions = [face[0], face[i], face[i + 1]].map(|row| row + first);
                    mesh.faces.push(Face { positions, texcoords: None, material });
                }
            }
        }
    }
}

/// A group of the base mesh.
fn group(library: &Library, vertices: &[Vertex], name: &str) -> Net {
    let faces = library.groups.get(name).map_or(&[][..], Vec::as_slice);
    Net::of(|row| vertices[row as usize], faces)
}

/// How much each vertex belongs to each part of the body.
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
        // The head and everything in the face.
        _ => 1,
    }
}
