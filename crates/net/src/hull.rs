//! What the photographs' masks say of the unseen sides: whoever is outside of a silhouette is not there.

use glam::DVec3;
use snapsnap_splat::{Camera, RigidTransform};

/// The space that the nominal front and back cameras see within the masks of the two photographs.
pub struct Hull {
    side: usize,
    /// Masks, grown.
    masks: [Vec<bool>; 2],
    /// From the front camera's frame to either camera's.
    to_camera: [RigidTransform; 2],
    camera: Camera,
}

impl Hull {
    /// Of masks `[S, S]` of the front and the back, each grown by `margin` pixels: cameras stand nearly where they should,
    /// and predicted points are nearly right.
    pub fn new(masks: [&[bool]; 2], side: usize, margin: usize) -> Self {
        let [camera, back] = [0.0, 180.0].map(|yaw| Camera::orbit_at_yaw_degrees(yaw, side as u32));
        let to_back = camera.world_to_camera.inverse().then(&back.world_to_camera);
        Self {
            side,
            masks: masks.map(|mask| grown(mask, side, margin)),
            to_camera: [RigidTransform::IDENTITY, to_back],
            camera,
        }
    }

    /// Whether both cameras see a point `[x, y, z]`, metres in the front camera's frame, within their masks.
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

/// A mask and all pixels within `margin` rows and columns of it.
fn grown(mask: &[bool], side: usize, margin: usize) -> Vec<bool> {
    // A running count of set pixels along rows, then along columns.
    let spread = |mask: &[bool], stride: usize, across: usize| -> Vec<bool> {
        let mut out = vec![false; side * side];
        for line in 0..side {
            let at = |i: usize| line * across + i * stride;
            let mut count = (0..margin.min(side)).filter(|i| mask[at(*i)]).count();
            for i in 0..side {
                if i + margin < side && mask[at(i + margin)] {
                    count += 1;
                }
                out[at(i)] = count > 0;
                if i >= margin && mask[at(i - margin)] {
                    count -= 1;
                }
            }
        }
        out
    };
    spread(&spread(mask, 1, side), side, 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_grow_by_as_many_pixels_in_every_direction() {
        let side = 12;
        let mut mask = vec![false; side * side];
        mask[3 * side + 4] = true;
        mask[11 * side] = true;
        for margin in [0, 1, 3, 20] {
            let got = grown(&mask, side, margin);
            for (i, got) in got.into_iter().enumerate() {
                let near = |row: usize, column: usize| {
                    (i / side).abs_diff(row) <= margin && (i % side).abs_diff(column) <= margin
                };
                assert_eq!(got, near(3, 4) || near(11, 0), "margin {margin}, {i}");
            }
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
        // What the front has on the left the back has on the right.
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
