//! Pinhole cameras: OpenCV axes (x right, y down, z forward), metres, pixels, pixel centres at +½.

use glam::{DMat3, DVec2, DVec3};

use crate::options::MAX_SIDE;

/// `x ↦ rotation · x + translation`; `rotation` is orthonormal but may be a reflection, as in the published demo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidTransform {
    /// Orthonormal 3×3 matrix.
    pub rotation: DMat3,
    /// Metres.
    pub translation: DVec3,
}

impl RigidTransform {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Applies the transform to a point (metres).
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// This transform, then another.
    pub fn then(&self, next: &Self) -> Self {
        Self { rotation: next.rotation * self.rotation, translation: next.apply(self.translation) }
    }

    /// The transform that undoes this one.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }
}

/// A pinhole camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal lengths along x and y in pixels.
    pub focal: DVec2,
    /// Principal point in pixels, in coordinates where the first pixel's centre is (½, ½).
    pub principal_point: DVec2,
    /// World → camera.
    pub world_to_camera: RigidTransform,
}

/// A camera on an orbit around a subject, which it looks at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    /// Point that the camera looks at, world metres.
    pub centre: DVec3,
    /// Distance of the camera from `centre` in metres.
    pub radius: f64,
    /// Angle around the world's y axis in degrees; 0 is on +z, in front of a subject that faces +z.
    pub yaw_degrees: f64,
    /// How far the camera looks down, in degrees.
    pub pitch_degrees: f64,
    /// Turn of the image around the optical axis in degrees, clockwise as seen from behind the camera.
    pub roll_degrees: f64,
    /// Focal length as a share of the image's side.
    pub focal: f64,
}

impl Default for Orbit {
    /// The nominal camera in front of the subject (docs/method.md, "Cameras").
    fn default() -> Self {
        Self {
            centre: DVec3::new(0.0, 0.85, 0.0),
            radius: 2.0,
            yaw_degrees: 0.0,
            pitch_degrees: 8.0,
            roll_degrees: 0.0,
            focal: 0.8,
        }
    }
}

impl Orbit {
    /// The camera with a square image of `size` pixels. Its principal point is moved down by 25/1024 of the size
    /// (docs/method.md, "Cameras").
    pub fn camera(&self, size: u32) -> Camera {
        let (sin, cos) = self.yaw_degrees.to_radians().sin_cos();
        let (pitch_sin, pitch_cos) = self.pitch_degrees.to_radians().sin_cos();
        let backward = DVec3::new(pitch_cos * sin, pitch_sin, pitch_cos * cos);
        let forward = -backward;
        let right = DVec3::new(cos, 0.0, -sin);
        let down = forward.cross(right);
        let (roll_sin, roll_cos) = self.roll_degrees.to_radians().sin_cos();
        let (right, down) = (roll_cos * right + roll_sin * down, roll_cos * down - roll_sin * right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        let eye = self.centre + self.radius * backward;
        let side = f64::from(size);
        Camera {
            width: size,
            height: size,
            focal: DVec2::splat(self.focal * side),
            principal_point: DVec2::new(0.5 * side, 537.0 / 1024.0 * side),
            world_to_camera: RigidTransform { rotation, translation: -(rotation * eye) },
        }
    }
}

impl Camera {
    /// The training orbit's camera at `yaw_degrees` with a square image of `size` pixels: 2 m from
    /// (0, 0.85, 0), 8° downward pitch, focal length 0.8·size, principal point moved down by 25/1024 of the size.
    /// World: y up, floor at y = 0; yaw 0 is on +z, in front of a subject that faces +z.
    pub fn orbit_at_yaw_degrees(yaw_degrees: f64, size: u32) -> Self {
        Orbit { yaw_degrees, ..Orbit::default() }.camera(size)
    }

    /// `count` cameras evenly around the training orbit, the first in front. The height of a subject in the image
    /// does not depend on `width`.
    pub fn orbit(count: usize, width: u32, height: u32) -> Vec<Self> {
        let camera = |index| {
            let square = Self::orbit_at_yaw_degrees(360.0 * index as f64 / count as f64, height);
            let principal_point = DVec2::new(0.5 * f64::from(width), square.principal_point.y);
            Self { width, principal_point, ..square }
        };
        (0..count).map(camera).collect()
    }

    /// The same view in an image of another size.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let factor =
            DVec2::new(f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        let (focal, principal_point) = (self.focal * factor, self.principal_point * factor);
        Self { width, height, focal, principal_point, ..*self }
    }

    /// The same camera, moved by `degrees` around the world's y axis in the direction of [`Orbit::yaw_degrees`].
    pub fn turned(&self, degrees: f64) -> Self {
        let RigidTransform { rotation, translation } = self.world_to_camera;
        let rotation = rotation * DMat3::from_rotation_y(-degrees.to_radians());
        Self { world_to_camera: RigidTransform { rotation, translation }, ..*self }
    }

    /// Centre of the camera in the world, metres. Computed with the inverse, not the transpose: a matrix from a file
    /// may be orthonormal to a few digits only.
    pub fn centre(&self) -> DVec3 {
        -(self.world_to_camera.rotation.inverse() * self.world_to_camera.translation)
    }

    /// Whether an image can be rendered into this camera.
    ///
    /// # Errors
    /// The camera's fault.
    pub fn check(&self) -> Result<(), String> {
        for (field, side) in [("width", self.width), ("height", self.height)] {
            if side == 0 || side > MAX_SIDE {
                return Err(format!("`{field}` is {side}, expected 1 to {MAX_SIDE} pixels"));
            }
        }
        for (field, focal) in [("fx", self.focal.x), ("fy", self.focal.y)] {
            // The upper bound keeps f32 arithmetic in range; it is far beyond any lens.
            if !(focal > 0.0 && focal <= 1e9) {
                return Err(format!(
                    "`{field}` is {focal:e}, expected a focal length in pixels, above 0 and at most 1e9"
                ));
            }
        }
        for (field, value) in [("cx", self.principal_point.x), ("cy", self.principal_point.y)] {
            if value.is_nan() || value.abs() > 1e9 {
                return Err(format!("`{field}` is {value:e}, expected pixels within ±1e9"));
            }
        }
        let RigidTransform { rotation, translation } = self.world_to_camera;
        let off = (rotation * rotation.transpose() - DMat3::IDENTITY).to_cols_array();
        // Written so that a NaN fails as well.
        if !off.iter().all(|d| d.abs() <= 1e-3) {
            return Err(
                "the upper left 3×3 of `world_to_camera` is not a rotation or reflection (R·Rᵀ ≠ I)".into()
            );
        }
        if !translation.to_array().iter().all(|t| t.abs() <= 1e12) {
            return Err("the translation of `world_to_camera` is not finite or beyond 1e12 m".into());
        }
        Ok(())
    }

    /// Projects a world point (metres): pixel coordinates (pixel centres at +½) and depth along the optical axis
    /// (metres). `None` for a point on or behind the camera's plane.
    pub fn project(&self, world: DVec3) -> Option<(DVec2, f64)> {
        let p = self.world_to_camera.apply(world);
        (p.z > 0.0).then(|| (self.focal * DVec2::new(p.x, p.y) / p.z + self.principal_point, p.z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_walks_around_the_axis_as_on_its_orbit() {
        let orbit =
            |yaw_degrees| Orbit { yaw_degrees, pitch_degrees: 3.0, roll_degrees: 2.0, ..Orbit::default() };
        let (walked, expected) = (orbit(30.0).camera(64).turned(90.0), orbit(120.0).camera(64));
        let point = DVec3::new(0.3, 1.1, -0.2);
        let [a, b] = [walked, expected].map(|camera| camera.project(point).expect("in front"));
        assert!((a.0 - b.0).length() < 1e-9 && (a.1 - b.1).abs() < 1e-12, "{a:?} {b:?}");
    }

    /// The camera's published numbers (docs/method.md, "Check values").
    #[test]
    fn orbit_camera_matches_the_published_check_values() {
        let camera = Camera::orbit_at_yaw_degrees(0.0, 1024);
        let RigidTransform { rotation, translation } = camera.world_to_camera;
        let expected =
            DMat3::from_cols_array(&[1.0, 0.0, 0.0, 0.0, -0.990268, -0.139173, 0.0, 0.139173, -0.990268]);
        assert!((rotation - expected).to_cols_array().iter().all(|d| d.abs() < 1e-6), "{rotation}");
        assert!((translation - DVec3::new(0.0, 0.841728, 2.118297)).length() < 2e-6, "{translation}");

        let (pixel, depth) = camera.project(DVec3::new(0.3, 0.85, 0.0)).expect("in front");
        assert!((pixel - DVec2::new(634.88, 537.0)).length() < 1e-9, "{pixel}");
        assert!((depth - 2.0).abs() < 1e-12, "{depth}");
        let row = |y: f64| camera.project(DVec3::new(0.0, y, 0.0)).expect("in front").0.y;
        assert!((row(0.0) - 862.518).abs() < 5e-4, "{}", row(0.0));
        assert!((row(1.8) - 124.390).abs() < 5e-4, "{}", row(1.8));
    }

    #[test]
    fn a_roll_turns_the_image_around_the_optical_axis() {
        let orbit = Orbit { yaw_degrees: 20.0, ..Orbit::default() };
        let (level, rolled) = (orbit.camera(64), Orbit { roll_degrees: 90.0, ..orbit }.camera(64));
        assert!((level.centre() - rolled.centre()).length() < 1e-12);
        let point = DVec3::new(0.1, 1.4, 0.2);
        let [a, b] = [level, rolled].map(|c| c.project(point).expect("in front").0 - c.principal_point);
        // The roll turns the image's axes: (x, y) → (y, −x).
        assert!((b - DVec2::new(a.y, -a.x)).length() < 1e-9, "{a} {b}");
    }

    #[test]
    fn orbits_of_any_shape_and_resized_cameras_see_the_same_directions() {
        let [square, wide] = [64, 96].map(|width| Camera::orbit(8, width, 64)[3]);
        let small = wide.resized(48, 32);
        let point = DVec3::new(0.2, 1.3, -0.1);
        let [a, b, c] = [square, wide, small].map(|camera| camera.project(point).expect("in front").0);
        assert!((b - a - DVec2::new(16.0, 0.0)).length() < 1e-12, "{a} {b}");
        assert!((2.0 * c - b).length() < 1e-12, "{b} {c}");
    }
}
