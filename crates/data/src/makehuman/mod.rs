//! MakeHuman people: bodies mixed from morph targets, posed by skinning, dressed in layers cut from the base mesh's own
//! helper surfaces, in the clothes and colours of the synthetic people.
//!
//! Colour follows from the place on the resting body alone, so that whatever layer is seen somewhere has the right one;
//! skin that is deep under cloth is left out, so that it cannot come through.

mod files;
mod net;
mod rig;
mod shape;
#[cfg(test)]
mod tests;

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use crate::DataError;
use crate::mesh::{Face, Material, Mesh};
use crate::random::stream;
use crate::synth::atlas;
use crate::synth::body::{Body, Kind, Marks, neckline};
use crate::synth::figure::{Build, Figure, Pose};
use crate::synth::math::{noise, smoothstep};
use crate::synth::outfit::{Lower, Outfit};
use crate::synth::paint::{Face as Landmarks, Painter};
use crate::synth::surface::{self, Surface};
pub use files::Library;
use net::{Net, PARTS, Vertex};
use rig::{Joints, Posed};
use shape::{Mix, morph};

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
/// Skin this deep under a hem, in metres, is left out.
const HIDDEN: f32 = 0.03;
/// Beyond this, how far inside a garment a place is does not matter.
const FAR: f32 = 0.08;
/// Side of the cells that hair is meshed with, metres.
const HAIR_CELL: f32 = 0.006;

/// The person of this name: life-size in metres, standing on y = 0 and
/// facing +z.
///
/// # Errors
/// [`DataError`] naming a file that is missing or damaged.
pub fn person(library: &Library, name: &str) -> Result<Mesh, DataError> {
    with_person(library, name, |person| person.mesh())
}

fn with_person<T>(library: &Library, name: &str, then: impl FnOnce(&Person) -> T) -> Result<T, DataError> {
    let mut random = stream(&format!("makehuman/{name}"));
    let mix = Mix::draw(&mut random);
    let mut build = Build::draw(&mut random);
    let mut pose = Pose::draw(&mut random);
    let rest = morph(library, &mix, &mut random)?;
    let group = |name: &str| library.groups.get(name).map_or(&[][..], Vec::as_slice);
    let (low, high) = bounds(group("body").iter().flatten().map(|row| rest[*row as usize]));
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
    let figure = joints.figure(build, high.y);
    let posed = joints.pose(&rest, &figure, &pose);
    Ok(then(&Person::new(library, &rest, &posed, &figure, &outfit, &joints)))
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
    posed: &'a Posed,
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
        rest: &[Vec3],
        posed: &'a Posed,
        figure: &'a Figure,
        outfit: &'a Outfit,
        joints: &Joints,
    ) -> Self {
        let body = Body::new(figure, outfit);
        let row = |kind: Kind, side: usize| {
            body.parts.iter().position(|part| part.kind == kind && part.side == side).unwrap_or(0)
        };
        let kinds: Vec<usize> = library.bones.iter().map(|bone| part_of(&bone.name)).collect();
        let vertices = (0..rest.len())
            .map(|i| {
                let mut parts = [0.0; PARTS];
                for (bone, share) in &library.weights[i] {
                    parts[kinds[*bone as usize]] += share;
                }
                Vertex { rest: rest[i], posed: posed.positions[i], parts }
            })
            .collect();
        Self {
            library,
            figure,
            outfit,
            marks: Marks::of(figure, outfit),
            rows: ORDER.map(|(kind, side)| row(kind, side)),
            body,
            vertices,
            posed,
            eyes: [joints.eye(0), joints.eye(1)],
            mouth: joints.mouth(),
        }
    }

    fn group(&self, name: &str) -> Net {
        let faces = self.library.groups.get(name).map_or(&[][..], Vec::as_slice);
        Net::of(|row| self.vertices[row as usize], faces)
    }

    /// Kind of part, and place on its chart.
    fn place(&self, vertex: &Vertex) -> (Kind, f32, f32, f32) {
        let part = vertex.part();
        let chart = &self.body.parts[self.rows[part]];
        let (angle, along) = chart.chart(vertex.rest);
        (ORDER[part].0, angle, along, chart.length)
    }

    /// Metres inside the top's edges; negative outside.
    fn in_top(&self, vertex: &Vertex) -> f32 {
        let (kind, angle, along, length) = self.place(vertex);
        let depth = match kind {
            Kind::Trunk => {
                let collar = self.marks.collar - neckline(self.marks.neckline, angle);
                (along - self.marks.hem).min(collar - along)
            }
            Kind::Arm => self.outfit.sleeve * length - along,
            _ => -FAR,
        };
        depth.clamp(-FAR, FAR)
    }

    /// Metres inside the edges of trousers, or of a skirt's lining on the trunk.
    fn in_bottom(&self, vertex: &Vertex) -> f32 {
        let (kind, _, along, length) = self.place(vertex);
        // Under a top only as far as it may ride up.
        let band = self.marks.waistband.min(self.marks.hem + 0.06);
        let depth = match (kind, self.outfit.lower) {
            (Kind::Trunk, _) => band - along,
            (Kind::Leg, Lower::Trousers { length: share, .. }) => share * length - along,
            // Shorts under a skirt.
            (Kind::Leg, Lower::Skirt { .. }) => 0.05 - along,
            _ => -FAR,
        };
        depth.clamp(-FAR, FAR)
    }

    fn in_shoes(&self, vertex: &Vertex) -> f32 {
        let (kind, _, along, length) = self.place(vertex);
        let shaft = (self.outfit.boots * length).max(0.025);
        let depth = match kind {
            Kind::Foot => FAR,
            Kind::Leg => along - (length - shaft),
            _ => -FAR,
        };
        depth.clamp(-FAR, FAR)
    }

    /// A piece of the base mesh, whose vertices lie on their own parts.
    fn own(&self, net: Net) -> Piece {
        let parts = net.vertices.iter().map(|vertex| self.rows[vertex.part()] as u8).collect();
        Piece { net, parts }
    }

    fn skin(&self) -> Piece {
        let mut net = self.group("body").subdivide();
        let depth = |vertex: &Vertex| {
            let depth = self.in_top(vertex).max(self.in_bottom(vertex)).max(self.in_shoes(vertex));
            depth.max(self.under_skirt(vertex))
        };
        let hidden: Vec<bool> = net.vertices.iter().map(|vertex| depth(vertex) > HIDDEN).collect();
        net.faces.retain(|face| !face.iter().all(|row| hidden[*row as usize]));
        // Only vertices that are still used.
        let mut net = net.cut(|_| 1.0);
        // Cloth presses on what is left under it.
        net.inflate(|vertex| -0.007 * smoothstep(0.0, 0.015, depth(vertex)));
        self.own(net)
    }

    /// A layer of cloth over the body: the part of the tights that is `inside`, `thick` metres off.
    fn layer(&self, inside: impl Fn(&Vertex) -> f32, thick: impl Fn(&Vertex) -> f32) -> Piece {
        let mut net = self.group("helper-tights").subdivide().subdivide();
        net.inflate(thick);
        self.own(net.cut(inside))
    }

    fn folds(&self, vertex: &Vertex) -> f32 {
        let p = vertex.rest;
        self.outfit.folds * noise(Vec3::new(p.x * 24.0, p.y * 30.0, p.z * 24.0), self.outfit.seed)
    }

    fn top(&self) -> Piece {
        self.layer(
            |vertex| self.in_top(vertex),
            |vertex| {
                let (kind, _, along, length) = self.place(vertex);
                let share = (along / (self.outfit.sleeve * length).max(0.05)).clamp(0.0, 1.0);
                let flare = if kind == Kind::Arm { self.outfit.sleeve_flare * share * share } else { 0.0 };
                // Collars lie close to the neck.
                let loose = if kind == Kind::Trunk {
                    1.0 - smoothstep(self.marks.collar - 0.09, self.marks.collar - 0.02, along)
                } else {
                    1.0
                };
                0.006 + loose * (0.8 * self.outfit.top_thickness + flare + 1.5 * self.folds(vertex))
            },
        )
    }

    fn bottom(&self) -> Piece {
        self.layer(
            |vertex| self.in_bottom(vertex),
            |vertex| {
                let (kind, _, along, length) = self.place(vertex);
                let flare = match (kind, self.outfit.lower) {
                    (Kind::Leg, Lower::Trousers { flare, .. }) => {
                        let down = (along / length).clamp(0.0, 1.0);
                        flare * down * down
                    }
                    _ => 0.0,
                };
                0.001 + 0.5 * self.outfit.lower_thickness + flare + self.folds(vertex)
            },
        )
    }

    fn shoes(&self) -> Piece {
        self.layer(
            |vertex| self.in_shoes(vertex),
            |vertex| {
                let (kind, angle, ..) = self.place(vertex);
                // Soles are thicker.
                let sole = if kind == Kind::Foot && angle.abs() > 2.2 { 0.008 } else { 0.0 };
                0.004 + 0.6 * self.outfit.shoe_thickness + sole
            },
        )
    }

    /// Skirts and the tails of coats: row of the part.
    fn drapes(&self) -> impl Iterator<Item = usize> {
        (0..self.body.parts.len()).filter(|row| self.body.parts[*row].kind == Kind::Skirt)
    }

    /// Metres above the longest skirt's hem, for skin that it hides.
    fn under_skirt(&self, vertex: &Vertex) -> f32 {
        if !matches!(ORDER[vertex.part()].0, Kind::Leg | Kind::Trunk) {
            return -FAR;
        }
        self.drapes().map(|row| self.in_drape(row, vertex) - 0.06).fold(-FAR, f32::max)
    }

    fn in_drape(&self, row: usize, vertex: &Vertex) -> f32 {
        let part = &self.body.parts[row];
        let along = part.chart(vertex.rest).1;
        let band = if part.side == 1 { -1.0 } else { 0.0 };
        (part.length - along).min(along - band).clamp(-FAR, FAR)
    }

    fn skirt(&self, row: usize, skin: &Piece) -> Piece {
        let is_coat = self.body.parts[row].side == 1;
        let mut net = self.group("helper-skirt").subdivide().subdivide();
        let off = if is_coat { 0.012 } else { 0.004 } + self.outfit.lower_thickness;
        let folds = |vertex: &Vertex| {
            let p = vertex.rest - self.figure.pelvis.start;
            let angle = libm::atan2f(p.x, p.z);
            let down = smoothstep(0.0, 0.5, -p.y);
            0.012 * down * noise(Vec3::new(2.2 * angle, 1.5 * p.y, 0.0), self.outfit.seed)
        };
        net.inflate(|vertex| off + folds(vertex));
        let mut net = net.cut(|vertex| self.in_drape(row, vertex));
        push_out(&mut net, &skin.net, 0.008);
        let parts = vec![row as u8; net.vertices.len()];
        Piece { net, parts }
    }

    /// Hair, meshed around the resting head and carried along by it.
    fn hair(&self, skin: &Piece) -> Option<Piece> {
        let row = self.body.parts.iter().position(|part| part.kind == Kind::Hair)?;
        let hair = Body { parts: vec![self.body.parts[row].clone()] };
        let Surface { positions, faces, .. } = surface::mesh(&hair, HAIR_CELL);
        let (turn, shift) = self.posed.head;
        let vertex = |p: &Vec3| Vertex { rest: *p, posed: turn * *p + shift, parts: [0.0; PARTS] };
        let vertices: Vec<Vertex> = positions.iter().map(vertex).collect();
        let mut net = Net { vertices, faces: faces.into_iter().map(|f| f.to_vec()).collect() };
        push_out(&mut net, &skin.net, 0.006);
        let parts = vec![row as u8; net.vertices.len()];
        Some(Piece { net, parts })
    }

    fn mesh(&self) -> Mesh {
        let skin = self.skin();
        let mut pieces = Vec::new();
        pieces.extend(self.hair(&skin));
        pieces.push(self.bottom());
        pieces.push(self.top());
        pieces.push(self.shoes());
        pieces.extend(self.drapes().map(|row| self.skirt(row, &skin)));
        pieces.insert(0, skin);

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
            lips: [corner.0 * 0.95, (high.y - low.y) / size * 0.3],
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

/// Moves vertices that lie inside `solid`, or nearer to it than `gap` metres, out to that distance.
fn push_out(net: &mut Net, solid: &Net, gap: f32) {
    let normals = solid.normals();
    let points: Vec<[f32; 3]> = solid.vertices.iter().map(|vertex| vertex.posed.to_array()).collect();
    if points.is_empty() {
        return;
    }
    let tree: ImmutableKdTree<f32, 3> =
        ImmutableKdTree::new_from_slice(&points).expect("fewer points than u32 can number");
    let places: Vec<[f32; 3]> = net.vertices.iter().map(|vertex| vertex.posed.to_array()).collect();
    let found = tree.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
    // Further inside than this the nearest skin is that of the other side.
    let deepest = 0.05;
    for (vertex, found) in net.vertices.iter_mut().zip(&found) {
        let nearest = found.item as usize;
        let (skin, normal) = (Vec3::from_array(points[nearest]), normals[nearest]);
        let out = (vertex.posed - skin).dot(normal);
        if out < gap && out > -deepest && (vertex.posed - skin).length() < deepest {
            vertex.posed += normal * (gap - out);
        }
    }
}
