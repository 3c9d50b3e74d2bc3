//! The layers of a MakeHuman person: skin, clothes cut from the base mesh's helper surfaces, hair.

use std::num::NonZeroUsize;

use glam::{Vec2, Vec3};
use kiddo::SquaredEuclidean;

use super::patch::{HEAD, ORDER, PARTS, Patch, Vertex};
use super::person::{Person, Piece, Place};
use crate::math::{noise, smoothstep};
use crate::skeleton::{coordinates, tree};
use crate::synth::body::Body;
use crate::synth::outfit::Lower;
use crate::synth::part::Kind;
use crate::synth::surface::{self, Surface};

/// Distance of skin below cloth, metres.
const GAP: f32 = 0.004;
/// Largest depth inside a garment, metres; deeper places count as this deep.
const FAR: f32 = 0.08;
/// Side of the cells that hair of fine people is meshed with, metres.
const HAIR_CELL: f32 = 0.006;
/// Largest distance in the resting pose between a point and the cloth over it, metres.
const OVER: f32 = 0.02;
/// Number of nearest vertices among which the cloth over a point is searched.
const AROUND: NonZeroUsize = NonZeroUsize::new(16).expect("not zero");

impl Person<'_> {
    /// The mean of `depth` over the charts of the vertex's parts, so that edges run smoothly from part to part.
    fn blend(&self, vertex: &Vertex, depth: impl Fn(Place) -> f32) -> f32 {
        let (mut sum, mut shares) = (0.0, 0.0);
        for (part, share) in vertex.parts.iter().enumerate().filter(|(_, share)| **share > 0.0) {
            sum += share * depth(self.place_on(part, vertex)).clamp(-FAR, FAR);
            shares += share;
        }
        if shares > 0.0 { sum / shares } else { -FAR }
    }

    /// Distance from the top's edges in metres, positive inside the top.
    pub fn in_top(&self, vertex: &Vertex) -> f32 {
        self.blend(vertex, |at| match at.kind {
            Kind::Trunk => (at.along - self.marks.hem).min(self.marks.collar(at.angle) - at.along),
            Kind::Arm => self.outfit.sleeve * at.length - at.along,
            _ => -FAR,
        })
    }

    /// Distance from the edges of trousers, or of a skirt's lining on the trunk, in metres, positive inside.
    pub fn in_bottom(&self, vertex: &Vertex) -> f32 {
        // At most 6 cm above the hem of the top.
        let band = self.marks.waistband.min(self.marks.hem + 0.06);
        self.blend(vertex, |at| match (at.kind, self.outfit.lower) {
            (Kind::Trunk, _) => band - at.along,
            (Kind::Leg, Lower::Trousers { length, .. }) => length * at.length - at.along,
            // Shorts under a skirt.
            (Kind::Leg, Lower::Skirt { .. }) => 0.05 - at.along,
            _ => -FAR,
        })
    }

    pub fn in_shoes(&self, vertex: &Vertex) -> f32 {
        self.blend(vertex, |at| match at.kind {
            Kind::Foot => FAR,
            Kind::Leg => at.along - (at.length - (self.outfit.boots * at.length).max(0.025)),
            _ => -FAR,
        })
    }

    pub fn skin(&self) -> Piece {
        let body = &self.library.groups["body"];
        let shown: Vec<[u32; 4]> =
            body.iter().copied().filter(|face| !face.iter().all(|row| self.worn.hides(*row))).collect();
        let patch = Patch::of(&self.vertices, &shown).subdivided(self.detail.steps(1));
        let parts = patch.vertices.iter().map(|vertex| self.rows[vertex.part()] as u8).collect();
        Piece { patch, parts }
    }

    /// Skin, pressed in below the garments over it.
    pub fn pressed_skin(&self, mut skin: Piece, garments: &[Piece]) -> Piece {
        let depth =
            |vertex: &Vertex| self.in_top(vertex).max(self.in_bottom(vertex)).max(self.in_shoes(vertex));
        let depths: Vec<f32> = skin.patch.vertices.iter().map(depth).collect();
        for garment in garments {
            press_in(&mut skin.patch, &depths, &garment.patch, GAP);
        }
        skin
    }

    /// A layer of cloth over the body: the part of the tights where `inside` is positive, moved outwards by `thick`
    /// metres. Its colours come from the charts of `kinds`, even where the layer extends a little beyond these charts.
    fn layer(
        &self,
        kinds: &[Kind],
        inside: impl Fn(&Vertex) -> f32,
        thick: impl Fn(&Vertex) -> f32,
    ) -> Piece {
        let mut patch = self.tights.clone();
        patch.inflate(thick);
        let patch = patch.cut(inside);
        let own = |vertex: &Vertex| {
            let parts = (0..PARTS).filter(|part| kinds.contains(&ORDER[*part].0));
            let most = parts.max_by(|a, b| vertex.parts[*a].total_cmp(&vertex.parts[*b]));
            self.rows[most.unwrap_or(0)] as u8
        };
        let parts = patch.vertices.iter().map(own).collect();
        Piece { patch, parts }
    }

    pub fn folds(&self, vertex: &Vertex) -> f32 {
        let p = vertex.rest;
        self.outfit.folds * noise(Vec3::new(p.x * 24.0, p.y * 30.0, p.z * 24.0), self.outfit.seed)
    }

    /// Distance of trousers from the body, metres.
    fn off_bottom(&self, vertex: &Vertex) -> f32 {
        let at = self.place(vertex);
        let down = (at.along / at.length).clamp(0.0, 1.0);
        let flare = match (at.kind, self.outfit.lower) {
            (Kind::Leg, Lower::Trousers { flare, .. }) => flare * down * down,
            _ => 0.0,
        };
        0.001 + 0.5 * self.outfit.lower_thickness + flare + self.folds(vertex)
    }

    /// The bottom and the top. The bottom is pressed in below the top, as skin is below both.
    pub fn layers(&self) -> [Piece; 2] {
        let top = self.top();
        let kinds = [Kind::Trunk, Kind::Leg];
        let mut bottom = self.layer(&kinds, |at| self.in_bottom(at), |at| self.off_bottom(at));
        let depth = |vertex: &Vertex| self.in_top(vertex).min(self.in_bottom(vertex));
        let depths: Vec<f32> = bottom.patch.vertices.iter().map(depth).collect();
        // With the whole gap, four times as many vertices come through at creases.
        press_in(&mut bottom.patch, &depths, &top.patch, 0.5 * GAP);
        [bottom, top]
    }

    fn top(&self) -> Piece {
        let thick = |vertex: &Vertex| {
            let at = self.place(vertex);
            let share = (at.along / (self.outfit.sleeve * at.length).max(0.05)).clamp(0.0, 1.0);
            let flare = if at.kind == Kind::Arm { self.outfit.sleeve_flare * share * share } else { 0.0 };
            // Collars lie close to the neck.
            let collar = self.marks.collar(at.angle);
            let close = smoothstep(collar - 0.09, collar - 0.02, at.along);
            let loose = if at.kind == Kind::Trunk { 1.0 - close } else { 1.0 };
            let off = 0.006 + loose * (0.8 * self.outfit.top_thickness + flare + 1.5 * self.folds(vertex));
            // The top hangs over the trousers.
            let over = smoothstep(-0.03, 0.0, self.in_bottom(vertex));
            off.max(over * (self.off_bottom(vertex) + GAP))
        };
        self.layer(&[Kind::Trunk, Kind::Arm], |vertex| self.in_top(vertex), thick)
    }

    pub fn shoes(&self) -> Piece {
        let thick = |vertex: &Vertex| {
            let at = self.place(vertex);
            let sole = if at.kind == Kind::Foot && at.angle.abs() > 2.2 { 0.008 } else { 0.0 };
            0.004 + 0.6 * self.outfit.shoe_thickness + sole
        };
        self.layer(&[Kind::Leg, Kind::Foot], |vertex| self.in_shoes(vertex), thick)
    }

    /// Indices of skirts and tails of coats.
    pub fn drapes(&self) -> impl Iterator<Item = usize> {
        (0..self.body.parts.len()).filter(|row| self.body.parts[*row].kind == Kind::Skirt)
    }

    /// A skirt or the tail of a coat. `under`: the pieces below it, from the inside out.
    pub fn skirt(&self, row: usize, under: &[&Piece]) -> Piece {
        let part = &self.body.parts[row];
        let is_coat = part.side == 1;
        let along = |vertex: &Vertex| part.chart(vertex.rest).1;
        let mut patch = self.group("helper-skirt").subdivided(self.detail.steps(2));
        let off = if is_coat { 0.012 } else { 0.004 } + self.outfit.lower_thickness;
        // Close to the body at the waist.
        let loose = |vertex: &Vertex| smoothstep(0.0, 0.08, along(vertex));
        let folds = |vertex: &Vertex| {
            let p = vertex.rest - self.figure.pelvis.start;
            let angle = libm::atan2f(p.x, p.z);
            let down = smoothstep(0.0, 0.5, -p.y);
            0.012 * down * noise(Vec3::new(2.2 * angle, 1.5 * p.y, 0.0), self.outfit.seed)
        };
        patch.inflate(|vertex| loose(vertex) * off + folds(vertex));
        let band = if is_coat { -1.0 } else { 0.0 };
        let inside = |along: f32| (part.length - along).min(along - band).clamp(-FAR, FAR);
        let mut patch = patch.cut(|vertex| inside(along(vertex)));
        for piece in under {
            push_out(&mut patch, &piece.patch, true, |vertex| GAP * (0.5 + 1.5 * loose(vertex)));
        }
        let parts = vec![row as u8; patch.vertices.len()];
        Piece { patch, parts }
    }

    /// Hair, meshed around the resting head and moved with it.
    pub fn hair(&self, skin: &Piece) -> Option<Piece> {
        let row = self.body.parts.iter().position(|part| part.kind == Kind::Hair)?;
        let hair = Body { parts: vec![self.body.parts[row].clone()] };
        let Surface { positions, faces, .. } = surface::mesh(&hair, self.detail.length(HAIR_CELL));
        let head = self.placed[self.head];
        let vertex = |p: &Vec3| Vertex { rest: *p, posed: head.apply(*p), parts: [0.0; PARTS] };
        let vertices: Vec<Vertex> = positions.iter().map(vertex).collect();
        let mut patch = Patch { vertices, faces: faces.into_iter().map(|f| f.to_vec()).collect() };
        push_out(&mut patch, &skin.patch, false, |_| 0.006);
        // The face stays free: an ellipse around the mouth, up to above the brows.
        let face = &self.face;
        let patch = patch.cut(|vertex| {
            let at = self.place_on(HEAD, vertex);
            let up = (at.along / at.length - face.mouth) / (face.brow + 0.07 - face.mouth);
            Vec2::new(at.angle / 1.05, up).length() - 1.0
        });
        let parts = vec![row as u8; patch.vertices.len()];
        Some(Piece { patch, parts })
    }
}

/// Moves vertices that lie inside `solid`, or less than `gap` metres outside, to a distance of `gap`. With `spans`
/// they move along their own normals, so that cloth spans the folds of the piece below.
fn push_out(patch: &mut Patch, solid: &Patch, spans: bool, gap: impl Fn(&Vertex) -> f32) {
    let normals = solid.normals();
    if solid.vertices.is_empty() {
        return;
    }
    let places = coordinates(patch.vertices.iter().map(|vertex| vertex.posed));
    let tree = tree(solid.vertices.iter().map(|vertex| vertex.posed));
    let found = tree.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
    // Deeper inside, the nearest skin may belong to the other side of the body.
    let deepest = 0.05;
    let own = patch.normals();
    for ((vertex, found), own) in patch.vertices.iter_mut().zip(&found).zip(own) {
        let nearest = found.item as usize;
        let (skin, normal) = (solid.vertices[nearest].posed, normals[nearest]);
        let out = (vertex.posed - skin).dot(normal);
        let along = if spans { own } else { normal };
        let (gap, facing) = (gap(vertex), along.dot(normal));
        if facing > 0.3 && out < gap && out > -deepest && (vertex.posed - skin).length() < deepest {
            vertex.posed += along * ((gap - out) / facing).min(deepest);
        }
    }
}

/// Moves skin in until it lies `gap` metres below the cloth over it. The resting pose decides which cloth lies over a
/// vertex, since in the pose the cloth of another limb may be nearer. `depths`: depth of each vertex inside garments.
fn press_in(skin: &mut Patch, depths: &[f32], cloth: &Patch, gap: f32) {
    let normals = cloth.normals();
    if cloth.vertices.is_empty() {
        return;
    }
    let press = |vertex: &mut Vertex, depth: f32, cloth_row: usize| {
        let out = (vertex.posed - cloth.vertices[cloth_row].posed).dot(normals[cloth_row]);
        // Covered skin meets bare skin at hems.
        let gap = gap * smoothstep(0.0, 0.015, depth);
        vertex.posed -= normals[cloth_row] * (out + gap).clamp(0.0, 0.05);
    };
    let covered: Vec<usize> = (0..depths.len()).filter(|row| depths[*row] > 0.0).collect();
    // First the cloth that is nearest in the resting pose, however far away it is in the pose.
    let places = coordinates(covered.iter().map(|row| skin.vertices[*row].rest));
    let rest = tree(cloth.vertices.iter().map(|vertex| vertex.rest));
    let found = rest.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
    for (row, found) in covered.iter().zip(&found).filter(|(_, found)| found.distance < OVER * OVER) {
        press(&mut skin.vertices[*row], depths[*row], found.item as usize);
    }
    // Then the cloth that is nearest in the pose, among cloth that is near in the resting pose.
    let posed = tree(cloth.vertices.iter().map(|vertex| vertex.posed));
    for _ in 0..4 {
        let places = coordinates(covered.iter().map(|row| skin.vertices[*row].posed));
        let found = posed.query_batch(&places).nearest_n::<SquaredEuclidean<f32>>(AROUND).execute();
        for (row, found) in covered.iter().zip(&found) {
            let vertex = &mut skin.vertices[*row];
            let over = found.iter().find(|found| {
                (cloth.vertices[found.item as usize].rest - vertex.rest).length_squared() < OVER * OVER
            });
            if let Some(over) = over {
                press(vertex, depths[*row], over.item as usize);
            }
        }
    }
}
