//! The body and its clothes as signed distances: the union of its parts.

use glam::{Vec2, Vec3};

use super::anatomy;
use super::figure::Figure;
use super::outfit::Outfit;
use super::part::{Kind, Layer, Part};
use crate::math::{smooth_min, smoothstep};

/// A dressed person.
#[derive(Debug, Clone)]
pub struct Body {
    /// The trunk first.
    pub parts: Vec<Part>,
}

/// Below the top's hem the trunk's chart goes on for so many metres, lest the hem be cut off by the legs' charts.
const HEM_REACH: f32 = 0.04;
/// Cloth is at most this thick, with everything that folds and flares add.
const THICKEST: f32 = 0.08;

impl Body {
    /// Signed distance and the part that is nearest. Where all of the body is further than `enough`, any number between
    /// `enough` and the distance.
    pub fn distance(&self, p: Vec3, enough: f32) -> (f32, usize) {
        let mut union = f32::INFINITY;
        let mut nearest = (f32::INFINITY, 0);
        // What skirts hang over.
        let mut hips = f32::INFINITY;
        for (index, part) in self.parts.iter().enumerate() {
            let outside = (p - part.bound.0).length() - part.bound.1 - THICKEST;
            if part.drape.is_none() && outside > enough.max(0.0) + 0.06 && outside > 0.06 {
                union = union.min(outside);
                continue;
            }
            let mut d = part.distance(p);
            if d < nearest.0 {
                nearest = (d, index);
            }
            match part.kind {
                Kind::Trunk | Kind::Leg => hips = hips.min(d),
                // Cloth does not show every edge of what fills it.
                Kind::Skirt if hips.is_finite() => d = smooth_min(d, hips, 0.05),
                _ => {}
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

    /// The part whose chart is laid over a place on the surface: mostly the nearest, but hips that fill a skirt show the
    /// skirt's cloth, and thighs that lie higher than the top's hem show the trunk's.
    pub fn owner(&self, p: Vec3, cell: f32) -> usize {
        let nearest = self.distance(p, 4.0 * cell).1;
        let kind = self.parts[nearest].kind;
        if !matches!(kind, Kind::Trunk | Kind::Leg) {
            return nearest;
        }
        // The outer one is the last.
        let hangs = |part: &Part| part.drape.is_some_and(|drape| p.y > drape.bottom && p.y < drape.top);
        if let Some(row) = self.parts.iter().rposition(hangs) {
            return row;
        }
        let trunk = &self.parts[0];
        let is_high = |top: &Layer| trunk.chart(p).1 > top.from - HEM_REACH;
        if kind == Kind::Leg && trunk.layers.first().is_some_and(is_high) { 0 } else { nearest }
    }

    /// Distance to what hands must not sink into: trunk, legs and what hangs over them.
    pub fn trunk_distance(&self, p: Vec3) -> f32 {
        let solid =
            self.parts.iter().filter(|part| matches!(part.kind, Kind::Trunk | Kind::Leg | Kind::Skirt));
        solid.map(|part| part.distance(p)).fold(f32::INFINITY, f32::min)
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
        let mut parts = vec![anatomy::trunk(figure, outfit), anatomy::head(figure, outfit)];
        parts.extend(anatomy::hair(figure, outfit));
        for side in 0..2 {
            parts.push(anatomy::arm(figure, outfit, side));
            parts.push(anatomy::hand(figure, side));
            parts.push(anatomy::leg(figure, outfit, side));
            parts.push(anatomy::foot(figure, outfit, side));
        }
        parts.extend(anatomy::drapes(figure, outfit));
        for (index, part) in parts.iter_mut().enumerate() {
            part.seed = outfit.seed ^ index as u32;
        }
        Self { parts }
    }
}
