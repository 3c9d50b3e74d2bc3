//! Errors of a photograph's points on head, hands and feet, where depths of a few millimetres are seen. The place of the
//! whole part does not count.

use glam::{Vec2, Vec3};
use snapsnap_net::median;
use snapsnap_photo::Joint;

use crate::points::{Pair, is_predicted, normal_error};
use crate::statistics::mean;

/// Names of the parts in reports.
pub const PARTS: [&str; 3] = ["head", "hands", "feet"];
/// The middles of each part: joints whose mean it is. Numbers are those of [`snapsnap_net::blazepose::Pose::landmarks`].
const MIDDLES: [&[&[usize]]; 3] =
    [&[&[7, 8]], &[&[15, 17, 19], &[16, 18, 20]], &[&[27, 29, 31], &[28, 30, 32]]];
/// Radii of the circles around the middles, in lengths from the shoulders to the hips.
const RADII: [f32; 3] = [0.32, 0.2, 0.26];
/// Least probability that the joints are seen.
const SEEN: f32 = 0.5;
/// Least number of pixels that tell an error.
const LEAST: usize = 64;
/// Largest error in metres after the part's own shift; the point belongs to another surface.
const FAR: f64 = 0.04;

/// Errors of one photograph on one part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartError {
    /// Index in [`PARTS`].
    pub part: usize,
    /// Mean distance from the truth in metres after the median shift is removed, where it is below 4 cm.
    pub relief: Option<f64>,
    /// Share of the pixels at 4 cm or more, or without a prediction.
    pub far: f64,
    /// Mean angle between the normals in degrees.
    pub normals: Option<f64>,
}

/// Errors on the parts that the joints of a photograph find. `joints` are in pixels of a canvas of `side`² pixels.
pub fn part_errors(pair: &Pair, joints: &[Joint], side: usize) -> Vec<PartError> {
    let middle = |rows: &[usize]| rows.iter().map(|row| joints[*row].at).sum::<Vec2>() / rows.len() as f32;
    let torso = middle(&[11, 12]).distance(middle(&[23, 24]));
    let mut found = Vec::new();
    for (part, middles) in MIDDLES.iter().enumerate() {
        for rows in *middles {
            // A back shows the head, but the network sees no ears.
            if part > 0 && rows.iter().any(|row| joints[*row].seen < SEEN) {
                continue;
            }
            let (middle, radius) = (middle(rows), RADII[part] * torso);
            let is_inside = |i: usize| {
                let at = Vec2::new((i % side) as f32 + 0.5, (i / side) as f32 + 0.5);
                pair.valid[i] > 0.5 && at.distance(middle) < radius
            };
            let valid: Vec<f32> = (0..pair.valid.len()).map(|i| f32::from(u8::from(is_inside(i)))).collect();
            found.extend(error(&Pair { valid: &valid, ..*pair }, part, side));
        }
    }
    found
}

fn error(pair: &Pair, part: usize, side: usize) -> Option<PartError> {
    let points = pair.points.as_chunks::<3>().0.iter().zip(pair.truth.as_chunks::<3>().0).zip(pair.valid);
    let there = points.filter(|(_, valid)| **valid > 0.5);
    let off = |point: &[f32; 3], truth: &[f32; 3]| {
        is_predicted(point).then(|| Vec3::from_array(*point) - Vec3::from_array(*truth))
    };
    let off: Vec<Option<Vec3>> = there.map(|((point, truth), _)| off(point, truth)).collect();
    if off.len() < LEAST {
        return None;
    }
    let predicted: Vec<Vec3> = off.iter().flatten().copied().collect();
    let shift = median(&predicted).unwrap_or_default();
    let lengths = predicted.iter().map(|off| f64::from(off.distance(shift)));
    let near: Vec<f64> = lengths.filter(|length| *length < FAR).collect();
    Some(PartError {
        part,
        relief: mean(&near),
        far: 1.0 - near.len() as f64 / off.len() as f64,
        normals: normal_error(pair, side),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_counts_without_its_own_shift_and_without_points_of_other_surfaces() {
        let side = 200;
        let joint = |x: f32, y: f32| Joint { at: Vec2::new(x, y), seen: 1.0 };
        let mut joints = vec![joint(-100.0, -100.0); 33];
        // The head, a torso of 100 pixels, one hand, and feet outside of the person.
        for (row, x, y) in [(7, 98.0, 30.0), (8, 102.0, 30.0), (11, 90.0, 70.0), (12, 110.0, 70.0)] {
            joints[row] = joint(x, y);
        }
        for (row, x, y) in [(23, 90.0, 170.0), (24, 110.0, 170.0), (15, 40.0, 150.0), (17, 40.0, 150.0)] {
            joints[row] = joint(x, y);
        }
        joints[19] = joint(40.0, 150.0);
        let point = |i: usize| [0.002 * (i % side) as f32, 0.002 * (i / side) as f32, 2.0];
        let truth: Vec<f32> = (0..side * side).flat_map(point).collect();
        // The head is 5 cm off, every second column of it 8 mm more; the hand 1 m off in a quarter of its rows.
        let mut points = truth.clone();
        for (i, point) in points.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let (x, y) = (i % side, i / side);
            if y < 65 {
                point[2] += 0.05 + if x % 2 == 0 { 0.0 } else { 0.008 };
            } else if x < 65 && y % 4 == 0 {
                point[2] += 1.0;
            }
        }
        let valid = vec![1.0; side * side];
        let pair = Pair { view: 0, points: &points, truth: &truth, valid: &valid };
        let found = part_errors(&pair, &joints, side);
        let [head, hand] = found[..] else { panic!("{found:?}") };
        assert_eq!((head.part, hand.part), (0, 1));
        let is_near = |found: Option<f64>, at: f64, most: f64| found.is_some_and(|v| (v - at).abs() < most);
        assert!(is_near(head.relief, 0.004, 2e-4) && head.far == 0.0, "{head:?}");
        // Slopes of 8 mm over 2 mm.
        let slope = 4.0_f64.atan().to_degrees();
        assert!(is_near(head.normals, slope, 0.5), "{head:?}");
        assert!(is_near(hand.relief, 0.0, 1e-6) && is_near(Some(hand.far), 0.25, 0.03), "{hand:?}");
    }
}
