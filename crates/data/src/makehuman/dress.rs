//! The layers of a MakeHuman person: skin, clothes cut from the base mesh's helper surfaces, hair.

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::net::{Net, PARTS, Vertex};
use super::{ORDER, Person, Piece};
use crate::synth::body::{Body, Kind, neckline};
use crate::synth::math::{noise, smoothstep};
use crate::synth::outfit::Lower;
use crate::synth::surface::{self, Surface};

/// Skin this deep under a hem, in metres, is left out.
const HIDDEN: f32 = 0.03;
/// Beyond this, how far inside a garment a place is does not matter.
const FAR: f32 = 0.08;
/// Side of the cells that hair is meshed with, metres.
const HAIR_CELL: f32 = 0.006;

impl Person<'_> {
    /// Metres inside the top's edges; negative outside.
    pub fn in_top(&self, vertex: &Vertex) -> f32 {
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
    pub fn in_bottom(&self, vertex: &Vertex) -> f32 {
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

    pub fn in_shoes(&self, vertex: &Vertex) -> f32 {
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

    pub fn skin(&self) -> Piece {
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

    pub fn top(&self) -> Piece {
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

    pub fn bottom(&self) -> Piece {
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

    pub fn shoes(&self) -> Piece {
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
    pub fn drapes(&self) -> impl Iterator<Item = usize> {
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

    pub fn skirt(&self, row: usize, skin: &Piece) -> Piece {
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
    pub fn hair(&self, skin: &Piece) -> Option<Piece> {
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
