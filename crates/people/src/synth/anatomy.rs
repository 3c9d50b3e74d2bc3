//! The parts of a synthetic person: trunk, head, hair, limbs, and hanging cloth. Sizes are shares of the stature.

use std::f32::consts::PI;

use glam::{Mat3, Vec2, Vec3, Vec3Swizzles};
use snapsnap_mesh::mesh::bounds;

use super::outfit::{Cut, Lower, Outfit};
use super::part::{Drape, Kind, Layer, Marks, Part, Shape};
use crate::figure::{Bone, Figure, sign};

pub fn trunk(figure: &Figure, outfit: &Outfit) -> Part {
    let Figure { build, pelvis, chest, neck, .. } = figure;
    let (h, sex, girth) = (build.stature, build.sex, build.girth);
    let flat = Vec3::new(1.0, 1.0, 0.72);
    let hips = h * girth * (0.094 - 0.008 * sex);
    let waist = h * girth * (0.068 + 0.012 * sex + 0.012 * build.belly);
    let ribs = h * girth * (0.082 + 0.009 * sex) * build.shoulders;
    let mut shapes = vec![
        Shape::capsule(pelvis.point(0.05), pelvis.end, [hips, waist], pelvis.frame, flat),
        Shape::capsule(pelvis.end, chest.point(0.62), [waist, ribs], chest.frame, flat),
        Shape::capsule(chest.point(0.62), chest.point(0.9), [ribs, 0.058 * h], chest.frame, flat),
        Shape::capsule(chest.point(0.86), neck.point(0.3), [0.05 * h, 0.034 * h], chest.frame, flat),
        neck.capsule(neck.start, neck.end, [0.033 * h * (0.9 + 0.15 * sex), 0.031 * h]),
    ];
    for side in 0..2 {
        let shoulder = figure.upper_arms[side].start;
        let joint = chest.at(0.78, Vec3::new(sign(side) * 0.03 * h, 0.0, 0.0));
        let flat = Vec3::new(1.0, 1.0, 0.9);
        shapes.push(Shape::capsule(joint, shoulder, [0.045 * h, 0.034 * h * girth], chest.frame, flat));
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
    // The chart begins below the crotch, so that it covers the whole trunk.
    let axis = vec![Bone { start: pelvis.point(-0.7), ..*pelvis }, *chest, *neck];
    let mut part = Part::new(Kind::Trunk, shapes, 0.06, axis, 0.085 * h * girth);
    let marks = Marks::of(figure, outfit);
    let mut top = Layer::new(marks.hem..marks.collar, outfit.top_thickness, 0.0, outfit.folds);
    top.drop = marks.neckline;
    part.layers.push(top);
    part.layers.push(Layer::new(-1.0..marks.waistband, outfit.lower_thickness, 0.0, 0.5 * outfit.folds));
    part
}

pub fn head(figure: &Figure, outfit: &Outfit) -> Part {
    let Figure { head, neck, build, .. } = figure;
    let size = head.length();
    let f = head.frame;
    let at = |x: f32, y: f32, z: f32| head.at(0.0, size * Vec3::new(x, y, z));
    let ball = |x: f32, y: f32, z: f32, r: [f32; 3]| Shape::ellipsoid(at(x, y, z), size * Vec3::from(r), f);
    let face = [0.29 * size, (0.2 + 0.03 * build.sex) * size * 0.75];
    let nose = [0.03 * size, 0.055 * size];
    let mut shapes = vec![
        ball(0.0, 0.62, -0.03, [0.345, 0.38, 0.42]),
        Shape::capsule(at(0.0, 0.5, 0.12), at(0.0, 0.06, 0.27), face, f, Vec3::new(1.0, 1.0, 0.85)),
        head.capsule(at(0.0, 0.3, 0.0), neck.point(0.4), [0.24 * size, 0.21 * size]),
        // Nose, brow, lips.
        Shape::capsule(at(0.0, 0.5, 0.37), at(0.0, 0.31, 0.475), nose, f, Vec3::new(0.9, 1.0, 1.0)),
        head.capsule(at(-0.16, 0.545, 0.33), at(0.16, 0.545, 0.33), [0.04 * size; 2]),
        ball(0.0, 0.185, 0.385, [0.1, 0.035, 0.05]),
    ];
    for side in [-1.0, 1.0] {
        shapes.push(ball(side * 0.36, 0.42, -0.04, [0.04, 0.125, 0.075]));
        shapes.push(ball(side * 0.165, 0.35, 0.24, [0.1, 0.1, 0.11]));
    }
    if outfit.glasses {
        shapes.extend([-1.0, 1.0].map(|side| ball(side * 0.16, 0.45, 0.41, [0.12, 0.1, 0.035])));
    }
    let mut part = Part::new(Kind::Head, shapes, 0.014, vec![*head], 0.36 * size);
    part.joint = 0.02;
    part
}

/// Returns `None` for a bald head.
pub fn hair(figure: &Figure, outfit: &Outfit) -> Option<Part> {
    let Figure { head, chest, build, .. } = figure;
    let size = head.length();
    let f = head.frame;
    let at = |x: f32, y: f32, z: f32| head.at(0.0, size * Vec3::new(x, y, z));
    let ball = |x: f32, y: f32, z: f32, r: [f32; 3]| Shape::ellipsoid(at(x, y, z), size * Vec3::from(r), f);
    let lock = |a: Vec3, b: Vec3, r: [f32; 2], flat: [f32; 3]| {
        Shape::capsule(a, b, r.map(|r| r * size), f, Vec3::from(flat))
    };
    // High at the forehead, low at the back, ears free.
    let crown = |thick: f32| ball(0.0, 0.68, -0.075, [0.345 + thick, 0.355 + thick, 0.4 + thick]);
    let nape = |thick: f32| ball(0.0, 0.46, -0.2, [0.29 + thick, 0.3 + thick, 0.25 + thick]);
    let shapes = match outfit.cut {
        Cut::Bald => return None,
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
                chest.at(0.72, Vec3::new(0.0, 0.0, -0.1 * build.stature * build.girth * 0.68)),
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
    let mut part = Part::new(Kind::Hair, shapes, 0.03, vec![*head], 0.42 * size);
    if outfit.cut != Cut::Cap {
        // Strands and curls.
        let folds = if outfit.cut == Cut::Curls { 0.011 } else { 0.0035 };
        part.layers.push(Layer::new(-9.0..9.0, 0.0, 0.0, folds));
    }
    Some(part)
}

pub fn arm(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
    let (build, upper, fore) = (&figure.build, &figure.upper_arms[side], &figure.forearms[side]);
    let r = build.stature * build.girth * (0.9 + 0.15 * build.sex);
    let shapes = vec![
        upper.capsule(upper.start, upper.end, [0.032 * r, 0.0245 * r]),
        upper.capsule(upper.point(0.25), upper.at(0.65, 0.005 * r * Vec3::Z), [0.028 * r, 0.027 * r]),
        fore.capsule(fore.start, fore.point(0.4), [0.0245 * r, 0.0255 * r]),
        fore.capsule(fore.point(0.4), fore.end, [0.0255 * r, 0.0165 * r]),
    ];
    let mut part = Part::new(Kind::Arm, shapes, 0.01, vec![*upper, *fore], 0.03 * r);
    part.joint = 0.07;
    let sleeve = -1.0..outfit.sleeve * part.length;
    part.layers.push(Layer::new(sleeve, outfit.top_thickness, outfit.sleeve_flare, outfit.folds));
    part
}

pub fn hand(figure: &Figure, side: usize) -> Part {
    let hand = &figure.hands[side];
    let length = hand.length();
    let inwards = -sign(side);
    let at = |x: f32, y: f32, z: f32| hand.at(0.0, length * Vec3::new(x, y, z));
    let (palm, flat) = ([0.19 * length, 0.235 * length], Vec3::new(1.0, 1.0, 0.55));
    let mut shapes = vec![Shape::capsule(at(0.0, 0.08, 0.0), at(0.0, -0.36, 0.0), palm, hand.frame, flat)];
    // Palms face backwards in the hand's frame; fingers curl towards the palm.
    let (curl_sin, curl_cos) = libm::sincosf(figure.fingers * PI / 180.0);
    for (i, reach) in [0.43, 0.5, 0.47, 0.37].into_iter().enumerate() {
        let x = inwards * (0.165 - 0.11 * i as f32);
        let knuckle = at(x, -0.46, 0.0);
        let tip = knuckle + hand.frame * Vec3::new(x * 0.25, -curl_cos * reach, -curl_sin * reach) * length;
        shapes.push(hand.capsule(knuckle, tip, [0.075 * length, 0.055 * length]));
    }
    let (root, tip) = (at(inwards * 0.13, -0.1, -0.02), at(inwards * 0.3, -0.42, -0.1));
    shapes.push(hand.capsule(root, tip, [0.09 * length, 0.06 * length]));
    let mut part = Part::new(Kind::Hand, shapes, 0.008, vec![*hand], 0.2 * length);
    part.joint = 0.02;
    part
}

pub fn leg(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
    let (build, thigh, calf) = (&figure.build, &figure.thighs[side], &figure.calves[side]);
    let r = build.stature * build.girth;
    let hip = 0.058 - 0.004 * build.sex;
    let back = |along: f32, offset: f32| calf.at(along, -offset * r * Vec3::Z);
    let shapes = vec![
        thigh.capsule(thigh.start, thigh.end, [hip * r, 0.034 * r]),
        thigh.capsule(thigh.point(0.1), thigh.at(0.6, 0.006 * r * Vec3::Z), [0.053 * r, 0.043 * r]),
        calf.capsule(calf.start, calf.end, [0.034 * r, 0.0225 * r]),
        calf.capsule(back(0.15, 0.01), back(0.45, 0.012), [0.03 * r, 0.029 * r]),
    ];
    let mut part = Part::new(Kind::Leg, shapes, 0.012, vec![*thigh, *calf], 0.042 * r);
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

pub fn foot(figure: &Figure, outfit: &Outfit, side: usize) -> Part {
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
        foot.capsule(at(0.0, 0.0, 0.0), at(0.0, -0.02, 0.06), [0.024 * h, 0.018 * h]),
    ];
    // Along the sole: right, towards the toes, up.
    let along = Mat3::from_cols(-f.x_axis, f.z_axis, f.y_axis);
    let axis = Bone { start: heel, end: toes, frame: along };
    let mut part = Part::new(Kind::Foot, shapes, 0.025, vec![axis], 0.028 * h);
    part.layers.push(Layer::new(-9.0..9.0, outfit.shoe_thickness, 0.0, 0.0));
    part
}

/// Skirts and the tails of coats.
pub fn drapes(figure: &Figure, outfit: &Outfit) -> Vec<Part> {
    let mut wanted = Vec::new();
    if let Lower::Skirt { length, flare, folds } = outfit.lower {
        wanted.push((length, flare, folds as f32, outfit.lower_thickness));
    }
    if outfit.top_length > 1.0 {
        // Length beyond the crotch, as a share of the leg.
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
        let bones = thighs.iter().chain(calves);
        let points = bones.flat_map(|bone| (0..=10).map(|i| bone.point(i as f32 / 10.0)));
        let (low, high) = bounds(points.filter(|p| p.y > bottom - 0.02));
        let around_legs = ((low + high).xz() / 2.0, (high - low).xz() / 2.0);
        let (centre, reach) = if low.is_finite() { around_legs } else { (Vec2::ZERO, Vec2::ZERO) };
        let hips = h * girth * (0.098 - 0.008 * build.sex);
        let limb = 0.058 * h * girth + 0.012 + thickness;
        // An ellipse around two legs side by side is wider than their box.
        let hem = (1.15 * reach + Vec2::splat(limb)).max(Vec2::new(1.0 + flare, 0.8 + flare) * hips);
        let top_radii = Vec2::new(1.0, 0.8) * h * girth * (0.072 + 0.012 * build.sex + 0.012 * build.belly)
            + Vec2::splat(thickness + 0.004);
        // Wide enough for the hips: the cone is straight from waist to hem.
        let down = (waist.y - pelvis.start.y) / (waist.y - bottom);
        let needed =
            (Vec2::new(0.12, 0.116) * h * girth + Vec2::splat(thickness) - (1.0 - down) * top_radii) / down;
        let drape = Drape {
            top,
            bottom,
            ends: [(waist.xz(), top_radii), (centre, hem.max(needed.min(hem * 1.6)))],
            folds,
            depth: 0.03 + 0.05 * flare.min(0.6),
            seed: outfit.seed ^ 0x5eed,
        };
        let middle = Vec3::new(waist.x, top, waist.z);
        let axis = Bone::straight(middle, middle - Vec3::Y * (top - bottom));
        let radius = hem.element_sum() / 2.0;
        let mut part = Part::new(Kind::Skirt, Vec::new(), 0.02, vec![axis], radius);
        part.drape = Some(drape);
        part.side = usize::from(outfit.top_length > 1.0);
        part
    };
    wanted.into_iter().map(make).collect()
}
