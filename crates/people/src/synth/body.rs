//! Signed distances of a body with its clothes, the union of its parts.

use glam::Vec3;
use snapsnap_mesh::mesh::bounds;

use super::anatomy;
use super::outfit::Outfit;
use super::part::{Kind, Layer, Part};
use crate::figure::Figure;
use crate::math::{smooth_min, smoothstep};

/// A dressed person.
#[derive(Debug, Clone)]
pub struct Body {
    /// The trunk is the first part.
    pub parts: Vec<Part>,
}

/// Metres by which the trunk's chart continues below the top's hem, so that the legs' charts do not cut off the hem.
const HEM_REACH: f32 = 0.04;
/// Largest thickness of cloth, metres, with folds and flares.
const THICKEST: f32 = 0.08;

impl Body {
    /// Signed distance, and the index of the nearest part. A distance that exceeds `enough` may be underestimated,
    /// but never below `enough`.
    pub fn distance(&self, p: Vec3, enough: f32) -> (f32, usize) {
        let mut union = f32::INFINITY;
        let mut nearest = (f32::INFINITY, 0);
        // Distance to trunk and legs, which skirts hang over.
        let mut hips = f32::INFINITY;
        for (index, part) in self.parts.iter().enumerate() {
            let outside = (p - part.bound.0).length() - part.bound.1 - THICKEST;
            if part.drape.is_none() && outside > enough.max(0.0) + 0.06 && outside > 0.06 {
                union = union.min(outside);
                continue;
            }
            let skin = if part.drape.is_none() { part.skin(p) } else { f32::NEG_INFINITY };
            // Nor does cloth reach the point. The exact thickness of cloth takes long to compute.
            let outside = skin - part.thickest();
            if outside > enough.max(0.0) + 0.06 {
                union = union.min(outside);
                continue;
            }
            let mut d = part.dressed(p, skin);
            if d < nearest.0 {
                nearest = (d, index);
            }
            match part.kind {
                Kind::Trunk | Kind::Leg => hips = hips.min(d),
                // A skirt smooths the edges of the body below it.
                Kind::Skirt if hips.is_finite() => d = smooth_min(d, hips, 0.05),
                _ => {}
            }
            let joint = if part.joint > 0.0 && (union - d).abs() < part.joint + 0.004 {
                // Limbs are joined smoothly to the trunk at their start only.
                let along = part.chart(p).1;
                part.joint * (1.0 - smoothstep(0.0, 0.5 * part.length, along)) + 0.004
            } else {
                0.004
            };
            union = if union.is_finite() { smooth_min(union, d, joint) } else { d };
        }
        (union, nearest.1)
    }

    /// Index of the part whose chart colours a point on the surface: the nearest part, with two exceptions. Hips that
    /// fill a skirt have the skirt's cloth. Thighs above the top's hem have the trunk's cloth.
    pub fn owner(&self, p: Vec3, cell: f32) -> usize {
        let nearest = self.distance(p, 4.0 * cell).1;
        let kind = self.parts[nearest].kind;
        if !matches!(kind, Kind::Trunk | Kind::Leg) {
            return nearest;
        }
        // The outermost skirt is the last.
        let hangs = |part: &Part| part.drape.is_some_and(|drape| p.y > drape.bottom && p.y < drape.top);
        if let Some(row) = self.parts.iter().rposition(hangs) {
            return row;
        }
        let trunk = &self.parts[0];
        let is_high = |top: &Layer| trunk.chart(p).1 > top.from - HEM_REACH;
        if kind == Kind::Leg && trunk.layers.first().is_some_and(is_high) { 0 } else { nearest }
    }

    /// Distance to trunk, legs and skirts, which hands must not sink into.
    pub fn trunk_distance(&self, p: Vec3) -> f32 {
        let solid =
            self.parts.iter().filter(|part| matches!(part.kind, Kind::Trunk | Kind::Leg | Kind::Skirt));
        solid.map(|part| part.distance(p)).fold(f32::INFINITY, f32::min)
    }

    /// The bounding box of all parts.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let drapes = self.parts.iter().filter_map(|part| part.drape).flat_map(|drape| {
            let [top, bottom] = drape.ends;
            [(top, drape.top), (bottom, drape.bottom)].into_iter().flat_map(|((centre, radii), y)| {
                [centre - radii * 1.3, centre + radii * 1.3].map(|p| Vec3::new(p.x, y, p.y))
            })
        });
        let shapes = self.parts.iter().flat_map(|part| &part.shapes).flat_map(|shape| {
            let (centre, reach) = (shape.bound.0, Vec3::splat(shape.bound.1 + THICKEST));
            [centre - reach, centre + reach]
        });
        bounds(drapes.chain(shapes))
    }

    /// The body of `figure` in the clothes of `outfit`.
    pub fn new(figure: &Figure, outfit: &Outfit) -> Self {
        let mut parts = vec![anatomy::trunk(figure, outfit), anatomy::head(figure, outfit)];
        parts.extend(anatomy::hair(figure, outfit));
        for side in 0..2 {
            let (arm, leg) = (anatomy::arm(figure, outfit, side), anatomy::leg(figure, outfit, side));
            let (hand, foot) = (anatomy::hand(figure, side), anatomy::foot(figure, outfit, side));
            for mut limb in [arm, hand, leg, foot] {
                limb.side = side;
                parts.push(limb);
            }
        }
        parts.extend(anatomy::drapes(figure, outfit));
        for (index, part) in parts.iter_mut().enumerate() {
            part.seed = outfit.seed ^ index as u32;
        }
        Self { parts }
    }
}
