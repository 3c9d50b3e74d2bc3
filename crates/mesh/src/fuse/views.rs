//! What cameras all around see of Gaussians: depth, how squarely a surface is met, and colour.

use burn::tensor::Tensor;
use glam::{DMat3, DVec2, DVec3, Mat4, Vec3};
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Camera, RenderOptions, RigidTransform, SplatError, render};

/// Rings of cameras around the subject: how far they look down, in degrees, and how many of them there are.
const RINGS: [(f64, usize); 7] =
    [(-85.0, 1), (-55.0, 6), (-25.0, 10), (5.0, 16), (35.0, 10), (65.0, 6), (88.0, 1)];
/// Radii between a ball and the cameras around it: far enough away that perspective hides little, near enough for f32's depths.
const DISTANCE: f64 = 4.0;
/// A pixel shows a surface where Gaussians cover it so far.
pub const COVERED: f32 = 0.5;
/// Surfaces that are met at a flatter angle than this cosine are not trusted: their pixels mix what lies behind one another.
const FLATTEST: f32 = 0.15;

/// What one camera sees.
pub struct View {
    /// Where it stands, world metres.
    centre: Vec3,
    /// Side of its picture in pixels.
    side: u32,
    /// World to pixels times depth, and depth.
    projection: Mat4,
    /// Metres along the optical axis; 0 where nothing is covered.
    depth: Vec<f32>,
    /// Cosine between the surface's normal and the ray; 0 where it cannot be told or is too flat.
    facing: Vec<f32>,
    /// Red, green and blue in [0, 1], not darkened by what is not covered.
    color: Vec<Vec3>,
}

/// What a view says of a place.
pub enum Seen {
    /// It lies outside of the picture, or where the picture cannot be trusted.
    Unknown,
    /// Nothing is there, up to infinity.
    Free,
    /// A surface lies so many metres behind it (below 0: before it) along the optical axis, met so squarely.
    Surface { distance: f32, facing: f32 },
}

/// Cameras around a ball, each with the whole of it in its picture of `side`² pixels.
pub fn cameras(centre: DVec3, radius: f64, side: u32) -> Vec<Camera> {
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
            let translation = -(rotation * (centre + distance * backward));
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
    /// Renders Gaussians as one of the [`cameras`] around a ball of this radius sees them.
    ///
    /// # Errors
    /// Those of [`render`].
    pub fn new(scene: &Loaded, camera: Camera, radius: f64) -> Result<Self, SplatError> {
        // What flies between the camera and the ball hides nothing.
        let near = ((DISTANCE - 1.0) * radius) as f32;
        let options = RenderOptions { depth: true, near, ..RenderOptions::inria() };
        let rendered = render(&scene.seen_by(&camera)?, std::slice::from_ref(&camera), &options)?;
        let alpha = host(rendered.alpha);
        let depth = host(rendered.depth.expect("asked for"));
        let color = host(rendered.color);
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

    /// The pixel of a place and its depth.
    fn pixel(&self, place: Vec3) -> Option<(usize, f32)> {
        let p = self.projection.transform_point3(place);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let side = self.side as f32;
        let within = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < side && y < side;
        // What is not below 0 is rounded down like this.
        within.then(|| (y as usize * self.side as usize + x as usize, p.z))
    }

    /// What is known of a place.
    pub fn see(&self, place: Vec3) -> Seen {
        let Some((pixel, z)) = self.pixel(place) else { return Seen::Unknown };
        match (self.depth[pixel], self.facing[pixel]) {
            (0.0, _) => Seen::Free,
            (_, 0.0) => Seen::Unknown,
            (depth, facing) => Seen::Surface { distance: depth - z, facing },
        }
    }

    /// The colour that is seen at a place, if a surface lies within `reach` metres of it.
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
    let (linear, offset) = (pixels * rotation, pixels * translation);
    let column = |v: DVec3, w: f32| v.as_vec3().extend(w);
    let [x, y, z] = [linear.x_axis, linear.y_axis, linear.z_axis].map(|v| column(v, 0.0));
    Mat4::from_cols(x, y, z, column(offset, 1.0))
}

/// Cosines between the rays and the normals of a depth map.
fn facing(depth: &[f32], camera: &Camera) -> Vec<f32> {
    let side = camera.width as usize;
    let point = |x: usize, y: usize| {
        let z = depth[y * side + x];
        let at = |i: usize, focal: f64, centre: f64| ((i as f64 + 0.5 - centre) / focal) as f32;
        let (x, y) = (
            at(x, camera.focal.x, camera.principal_point.x),
            at(y, camera.focal.y, camera.principal_point.y),
        );
        (z > 0.0).then(|| z * Vec3::new(x, y, 1.0))
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

fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line")
}
