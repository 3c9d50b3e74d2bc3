//! Parts of a body: each is a smooth union of a few tapered capsules and ellipsoids.
//!
//! The axis of a part defines its chart, where cloth and skin are painted. A layer of cloth moves the part's surface
//! outwards. Distances are exact for round shapes and close lower bounds otherwise, which is enough for meshing.

use std::ops::Range;

use glam::{Mat3, Vec2, Vec3, Vec3Swizzles};

use super::outfit::Outfit;
use crate::figure::{Bone, Figure};
use crate::math::{noise, smooth_min, smoothstep};

/// A tapered capsule or an ellipsoid. In its own frame the shape is round.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    /// Start and end in the frame; equal for an ellipsoid.
    start: Vec3,
    axis: Vec3,
    /// World → frame, before the division by `squeeze`.
    turn: Mat3,
    squeeze: Vec3,
    radii: [f32; 2],
    /// Smallest squeeze. Outside, distances in the frame times this factor are lower bounds.
    scale: f32,
    /// Centre and radius of a sphere around the shape.
    pub bound: (Vec3, f32),
}

impl Shape {
    /// A capsule from `a` to `b` with a radius at each end. `flat`: factors of the radii along right, up, front.
    pub fn capsule(a: Vec3, b: Vec3, radii: [f32; 2], frame: Mat3, flat: Vec3) -> Self {
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

    pub fn ellipsoid(centre: Vec3, radii: Vec3, frame: Mat3) -> Self {
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

impl Bone {
    /// A round capsule from `a` to `b` in the axes of this bone.
    pub fn capsule(&self, a: Vec3, b: Vec3, radii: [f32; 2]) -> Shape {
        Shape::capsule(a, b, radii, self.frame, Vec3::ONE)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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

/// Cloth over a range of a part's axis. Lengths are metres.
#[derive(Debug, Clone, Copy)]
pub struct Layer {
    pub from: f32,
    to: f32,
    thickness: f32,
    /// Additional thickness at `to`.
    flare: f32,
    folds: f32,
    /// Largest [`neckline`] by which the layer ends earlier, in front and behind.
    pub drop: [f32; 2],
}

impl Layer {
    pub fn new(span: Range<f32>, thickness: f32, flare: f32, folds: f32) -> Self {
        Self { from: span.start, to: span.end, thickness, flare, folds, drop: [0.0; 2] }
    }
}

/// Depth of a neckline at this angle, from its depth in front and behind.
pub fn neckline([front, behind]: [f32; 2], angle: f32) -> f32 {
    let cosine = libm::sincosf(angle).1;
    let depth = if cosine > 0.0 { front } else { behind };
    depth * cosine * cosine
}

/// A part of the body with its clothes.
#[derive(Debug, Clone)]
pub struct Part {
    pub kind: Kind,
    /// 0: left or middle, 1: right. For skirts 1 means that there is a coat.
    pub side: usize,
    pub shapes: Vec<Shape>,
    /// Blending radius between the shapes.
    blend: f32,
    /// Blending radius with the trunk at the start of the axis. It vanishes along the first half of the axis.
    pub joint: f32,
    axis: Vec<Bone>,
    /// Metres of cloth per radian around the axis.
    pub radius: f32,
    pub length: f32,
    pub layers: Vec<Layer>,
    /// Centre and radius of a sphere around the shapes.
    pub bound: (Vec3, f32),
    pub seed: u32,
    pub drape: Option<Drape>,
}

/// Cloth that hangs from the waist: a cone around a vertical axis, with folds. `top` and `bottom` are heights.
#[derive(Debug, Clone, Copy)]
pub struct Drape {
    pub top: f32,
    pub bottom: f32,
    /// Middle and half axes of the ellipse at the top and at the bottom.
    pub ends: [(Vec2, Vec2); 2],
    pub folds: f32,
    pub depth: f32,
    pub seed: u32,
}

impl Drape {
    fn distance(&self, p: Vec3) -> f32 {
        let t = ((self.top - p.y) / (self.top - self.bottom)).clamp(0.0, 1.0);
        let [(c0, r0), (c1, r1)] = self.ends;
        let (centre, radii) = (c0.lerp(c1, t), r0.lerp(r1, t));
        let q = p.xz() - centre;
        let angle = libm::atan2f(q.x, q.y);
        let sway = 1.3 * (noise(Vec3::new(3.0 * t, 0.0, 0.0), self.seed) - 0.5);
        let fold = 1.0 + self.depth * smoothstep(0.05, 1.0, t) * libm::sincosf(self.folds * angle + sway).0;
        let scale = radii.min_element();
        // The surface leans, so that the distance to it is shorter than the horizontal one.
        let aside = ((q / radii).length() - fold) * scale * 0.9;
        aside.max(self.bottom - p.y).max(p.y - self.top)
    }
}

impl Part {
    /// A part without cloth, in the middle of the body.
    pub fn new(kind: Kind, shapes: Vec<Shape>, blend: f32, axis: Vec<Bone>, radius: f32) -> Self {
        let length = axis.iter().map(Bone::length).sum();
        let centre = shapes.iter().map(|s| s.bound.0).sum::<Vec3>() / shapes.len().max(1) as f32;
        let reach = shapes.iter().map(|s| (s.bound.0 - centre).length() + s.bound.1).fold(0.0, f32::max);
        Self {
            kind,
            side: 0,
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

    /// Chart coordinates of a point: angle around the axis (0 in front, towards +x up to π) and metres along the axis.
    pub fn chart(&self, p: Vec3) -> (f32, f32) {
        let mut best = (f32::INFINITY, 0.0, 0.0);
        let mut before = 0.0;
        for (i, bone) in self.axis.iter().enumerate() {
            let axis = bone.end - bone.start;
            let length = axis.length();
            let mut t = (p - bone.start).dot(axis) / (length * length);
            // The first and the last bone continue beyond their ends.
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

    /// Metres of cloth over the skin at `p`, whose chart coordinates are `angle` and `along`.
    fn thickness(&self, p: Vec3, (angle, along): (f32, f32)) -> f32 {
        let mut thickest = 0.0_f32;
        for layer in &self.layers {
            // The cloth thins out over 8 mm at its hem.
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
    pub fn distance(&self, p: Vec3) -> f32 {
        self.dressed(p, self.skin(p))
    }

    /// Largest thickness of the part's cloth, metres.
    pub fn thickest(&self) -> f32 {
        let most = |layer: &Layer| layer.thickness + layer.flare.max(0.0) + layer.folds.abs();
        self.layers.iter().map(most).fold(0.0, f32::max)
    }

    /// Distance to the skin.
    pub fn skin(&self, p: Vec3) -> f32 {
        let distances = self.shapes.iter().map(|shape| shape.distance(p));
        distances.reduce(|skin, d| smooth_min(skin, d, self.blend)).unwrap_or(f32::INFINITY)
    }

    /// Distance to the part's surface. `skin` is the distance to the skin; drapes ignore it.
    pub fn dressed(&self, p: Vec3, skin: f32) -> f32 {
        match &self.drape {
            Some(drape) => drape.distance(p),
            None if self.layers.is_empty() => skin,
            None => skin - self.thickness(p, self.chart(p)),
        }
    }
}

/// Places along the trunk's axis, metres from its start.
#[derive(Debug, Clone, Copy)]
pub struct Marks {
    pub hem: f32,
    pub waistband: f32,
    /// Upper edge of the top at the sides.
    pub collar: f32,
    /// Depth of the neckline in front and behind.
    pub neckline: [f32; 2],
}

impl Marks {
    pub fn of(figure: &Figure, outfit: &Outfit) -> Self {
        let [pelvis, chest, neck] = [figure.pelvis, figure.chest, figure.neck].map(|bone| bone.length());
        let waist = 0.7 * pelvis + pelvis;
        let drop = (0.45 - outfit.collar).max(0.1);
        Self {
            hem: waist - outfit.top_length.min(1.0) * pelvis,
            waistband: waist - 0.06 * pelvis,
            // The slope from the shoulders to the neck stays covered, even with a low neckline.
            collar: waist + chest + outfit.collar.max(0.45) * neck,
            neckline: [drop * 1.3 * neck, drop * 0.4 * neck],
        }
    }

    /// Upper edge of the top at this angle around the neck.
    pub fn collar(&self, angle: f32) -> f32 {
        self.collar - neckline(self.neckline, angle)
    }
}
