//! The visual hull of the two photographs. Points outside of a silhouette are not on the person.

use glam::DVec3;
use snapsnap_splat::{Camera, RigidTransform};

/// The space inside the masks of the two photographs, for the nominal front and back cameras.
pub struct Hull {
    side: usize,
    /// Masks, grown.
    masks: [Vec<bool>; 2],
    /// From the front camera's frame to either camera's.
    to_camera: [RigidTransform; 2],
    camera: Camera,
}

impl Hull {
    /// The hull of masks `[S, S]` of the front and the back, each grown by `margin` pixels, since cameras and predicted points
    /// have small errors.
    pub fn new(masks: [&[bool]; 2], side: usize, margin: usize) -> Self {
        let [camera, back] = [0.0, 180.0].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, side as u32));
        let to_back = camera.world_to_camera.inverse().then(&back.world_to_camera);
        Self {
            side,
            masks: masks.map(|mask| dilated(mask, side, margin)),
            to_camera: [RigidTransform::IDENTITY, to_back],
            camera,
        }
    }

    /// Whether a point `[x, y, z]`, metres in the front camera's frame, is within the masks of both cameras.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        let point = DVec3::from(point.map(f64::from));
        self.masks.iter().zip(&self.to_camera).all(|(mask, to_camera)| {
            let p = to_camera.apply(point);
            if p.z <= 0.0 {
                return false;
            }
            let place = self.camera.focal * p.truncate() / p.z + self.camera.principal_point;
            let inside = 0.0..self.side as f64;
            inside.contains(&place.x)
                && inside.contains(&place.y)
                && mask[place.y as usize * self.side + place.x as usize]
        })
    }
}

/// A mask `[H, W]` of `width` columns, dilated by a square of 2·`margin` + 1 pixels.
pub fn dilated(mask: &[bool], width: usize, margin: usize) -> Vec<bool> {
    let rows = mask.len() / width.max(1);
    let across = spread(mask, [rows, width], [width, 1], margin);
    spread(&across, [width, rows], [1, width], margin)
}

/// Set pixels reach `margin` further along lines of `length` pixels; lines and pixels lie `strides` apart.
fn spread(inside: &[bool], [lines, length]: [usize; 2], strides: [usize; 2], margin: usize) -> Vec<bool> {
    let mut out = vec![false; inside.len()];
    for line in 0..lines {
        let at = |i: usize| line * strides[0] + i * strides[1];
        // One past the last pixel that the last set one reaches.
        let mut reach = 0;
        let mut next = 0;
        for i in 0..length {
            while next < length && next <= i.saturating_add(margin) {
                if inside[at(next)] {
                    reach = next.saturating_add(margin).saturating_add(1);
                }
                next += 1;
            }
            out[at(i)] = i < reach;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the definition, pixel by pixel.
    #[test]
    fn masks_grow_by_their_margin_in_all_directions() {
        let (height, width) = (13, 17);
        for (seed, margin) in [(1_u32, 0), (2, 1), (3, 2), (4, 5), (5, 40), (6, usize::MAX)] {
            let lit = |i: usize| (i as u32).wrapping_mul(2_654_435_761).rotate_left(seed) % 23 == 0;
            let mask: Vec<bool> = (0..height * width).map(lit).collect();
            let near = |i: usize| {
                let (x, y) = (i % width, i / width);
                let lines = y.saturating_sub(margin)..=y.saturating_add(margin).min(height - 1);
                lines.into_iter().any(|row| {
                    (x.saturating_sub(margin)..=x.saturating_add(margin).min(width - 1))
                        .any(|c| lit(row * width + c))
                })
            };
            let expected: Vec<bool> = (0..height * width).map(near).collect();
            assert_eq!(dilated(&mask, width, margin), expected, "margin {margin}");
        }
    }

    /// The nominal cameras look at the axis from two metres, front and back.
    #[test]
    fn only_what_both_cameras_see_in_their_masks_is_inside() {
        let side = 64;
        let left_half: Vec<bool> = (0..side * side).map(|i| i % side < side / 2).collect();
        let all = vec![true; side * side];
        let point = |x: f32, z: f32| [x, 0.0, z];
        let front_only = Hull::new([&left_half, &all], side, 0);
        assert!(front_only.contains(point(-0.1, 2.0)) && !front_only.contains(point(0.1, 2.0)));
        // The front's left is the back's right.
        let back_only = Hull::new([&all, &left_half], side, 0);
        assert!(!back_only.contains(point(-0.1, 2.0)) && back_only.contains(point(0.1, 2.0)));
        let both = Hull::new([&left_half, &left_half], side, 0);
        assert!(!both.contains(point(-0.1, 2.0)) && !both.contains(point(0.1, 2.0)));
        // A pixel at two metres is 4 cm here.
        let grown = Hull::new([&left_half, &left_half], side, 3);
        assert!(grown.contains(point(-0.1, 2.0)) && grown.contains(point(0.1, 2.0)));
        let everything = Hull::new([&all, &all], side, 0);
        assert!(everything.contains(point(0.0, 2.0)));
        // Behind either camera, or beside the canvas.
        assert!(!everything.contains(point(0.0, -1.0)) && !everything.contains(point(0.0, 5.0)));
        assert!(!everything.contains(point(3.0, 2.0)) && !everything.contains([f32::NAN; 3]));
    }
}
