//! Views of Gaussians from all around: depth, the angle between surface and ray, and colour.

use burn::tensor::Tensor;
use glam::{DAffine3, DMat3, DMat4, DVec2, DVec3, Mat4, Vec3};
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Camera, RenderOptions, RigidTransform, SplatError, render};

/// Rings of cameras around the subject: downward pitch in degrees, and number of cameras.
const RINGS: [(f64, usize); 7] =
    [(-85.0, 1), (-55.0, 6), (-25.0, 10), (5.0, 16), (35.0, 10), (65.0, 6), (88.0, 1)];
/// Distance of the cameras from the centre of a ball, in radii: perspective hides little, and f32 suffices for depths.
const DISTANCE: f64 = 4.0;
/// Least coverage of a pixel that shows a surface.
pub const COVERED: f32 = 0.5;
/// Least cosine between a surface's normal and the ray. The pixels of flatter surfaces mix surfaces behind one another.
const FLATTEST: f32 = 0.15;

/// View of one camera.
pub struct View {
    /// Centre of the camera, world metres.
    centre: Vec3,
    /// Side of the picture in pixels.
    side: u32,
    /// From the world to pixels times depth, and depth.
    projection: Mat4,
    /// Metres along the optical axis; 0 at pixels without a surface.
    depth: Vec<f32>,
    /// Cosine between the surface's normal and the ray; 0 where it is unknown or the surface too flat.
    facing: Vec<f32>,
    /// Red, green and blue in [0, 1], divided by the coverage.
    color: Vec<Vec3>,
}

/// Cameras around the ball of this radius around the origin, the whole of which is in each picture of `side`² pixels.
pub fn cameras(radius: f64, side: u32) -> Vec<Camera> {
    let distance = DISTANCE * radius;
    let focal = (distance * distance / (radius * radius) - 1.0).sqrt() * 0.5 * 0.98;
    let ring = |(row, (pitch, count)): (usize, (f64, usize))| {
        (0..count).map(move |i| {
            let yaw = (360.0 * (i as f64 + 0.5 * (row % 2) as f64) / count as f64).to_radians();
            let pitch: f64 = pitch.to_radians();
            let backward = DVec3::new(pitch.cos() * yaw.sin(), pitch.sin(), pitch.cos() * yaw.cos());
            let right = DVec3::new(yaw.cos(), 0.0, -yaw.sin());
            let forward = -backward;
            let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
            let translation = -(rotation * (distance * backward));
            Camera {
                width: side,
                height: side,
                focal: DVec2::splat(focal * f64::from(side)),
                principal_point: DVec2::splat(0.5 * f64::from(side)),
                world_to_camera: RigidTransform { rotation, translation },
            }
        })
    };
    RINGS.into_iter().enumerate().flat_map(ring).collect()
}

impl View {
    /// Renders Gaussians from one of the [`cameras`] around a ball of this radius. More than `max_intersections` pairs of a splat and a tile are refused.
    ///
    /// # Errors
    /// The errors of [`render`].
    pub fn new(
        scene: &Loaded,
        camera: Camera,
        radius: f64,
        max_intersections: u64,
    ) -> Result<Self, SplatError> {
        // Gaussians between the camera and the ball are left out.
        let near = ((DISTANCE - 1.0) * radius) as f32;
        let options = RenderOptions { depth: true, near, max_intersections, ..RenderOptions::inria() };
        let rendered = render(&scene.seen_by(&camera)?, std::slice::from_ref(&camera), &options)?;
        let (alpha, color) = (host(rendered.alpha), host(rendered.color));
        let depth = host(rendered.depth.expect("depth was requested"));
        let depth: Vec<f32> =
            depth.iter().zip(&alpha).map(|(z, a)| if *a > COVERED { z / a } else { 0.0 }).collect();
        let color = color.as_chunks::<3>().0.iter().zip(&alpha);
        let color = color.map(|(c, a)| Vec3::from_array(*c) / a.max(COVERED)).collect();
        let facing = facing(&depth, &camera);
        Ok(Self {
            centre: camera.centre().as_vec3(),
            side: camera.width,
            projection: projection(&camera),
            depth,
            facing,
            color,
        })
    }

    /// The pixel and the depth of a place.
    fn pixel(&self, place: Vec3) -> Option<(usize, f32)> {
        let p = self.projection.transform_point3(place);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let side = self.side as f32;
        let within = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < side && y < side;
        // The conversion of numbers from 0 on rounds down.
        within.then(|| (y as usize * self.side as usize + x as usize, p.z))
    }

    /// Distance in metres along the optical axis from a place to the surface behind it, and the cosine between the surface's
    /// normal and the ray. The distance is negative for a surface before the place and infinite without one. `None` outside
    /// of the picture, and where the picture cannot be trusted.
    pub fn surface(&self, place: Vec3) -> Option<(f32, f32)> {
        let (pixel, z) = self.pixel(place)?;
        match (self.depth[pixel], self.facing[pixel]) {
            (0.0, _) => Some((f32::INFINITY, 1.0)),
            (_, 0.0) => None,
            (depth, facing) => Some((depth - z, facing)),
        }
    }

    /// Colour and cosine of the surface at a place, if one is within `reach` metres of it.
    pub fn color(&self, place: Vec3, reach: f32) -> Option<(Vec3, f32)> {
        let (pixel, z) = self.pixel(place)?;
        let (depth, facing) = (self.depth[pixel], self.facing[pixel]);
        (facing > 0.0 && (depth - z).abs() < reach).then(|| (self.color[pixel], facing))
    }

    /// Unit vector from the camera to a place.
    pub fn towards(&self, place: Vec3) -> Vec3 {
        (place - self.centre).normalize()
    }
}

fn projection(camera: &Camera) -> Mat4 {
    let RigidTransform { rotation, translation } = camera.world_to_camera;
    let (focal, middle) = (camera.focal, camera.principal_point);
    let pixels = DMat3::from_cols(
        DVec3::new(focal.x, 0.0, 0.0),
        DVec3::new(0.0, focal.y, 0.0),
        DVec3::new(middle.x, middle.y, 1.0),
    );
    let projection = DAffine3::from_mat3_translation(pixels * rotation, pixels * translation);
    DMat4::from(projection).as_mat4()
}

/// Cosines between the rays and the normals of a depth map.
fn facing(depth: &[f32], camera: &Camera) -> Vec<f32> {
    let side = camera.width as usize;
    let point = |x: usize, y: usize| {
        let z = depth[y * side + x];
        let at = (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - camera.principal_point) / camera.focal;
        (z > 0.0).then(|| z * at.as_vec2().extend(1.0))
    };
    let mut facing = vec![0.0; depth.len()];
    for y in 1..side - 1 {
        for x in 1..side - 1 {
            let around = [point(x - 1, y), point(x + 1, y), point(x, y - 1), point(x, y + 1), point(x, y)];
            let [Some(left), Some(right), Some(up), Some(down), Some(here)] = around else { continue };
            let normal = (right - left).cross(down - up).normalize_or_zero();
            let cosine = normal.dot(here.normalize_or_zero()).abs();
            facing[y * side + x] = if cosine < FLATTEST { 0.0 } else { cosine };
        }
    }
    facing
}

/// The values of a tensor.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line")
}
