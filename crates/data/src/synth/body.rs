//! The body and its clothes as signed distances.
//!
//! A person is made of parts, each of a few tapered capsules and ellipsoids that flow into one another. A part has an axis,
//! along and around which cloth and skin are laid; a layer of cloth moves the part's surface outwards. Distances are lower
//! bounds close to the truth (they are exact for round shapes), which is all that meshing needs.

use std::f32::consts::PI;
use std::ops::Range;

use glam::{Mat3, Vec2, Vec3};

use super::figure::{Bone, Figure, sign};
use super::math::{noise, sin_cos, smooth_min, smoothstep};
use super::outfit::{Cut, Lower, Outfit};

/// A shape in a frame of its own.
#[derive(Debug, Clone, Copy)]
struct Shape {
    /// Start and end in the frame; equal for an ellipsoid.
    start: Vec3,
    axis: Vec3,
    /// World → frame, where the shape is round.
    turn: Mat3,
    squeeze: Vec3,
    radii: [f32; 2],
    /// Smallest of the squeezes: distances in the frame times this are lower bounds outside.
    scale: f32,
    bound: (Vec3, f32),
}

impl Shape {
    /// From `a` to `b` with radii there, flattened to `flat` (shares of the radius along right, up, front).
    fn capsule(a: Vec3, b: Vec3, radii: [f32; 2], frame: Mat3, flat: Vec3) -> Self {
        let turn = frame.transpose();
        let reach = (b - a).length() / 2.0 + radii[0].max(radii[1]) * flat.max_element();
        Self {
            start: turn * a / flat,
            axis: turn * (b - a) / flat,
            turn,
            squeeze: flat,
            radii,
            scale: flat.min_element(),
            bound: ((a + b) / 2.0, reach),
        }
    }

    fn ellipsoid(centre: Vec3, radii: Vec3, frame: Mat3) -> Self {
        let radius = radii.max_element();
        Self::capsule(centre, centre, [radius; 2], frame, radii / radius)
    }

    fn distance(&self, p: Vec3) -> f32 {
        let q = self.turn * p / self.squeeze - self.start;
        let length = self.axis.length_squared();
        let along = if length > 0.0 { (q.dot(self.axis) / length).clamp(0.0, 1.0) } else { 0.0 };
        let radius = self.radii[0] + (self.radii[1] - self.radii[0]) * along;
        ((q - along * self.axis).length() - radius) * self.scale
    }
}

/// What a part is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    Trunk,
    Arm,
    Hand,
    Leg,
    Foot,
    Head,
    Hair,
    Skirt,
}

/// Cloth over a part of its axis.
#[derive(Debug, Clone, Copy)]
struct Layer {
    from: f32,
    to: f32,
    thickness: f32,
    /// More thickness towards `to`.
    flare: f32,
    folds: f32,
    /// How much earlier it ends in front and behind.
    drop: [f32; 2],
}

impl Layer {
    fn new(span: Range<f32>, thickness: f32, flare: f32, folds: f32) -> Self {
        Self { from: span.start, to: span.end, thickness, flare, folds, drop: [0.0; 2] }
    }
}

/// How much lower a neckline hangs at this angle, by its depth in front and behind.
pub fn neckline([front, behind]: [f32; 2], angle: f32) -> f32 {
    let cosine = sin_cos(angle).1;
    let depth = if cosine > 0.0 { front } else { behind };
    depth * cosine * cosine
}

/// A piece of the body with its clothes.
#[derive(Debug, Clone)]
pub struct Part {
    pub kind: Kind,
    /// 0: left, 1: right; 0 for the middle.
    pub side: usize,
    shapes: Vec<Shape>,
    /// Radius of the curves between the shapes.
    blend: f32,
    /// Radius of the curve towards the trunk, at the start of the axis; it vanishes along the first bone.
    joint: f32,
    axis: Vec<Bone>,
    /// Metres of cloth around it, over 2π.
    pub radius: f32,
    pub length: f32,
    layers: Vec<Layer>,
    bound: (Vec3, f32),
    seed: u32,
    drape: Option<Drape>,
}

/// Cloth that hangs from the waist: a cone around a vertical axis, with folds.
#[derive(Debug, Clone, Copy)]
struct Drape {
    top: f32,
    bottom: f32,
    /// Middle and half axes of the ellipse at the top and at the bottom.
    ends: [(Vec2, Vec2); 2],
    folds: f32,
    depth: f32,
    seed: u32,
}

impl Drape {
    fn distance(&self, p: Vec3) -> f32 {
        let t = ((self.top - p.y) / (self.top - self.bottom)).clamp(0.0, 1.0);
        let [(c0, r0), (c1, r1)] = self.ends;
        let (centre, radii) = (c0.lerp(c1, t), r0.lerp(r1, t));
        let q = Vec2::new(p.x, p.z) - centre;
        let angle = libm::atan2f(q.x, q.y);
        let sway = 1.3 * (noise(Vec3::new(3.0 * t, 0.0, 0.0), self.seed) - 0.5);
        let fold = 1.0 + self.depth * smoothstep(0.05, 1.0, t) * sin_cos(self.folds * angle + sway).0;
        let scale = radii.min_element();
        // The surface leans, so the distance to it is shorter than the one sideways.
        let aside = ((q / radii).length() - fold) * scale * 0.9;
        aside.max(self.bottom - p.y).max(p.y - self.top)
    }
}

impl Part {
    fn new(kind: Kind, side: usize, shapes: Vec<Shape>, blend: f32, axis: Vec<Bone>, radius: f32) -> Self {
        let length = axis.iter().map(|bone| (bone.end - bone.start).length()).sum();
        let centre = shapes.iter().map(|s| s.bound.0).sum::<Vec3>() / shapes.len().max(1) as f32;
        let reach = shapes.iter().map(|s| (s.bound.0 - centre).length() + s.bound.1).fold(0.0, f32::max);
        Self {
            kind,
            side,
            shapes,
            blend,
            joint: 0.0,
            axis,
            radius,
            length,
            layers: Vec::new(),
            bound: (centre, reach),
            seed: 0,
            drape: None,
        }
    }

    /// Where on the part's chart a point lies: angle around the axis (0 in front, towards +x up to π) and metres along it.
    pub fn chart(&self, p: Vec3) -> (f32, f32) {
        let mut best = (f32::INFINITY, 0.0, 0.0);
        let mut before = 0.0;
        for (i, bone) in self.axis.iter().enumerate() {
            let axis = bone.end - bone.start;
            let length = axis.length();
            let mut t = (p - bone.start).dot(axis) / (length * length);
            // Caps continue the first and the last bone.
            if i > 0 {
                t = t.max(0.0);
            }
            if i + 1 < self.axis.len() {
                t = t.min(1.0);
            }
            let d = p - bone.start - t * axis;
            if d.length() < best.0 {
                let local = bone.frame.transpose() * d;
                best = (d.length(), libm::atan2f(local.x, local.z), before + t * length);
            }
            before += length;
        }
        (best.1, best.2)
    }

    /// How far cloth lies over the skin at a place of the chart.
    fn thickness(&self, p: Vec3, (angle, along): (f32, f32)) -> f32 {
        let mut thickest = 0.0_f32;
        for layer in &self.layers {
            // A hem is as steep as cloth is thick.
            let to = layer.to - neckline(layer.drop, angle);
            let there = smoothstep(layer.from - 0.004, layer.from + 0.004, along)
                * (1.0 - smoothstep(to - 0.004, to + 0.004, along));
            if there > 0.0 {
                let share = ((along - layer.from) / (layer.to - layer.from)).clamp(0.0, 1.0);
                let crumple = Vec3::new(p.x * 22.0, p.y * 30.0, p.z * 22.0);
                let fold = layer.folds * (2.0 * noise(crumple, self.seed) - 1.0);
                thickest = thickest.max(there * (layer.thickness + layer.flare * share * share + fold));
            }
        }
        thickest
    }

    /// Distance to the part's surface, clothes included.
    fn distance(&self, p: Vec3) -> f32 {
        if let Some(drape) = &self.drape {
            return drape.distance(p);
        }
        let mut skin = f32::INFINITY;
        for shape in &self.shapes {
            let d = shape.distance(p);
            skin = if skin.is_finite() { smooth_min(skin, d, self.blend) } else { d };
        }
        if self.layers.is_empty() { skin } else { skin - self.thickness(p, self.chart(p)) }
    }
}

/// A dressed person.
#[derive(Debug, Clone)]
pub struct Body {
    /// The trunk first.
    pub parts: Vec<Part>,
}

/// Cloth is at most this thick, with everything that folds and flares add.
const THICKEST: f32 = 0.08;

impl Body {
    /// Signed distance and the part that is nearest. Where all of the body is further than `enough`, any number between
    /// `enough` and the distance.
    pub fn distance(&self, p: Vec3, enough: f32) -> (f32, usize) {
        let mut union = f32::INFINITY;
        let mut nearest = (f32::INFINITY, 0);
        for (index, part) in self.parts.iter().enumerate() {
            let outside = (p - part.bound.0).length() - part.bound.1 - THICKEST;
            if part.drape.is_none() && outside > enough.max(0.0) + 0.06 && outside > 0.06 {
                union = union.min(outside);
                continue;
            }
            let d = part.distance(p);
            if d < nearest.0 {
                nearest = (d, index);
            }
            let joint = if part.joint > 0.0 {
                // Limbs flow into the trunk where they begin and pass it freely further on.
                let along = part.chart(p).1;
                part.joint * (1.0 - smoothstep(0.0, 0.5 * part.length, along)) + 0.004
            } else {
                0.004
            };
            union = if union.is_finite() { smooth_min(union, d, joint) } else { d };
        }
        (union, nearest.1)
    }

    /// A box around everything.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.parts.iter().fold(start, |(low, high), part| {
            if let Some(drape) = &part.drape {
                let reach = |(c, r): (Vec2, Vec2)| (c - r * 1.3, c + r * 1.3);
                let [(a, b), (c, d)] = drape.ends.map(reach);
                let (from, to) = (a.min(c), b.max(d));
                let low = low.min(Vec3::new(from.x, drape.bottom, from.y));
                return (low, high.max(Vec3::new(to.x, drape.top, to.y)));
            }
            part.shapes.iter().fold((low, high), |(low, high), shape| {
                let reach = Vec3::splat(shape.bound.1 + THICKEST);
                (low.min(shape.bound.0 - reach), high.max(shape.bound.0 + reach))
            })
        })
    }

    /// The person in the clothes.
    pub fn new(figure: &Figure, outfit: &Outfit) -> Self {
        let mut parts = vec![trunk(figure, outfit), head(figure, outfit)];
        parts.extend(hair(figure, outfit));
        for side in 0..2 {
            parts.push(arm(figure, outfit, side));
            parts.push(hand(figure, side));
            parts.push(leg(figure, outfit, side));
            parts.push(foot(figure, outfit, side));
        }
        parts.extend(drapes(figure, outfit));
        for (index, part) in parts.iter_mut().enumerate() {
            part.seed = outfit.seed ^ index as u32;
        }
        Self { parts }
    }
}

fn trunk(figure: &Figure, outfit: &Outfit) -> Part {
    let Figure { build, pelvis, chest, neck, .. } = figure;
    let (h, sex, girth) = (build.stature, build.sex, build.girth);
    let flat = Vec3::new(1.0, 1.0, 0.72);
    let hips = h * girth * (0.094 - 0.008 * sex);
    let waist = h * girth * (0.068 + 0.012 * sex + 0.012 * build.belly);
    let ribs = h * girth * (0.082 + 0.009 * sex) * build.shoulders;
    let mut shapes = vec![
        Shape::capsule(pelvis.at(0.05, Vec3::ZERO), pelvis.end, [hips, waist], pelvis.frame, flat),
        Shape::capsule(pelvis.end, chest.at(0.62, Vec3::ZERO), [waist, ribs], chest.frame, flat),
        Shape::capsule(
            chest.at(0.62, Vec3::ZERO),
            chest.at(0.9, Vec3::ZERO),
            [ribs, 0.058 * h],
            chest.frame,
            flat,
        ),
        Shape::capsule(
            chest.at(0.86, Vec3::ZERO),
            neck.at(0.3, Vec3::ZERO),
            [0.05 * h, 0.034 * h],
            chest.frame,
            flat,
        ),
        Shape::capsule(
            neck.start,
            neck.end,
            [0.033 * h * (0.9 + 0.15 * sex), 0.031 * h],
            neck.frame,
            Vec3::ONE,
        ),
    ];
    for side in 0..2 {
        let shoulder = figure.upper_arms[side].start;
        let joint = chest.at(0.78, Vec3::new(sign(side) * 0.03 * h, 0.0, 0.0));
        shapes.push(Shape::capsule(
            joint,
            shoulder,
            [0.045 * h, 0.034 * h * girth],
            chest.frame,
            Vec3::new(1.0, 1.0, 0.9),
        ));
        let seat = pelvis.at(0.05, Vec3::new(sign(side) * 0.045 * h, -0.01 * h, -0.035 * h));
        shapes.push(Shape::ellipsoid(seat, Vec3::splat(0.055 * h * girth), pelvis.frame));
        if sex < 0.6 {
            let size = h * (0.034 + 0.012 * (0.6 - sex)) * girth;
            let bust = chest.at(0.5, Vec3::new(sign(side) * 0.042 * h, 0.0, 0.05 * h * girth));
            shapes.push(Shape::ellipsoid(bust, Vec3::new(size, size, size * 0.95), chest.frame));
        }
    }
    if build.belly > 0.0 {
        let belly = chest.at(0.08, Vec3::new(0.0, 0.0, 0.03 * h * (1.0 + build.belly)));
        let size = h * girth * (0.05 + 0.028 * build.belly);
        shapes.push(Shape::ellipsoid(belly, Vec3::new(1.15, 1.1, 0.9) * size, chest.frame));
    }
    // The chart begins below the crotch, so that everything has a place on it.
    let below = Bone { start: pelvis.at(-0.7, Vec3::ZERO), end: pelvis.end, frame: pelvis.frame };
    let axis = vec![below, *chest, *neck];
    let mut part = Part::new(Kind::Trunk, 0, shapes, 0.06, axis, 0.085 * h * girth);
    let marks = Marks::of(figure, outfit);
    let top = Layer::new(marks.hem..marks.collar, outfit.top_thickness, 0.0, outfit.folds);
    part.layers.push(Layer { drop: marks.neckline, ..top });
    part.layers.push(Layer::new(-1.0..marks.waistband, outfit.lower_thickness, 0.0, 0.5 * outfit.folds));
    part
}

/// Places along the trunk's axis, metres from its start.
#[derive(Debug, Clone, Copy)]
pub struct Marks {
    pub hem: f32,
    pub waistband: f32,
    pub collar: f32,
    /// How much lower the neckline is in front and behind.
    pub neckline: [f32; 2],
}

impl Marks {
    pub fn of(figure: &Figure, outfit: &Outfit) -> Self {
        let length = |bone: &Bone| (bone.end - bone.start).length();
        let crotch = 0.7 * length(&figure.pelvis);
        let waist = crotch + length(&figure.pelvis);
        let base = waist + length(&figure.chest);
        Self {
            hem: waist - outfit.top_length.min(1.0) * length(&figure.pelvis),
            waistband: waist - 0.06 * length(&figure.pelvis),
            // The slope from the shoulders to the neck stays covered, however low the neckline.
            collar: base + outfit.collar.max(0.45) * length(&figure.neck),
            neckline: [
                (0.45 - outfit.collar).max(0.1) * 1.3 * length(&figure.neck),
                (0.45 - outfit.collar).max(0.1) * 0.4 * length(&figure.neck),
            ],
        }
    }
}

fn head(figure: &Figure, outfit: &Outfit) -> Part {
    let Figure { head, neck, build, .. } = figure;
    let size = (head.end - head.start).length();
    let f = head.frame;
    let at = |x: f32, y: f32, z: f32| head.at(0.0, size * Vec3::new(x, y, z));
    let ball = |x: f32, y: f32, z: f32, r: [f32; 3]| Shape::ellipsoid(at(x, y, z), size * Vec3::from(r), f);
    let jaw = 0.2 + 0.03 * build.sex;
    let mut shapes = vec![
        ball(0.0, 0.62, -0.03, [0.345, 0.38, 0.42]),
        Shape::capsule(
            at(0.0, 0.5, 0.12),
            at(0.0, 0.06, 0.27),
            [0.29 * size, jaw * size * 0.75],
            f,
            Vec3::new(1.0, 1.0, 0.85),
        ),
        Shape::capsule(at(0.0, 0.3, 0.0), neck.at(0.4, Vec3::ZERO), [0.24 * size, 0.21 * size], f, Vec3::ONE),
        // Nose, brow, lips.
        Shape::capsule(
            at(0.0, 0.5, 0.37),
            at(0.0, 0.31, 0.475),
            [0.03 * size, 0.055 * size],
            f,
            Vec3::new(0.9, 1.0, 1.0),
        ),
        Shape::capsule(at(-0.16, 0.545, 0.33), at(0.16, 0.545, 0.33), [0.04 * size; 2], f, Vec3::ONE),
        ball(0.0, 0.185, 0.385, [0.1, 0.035, 0.05]),
    ];
    for side in [-1.0, 1.0] {
        shapes.push(ball(side * 0.36, 0.42, -0.04, [0.04, 0.125, 0.075]));
        shapes.push(ball(side * 0.165, 0.35, 0.24, [0.1, 0.1, 0.11]));
    }
    if outfit.glasses {
        for side in [-1.0, 1.0] {
            shapes.push(ball(side * 0.16, 0.45, 0.41, [0.12, 0.1, 0.035]));
        }
    }
    let mut part = Part::new(Kind::Head, 0, shapes, 0.014, vec![*head], 0.36 * size);
    part.joint = 0.02;
    part
}

fn hair(figure: &Figure, outfit: &Outfit) -> Vec<Part> {
    let head = &figure.head;
    let size = (head.end - head.start).length();
    let f = head.frame;
    let at = |x: f32, y: f32, z: f32| head.at(0.0, size * Vec3::new(x, y, z));
    let ball = |x: f32, y: f32, z: f32, r: [f32; 3]| Shape::ellipsoid(at(x, y, z), size * Vec3::from(r), f);
    let lock = |a: Vec3, b: Vec3, r: [f32; 2], flat: [f32; 3]| {
        Shape::capsule(a, b, r.map(|r| r * size), f, Vec3::from(flat))
    };
    // Higher at the forehead, lower at the back, ears free.
    let crown = |thick: f32| ball(0.0, 0.68, -0.075, [0.345 + thick, 0.355 + thick, 0.4 + thick]);
    let nape = |thick: f32| ball(0.0, 0.46, -0.2, [0.29 + thick, 0.3 + thick, 0.25 + thick]);
    let chest = &figure.chest;
    let shapes = match outfit.cut {
        Cut::Bald => return Vec::new(),
        Cut::Short => vec![crown(0.03), nape(0.02)],
        Cut::Curls => vec![crown(0.12), nape(0.07)],
        Cut::Cap => vec![
            crown(0.045),
            nape(0.02),
            lock(at(-0.16, 0.79, 0.36), at(0.16, 0.79, 0.36), [0.19; 2], [1.0, 0.16, 1.5]),
        ],
        Cut::Bob => vec![
            crown(0.05),
            nape(0.08),
            lock(at(0.34, 0.55, -0.05), at(0.33, 0.1, 0.0), [0.13, 0.1], [0.7, 1.0, 1.5]),
            lock(at(-0.34, 0.55, -0.05), at(-0.33, 0.1, 0.0), [0.13, 0.1], [0.7, 1.0, 1.5]),
            lock(at(0.0, 0.45, -0.28), at(0.0, 0.05, -0.25), [0.3, 0.27], [1.0, 1.0, 0.6]),
        ],
        Cut::Long => vec![
            crown(0.05),
            nape(0.08),
            lock(at(0.32, 0.55, -0.12), at(0.3, 0.05, -0.12), [0.14, 0.12], [0.7, 1.0, 1.3]),
            lock(at(-0.32, 0.55, -0.12), at(-0.3, 0.05, -0.12), [0.14, 0.12], [0.7, 1.0, 1.3]),
            lock(
                at(0.0, 0.4, -0.3),
                chest.at(0.72, Vec3::new(0.0, 0.0, -0.1 * figure.build.stature * figure.build.girth * 0.68)),
                [0.33, 0.3],
                [1.0, 1.0, 0.4],
            ),
        ],
        Cut::Bun => vec![crown(0.035), nape(0.03), ball(0.0, 0.78, -0.5, [0.17, 0.17, 0.16])],
        Cut::Tail => vec![
            crown(0.035),
            nape(0.03),
            lock(at(0.0, 0.66, -0.46), at(0.0, 0.55, -0.62), [0.08, 0.11], [1.0; 3]),
            lock(at(0.0, 0.55, -0.62), at(0.0, -0.1, -0.55), [0.12, 0.05], [1.0; 3]),
        ],
    };
    let mut part = Part::new(Kind::Hair, 0, shapes, 0.03, vec![*head], 0.42 * size);
    if outfit.cut != Cut::Cap {
        // Strands and curls.
        let folds = if outfit.cut == Cut::Curls { 0.011 } else { 0.0035 };
        part.layers.push(Layer::new(-9.0..9.0, 0.0, 0.0, folds));
    }
    vec![part]
}

fn arm(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
    let (upper, fore) = (&figure.upper_arms[side], &figure.forearms[side]);
    let Figure { build, .. } = figure;
    let r = build.stature * build.girth * (0.9 + 0.15 * build.sex);
    let shapes = vec![
        Shape::capsule(upper.start, upper.end, [0.032 * r, 0.0245 * r], upper.frame, Vec3::ONE),
        Shape::capsule(
            upper.at(0.25, Vec3::ZERO),
            upper.at(0.65, 0.005 * r * Vec3::Z),
            [0.028 * r, 0.027 * r],
            upper.frame,
            Vec3::ONE,
        ),
        Shape::capsule(fore.start, fore.at(0.4, Vec3::ZERO), [0.0245 * r, 0.0255 * r], fore.frame, Vec3::ONE),
        Shape::capsule(fore.at(0.4, Vec3::ZERO), fore.end, [0.0255 * r, 0.0165 * r], fore.frame, Vec3::ONE),
    ];
    let mut part = Part::new(Kind::Arm, side, shapes, 0.01, vec![*upper, *fore], 0.03 * r);
    part.joint = 0.07;
    part.layers.push(Layer::new(
        -1.0..outfit.sleeve * part.length,
        outfit.top_thickness,
        outfit.sleeve_flare,
        outfit.folds,
    ));
    part
}

fn hand(figure: &Figure, side: usize) -> Part {
    let hand = &figure.hands[side];
    let length = (hand.end - hand.start).length();
    let inwards = -sign(side);
    let at = |x: f32, y: f32, z: f32| hand.at(0.0, length * Vec3::new(x, y, z));
    let mut shapes = vec![Shape::capsule(
        at(0.0, 0.08, 0.0),
        at(0.0, -0.36, 0.0),
        [0.19 * length, 0.235 * length],
        hand.frame,
        Vec3::new(1.0, 1.0, 0.55),
    )];
    // Palms face backwards in the hand's frame; fingers curl towards the palm.
    let (curl_sin, curl_cos) = sin_cos(figure.fingers * PI / 180.0);
    for (i, reach) in [0.43, 0.5, 0.47, 0.37].into_iter().enumerate() {
        let x = inwards * (0.165 - 0.11 * i as f32);
        let knuckle = at(x, -0.46, 0.0);
        let tip = knuckle + hand.frame * Vec3::new(x * 0.25, -curl_cos * reach, -curl_sin * reach) * length;
        shapes.push(Shape::capsule(knuckle, tip, [0.075 * length, 0.055 * length], hand.frame, Vec3::ONE));
    }
    let thumb = at(inwards * 0.3, -0.42, -0.1);
    shapes.push(Shape::capsule(
        at(inwards * 0.13, -0.1, -0.02),
        thumb,
        [0.09 * length, 0.06 * length],
        hand.frame,
        Vec3::ONE,
    ));
    let mut part = Part::new(Kind::Hand, side, shapes, 0.008, vec![*hand], 0.2 * length);
    part.joint = 0.02;
    part
}

fn leg(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
    let (thigh, calf) = (&figure.thighs[side], &figure.calves[side]);
    let Figure { build, .. } = figure;
    let r = build.stature * build.girth;
    let hip = 0.058 - 0.004 * build.sex;
    let shapes = vec![
        Shape::capsule(thigh.start, thigh.end, [hip * r, 0.034 * r], thigh.frame, Vec3::ONE),
        Shape::capsule(
            thigh.at(0.1, Vec3::ZERO),
            thigh.at(0.6, 0.006 * r * Vec3::Z),
            [0.053 * r, 0.043 * r],
            thigh.frame,
            Vec3::ONE,
        ),
        Shape::capsule(calf.start, calf.end, [0.034 * r, 0.0225 * r], calf.frame, Vec3::ONE),
        Shape::capsule(
            calf.at(0.15, -0.01 * r * Vec3::Z),
            calf.at(0.45, -0.012 * r * Vec3::Z),
            [0.03 * r, 0.029 * r],
            calf.frame,
            Vec3::ONE,
        ),
    ];
    let mut part = Part::new(Kind::Leg, side, shapes, 0.012, vec![*thigh, *calf], 0.042 * r);
    part.joint = 0.045;
    if let Lower::Trousers { length, flare } = outfit.lower {
        part.layers.push(Layer::new(-1.0..length * part.length, outfit.lower_thickness, flare, outfit.folds));
    }
    if outfit.boots > 0.0 {
        let from = (1.0 - outfit.boots) * part.length;
        part.layers.push(Layer::new(from..9.0, outfit.shoe_thickness, 0.0, 0.001));
    }
    part
}

fn foot(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
    let foot = &figure.feet[side];
    let h = figure.build.stature;
    let f = foot.frame;
    let at = |x: f32, y: f32, z: f32| foot.at(0.0, h * Vec3::new(x, y, z));
    let (heel, ball, toes) = (at(0.0, -0.021, -0.028), at(0.0, -0.0255, 0.078), at(0.0, -0.0285, 0.105));
    let flat = Vec3::new(1.0, 0.72, 1.0);
    let shapes = vec![
        Shape::capsule(at(0.0, 0.01, -0.008), heel, [0.023 * h, 0.025 * h], f, Vec3::new(0.9, 1.0, 1.0)),
        Shape::capsule(heel, ball, [0.0235 * h, 0.0255 * h], f, flat),
        Shape::capsule(ball, toes, [0.0265 * h, 0.019 * h], f, flat),
        Shape::capsule(at(0.0, 0.0, 0.0), at(0.0, -0.02, 0.06), [0.024 * h, 0.018 * h], f, Vec3::ONE),
    ];
    // Along the sole: right, towards the toes, up.
    let along = Mat3::from_cols(-f.x_axis, f.z_axis, f.y_axis);
    let axis = Bone { start: heel, end: toes, frame: along };
    let mut part = Part::new(Kind::Foot, side, shapes, 0.025, vec![axis], 0.028 * h);
    part.layers.push(Layer::new(-9.0..9.0, outfit.shoe_thickness, 0.0, 0.0));
    part
}

/// Skirts, and the tails of coats.
fn drapes(figure: &Figure, outfit: &Outfit) -> Vec<Part> {
    let mut wanted = Vec::new();
    if let Lower::Skirt { length, flare, folds } = outfit.lower {
        wanted.push((length, flare, folds as f32, outfit.lower_thickness));
    }
    if outfit.top_length > 1.0 {
        // Beyond the crotch, in shares of the leg.
        let length = 0.1 + 0.16 * (outfit.top_length - 1.0);
        wanted.push((length, 0.12, 7.0, outfit.lower_thickness + outfit.top_thickness));
    }
    let Figure { build, pelvis, thighs, calves, .. } = figure;
    let (h, girth) = (build.stature, build.girth);
    let leg = h * (0.245 + 0.246) * build.legs;
    let make = |(length, flare, folds, thickness): (f32, f32, f32, f32)| {
        let waist = pelvis.end;
        let bottom = pelvis.start.y - length * leg;
        let top = waist.y + 0.01;
        // Wide enough for the legs at every height down to the hem.
        let mut centre = Vec2::ZERO;
        let mut reach = Vec2::splat(0.0);
        let points: Vec<Vec3> = (0..2)
            .flat_map(|side| {
                [&thighs[side], &calves[side]]
                    .into_iter()
                    .flat_map(|bone| (0..=10).map(|i| bone.at(i as f32 / 10.0, Vec3::ZERO)))
            })
            .filter(|p| p.y > bottom - 0.02)
            .collect();
        if let Some(first) = points.first() {
            let (low, high) = points.iter().fold((*first, *first), |(l, h), p| (l.min(*p), h.max(*p)));
            let middle = (low + high) / 2.0;
            centre = Vec2::new(middle.x, middle.z);
            reach = Vec2::new(high.x - low.x, high.z - low.z) / 2.0;
        }
        let hips = h * girth * (0.098 - 0.008 * build.sex);
        let limb = 0.058 * h * girth + 0.012 + thickness;
        // An ellipse around two legs side by side is wider than their box.
        let hem = (1.15 * reach + Vec2::splat(limb)).max(Vec2::new(1.0 + flare, 0.8 + flare) * hips);
        let top_radii = Vec2::new(1.0, 0.8) * h * girth * (0.072 + 0.012 * build.sex + 0.012 * build.belly)
            + Vec2::splat(thickness + 0.004);
        // The hips must fit as well, though the cone is straight from waist to hem.
        let down = (waist.y - pelvis.start.y) / (waist.y - bottom);
        let needed =
            (Vec2::new(0.116, 0.103) * h * girth + Vec2::splat(thickness) - (1.0 - down) * top_radii) / down;
        let drape = Drape {
            top,
            bottom,
            ends: [(Vec2::new(waist.x, waist.z), top_radii), (centre, hem.max(needed.min(hem * 1.6)))],
            folds,
            depth: 0.03 + 0.05 * flare.min(0.6),
            seed: outfit.seed ^ 0x5eed,
        };
        let middle = Vec3::new(waist.x, top, waist.z);
        let axis = Bone { start: middle, end: middle - Vec3::Y * (top - bottom), frame: Mat3::IDENTITY };
        let radius = hem.element_sum() / 2.0;
        let mut part = Part::new(Kind::Skirt, 0, Vec::new(), 0.02, vec![axis], radius);
        part.drape = Some(drape);
        part.side = usize::from(outfit.top_length > 1.0);
        part
    };
    wanted.into_iter().map(make).collect()
}
