//! Views of Gaussians from all around: depth, the angle between surface and ray, and colour; and the vertex colours of a
//! surface, from the views that face it.

use burn::tensor::Tensor;
use glam::{DAffine3, DMat3, DMat4, DVec2, DVec3, Mat4, Vec3};
use rayon::prelude::*;
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Camera, Orbit, RenderOptions, RigidTransform, SplatError, render};

use crate::mesh::Mesh;

/// Rings of cameras around the subject: downward pitch in degrees, and number of cameras.
pub const RINGS: [(f64, usize); 7] =
    [(-85.0, 1), (-55.0, 6), (-25.0, 10), (5.0, 16), (35.0, 10), (65.0, 6), (88.0, 1)];
/// Distance of the cameras from the centre of a ball, in radii: perspective hides little, and f32 suffices for depths.
const DISTANCE: f64 = 4.0;
/// Share of a picture's width that the ball fills.
pub const FILLED: f64 = 0.98;
/// Least coverage of a pixel that shows a surface.
pub const COVERED: f32 = 0.5;
/// Least cosine between a surface's normal and the ray. Pixels of more oblique surfaces mix several surfaces.
const FLATTEST: f32 = 0.15;
/// Side in pixels of the squares that are tested for the inner side as a whole.
const SQUARE: usize = 2;
/// Ratio of views of the other side to views of this side, weighted by cosines, from which this side is the inner one.
const OTHER_SIDE: f32 = 2.0;
/// Largest distance between a point and the surface in a view that gives the point its colour, in cubes of the field.
pub const REACH: f32 = 3.0;
/// The weight of a view is its cosine to this power.
const SHARPNESS: i32 = 6;
/// Number of rounds in which colours spread to neighbours that no view shows.
const ROUNDS: usize = 200;

/// View of one camera.
pub struct View {
    camera: Camera,
    /// Centre of the camera, metres from the body's centre.
    centre: Vec3,
    /// From the world to (x z, y z, z), with x and y in pixels and the depth z.
    projection: Mat4,
    /// Length along the optical axis; 0 at pixels without a surface.
    depth: Vec<f32>,
    /// Cosine between normal and ray; 0 if the normal is unknown, the surface too oblique or seen from inside.
    facing: Vec<f32>,
    /// Red, green and blue in [0, 1], divided by the coverage.
    color: Vec<Vec3>,
}

/// Cameras on rings around a ball at the origin. Each picture of `side`² pixels shows the whole ball.
pub fn cameras(rings: &[(f64, usize)], radius: f64, side: u32) -> Vec<Camera> {
    let distance = DISTANCE * radius;
    let focal = (distance * distance / (radius * radius) - 1.0).sqrt() * 0.5 * FILLED;
    let orbit = Orbit { centre: DVec3::ZERO, radius: distance, focal, ..Orbit::default() };
    let ring = |(row, (pitch_degrees, count)): (usize, &(f64, usize))| {
        let (pitch_degrees, count) = (*pitch_degrees, *count);
        (0..count).map(move |i| {
            let yaw_degrees = 360.0 * (i as f64 + 0.5 * (row % 2) as f64) / count as f64;
            let camera = Orbit { yaw_degrees, pitch_degrees, ..orbit }.camera(side);
            Camera { principal_point: DVec2::splat(0.5 * f64::from(side)), ..camera }
        })
    };
    rings.iter().enumerate().flat_map(ring).collect()
}

impl View {
    /// Renders Gaussians from one of the [`cameras`]. Refuses more than `max_intersections` pairs of splat and tile.
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
        let mut view = Self::of_depth(camera, depth);
        view.color = color;
        Ok(view)
    }

    /// The depths of points, each of which covers a square of 2·`reach` + 1 pixels. There are no colours.
    pub fn of_points(points: &[Vec3], camera: Camera, reach: usize) -> Self {
        let mut view = Self::of_depth(camera, Vec::new());
        let side = view.camera.width as usize;
        let mut depth = vec![f32::INFINITY; side * side];
        for (pixel, z) in points.iter().filter_map(|place| view.pixel(*place)) {
            let (x, y) = (pixel % side, pixel / side);
            for row in y.saturating_sub(reach)..(y + reach + 1).min(side) {
                for depth in &mut depth[row * side..][x.saturating_sub(reach)..(x + reach + 1).min(side)] {
                    *depth = depth.min(z);
                }
            }
        }
        view.depth = depth.into_iter().map(|z| if z < f32::INFINITY { z } else { 0.0 }).collect();
        view.facing = view.cosines();
        view
    }

    fn of_depth(camera: Camera, depth: Vec<f32>) -> Self {
        let mut view = Self {
            centre: camera.centre().as_vec3(),
            projection: projection(&camera),
            facing: Vec::new(),
            camera,
            depth,
            color: Vec::new(),
        };
        view.facing = view.cosines();
        view
    }

    /// The cosine of every pixel between normal and ray; see [`Self::facing`].
    fn cosines(&self) -> Vec<f32> {
        let cosine = |pixel| {
            let Some((place, normal)) = self.patch(pixel) else { return 0.0 };
            let cosine = -normal.dot(place.normalize_or_zero());
            if cosine < FLATTEST { 0.0 } else { cosine }
        };
        (0..self.depth.len()).map(cosine).collect()
    }

    /// Position and normal (towards the camera) of the surface in a pixel, metres in the camera's frame. `None` at
    /// the border of the picture and of the surface.
    fn patch(&self, pixel: usize) -> Option<(Vec3, Vec3)> {
        let side = self.camera.width as usize;
        let (x, y) = (pixel % side, pixel / side);
        if x == 0 || y == 0 || x + 1 == side || y + 1 == side {
            return None;
        }
        let point = |x: usize, y: usize| {
            let z = self.depth[y * side + x];
            let Camera { principal_point, focal, .. } = self.camera;
            let at = (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - principal_point) / focal;
            (z > 0.0).then(|| z * at.as_vec2().extend(1.0))
        };
        let place = point(x, y)?;
        let across = point(x + 1, y)? - point(x - 1, y)?;
        let down = point(x, y + 1)? - point(x, y - 1)?;
        let normal = across.cross(down).normalize_or_zero();
        Some((place, if normal.dot(place) > 0.0 { -normal } else { normal }))
    }

    /// Pixel and depth of a point.
    fn pixel(&self, place: Vec3) -> Option<(usize, f32)> {
        let p = self.projection.transform_point3(place);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let side = self.camera.width as f32;
        let within = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < side && y < side;
        // The conversion of non-negative numbers rounds down.
        within.then(|| (y as usize * self.camera.width as usize + x as usize, p.z))
    }

    /// Distance in metres along the optical axis from a point to the surface in the view, and the cosine between the
    /// surface's normal and the ray. The distance is negative for a surface in front of the point and infinite
    /// without one. `None` outside of the picture and at pixels that cannot be trusted.
    pub fn surface(&self, place: Vec3) -> Option<(f32, f32)> {
        let (pixel, z) = self.pixel(place)?;
        match (self.depth[pixel], self.facing[pixel]) {
            (0.0, _) => Some((f32::INFINITY, 1.0)),
            (_, 0.0) => None,
            (depth, facing) => Some((depth - z, facing)),
        }
    }

    /// The pixel that shows a point of the surface, within `reach` metres.
    fn shown(&self, place: Vec3, reach: f32) -> Option<usize> {
        let (pixel, z) = self.pixel(place)?;
        (self.facing[pixel] > 0.0 && (self.depth[pixel] - z).abs() < reach).then_some(pixel)
    }

    /// Unit vector from the camera to a point.
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

/// Marks pixels that show the inner side of a surface as not to be trusted. Level cameras do not see the top of a head.
/// A camera above sees the far wall from inside through this hole, and the space before the wall is not outside. The
/// outer side is visible in more views. `reach`: largest distance between both sides of a surface, metres.
pub fn distrust_inner_sides(views: &mut [View], reach: f32) {
    let inner = |view: &View, pixel: usize| {
        let (place, normal) = view.patch(pixel)?;
        let to_world = view.camera.world_to_camera.rotation.transpose().as_mat3();
        let (place, normal) = (view.centre + to_world * place, to_world * normal);
        let (mut this, mut other) = (0.0, 0.0);
        for from in views.iter() {
            if from.shown(place, reach).is_some() {
                let cosine = -normal.dot(from.towards(place));
                *(if cosine > 0.0 { &mut this } else { &mut other }) += cosine.abs();
            }
        }
        Some(other > OTHER_SIDE * this)
    };
    let squares = |view: &View| {
        let side = view.camera.width as usize;
        let corners = (0..side).step_by(SQUARE).flat_map(|y| (0..side).step_by(SQUARE).map(move |x| (x, y)));
        let square = |(x, y): (usize, usize)| {
            let rows = y..(y + SQUARE).min(side);
            let pixels = rows.flat_map(move |y| (x..(x + SQUARE).min(side)).map(move |x| y * side + x));
            let is_inner = |pixel| inner(view, pixel) == Some(true);
            let known = pixels.clone().find(|pixel| view.facing[*pixel] > 0.0);
            known.is_some_and(is_inner).then_some(pixels)
        };
        corners.filter_map(square).flatten().collect()
    };
    let marked: Vec<Vec<usize>> = views.par_iter().map(squares).collect();
    for (view, pixels) in views.iter_mut().zip(marked) {
        pixels.into_iter().for_each(|pixel| view.facing[pixel] = 0.0);
    }
}

/// Weighted mean of a point's colours in the views.
#[derive(Debug, Clone, Copy, Default)]
pub struct Mean {
    sum: Vec3,
    weight: f32,
}

impl Mean {
    /// Adds a view if it shows the point `place`, whose normal is `normal`.
    pub fn add(&mut self, view: &View, place: Vec3, normal: Vec3, reach: f32) {
        let square = -view.towards(place).dot(normal);
        if square <= 0.0 {
            return;
        }
        if let Some(pixel) = view.shown(place, reach) {
            let weight = (square * view.facing[pixel]).powi(SHARPNESS);
            self.sum += weight * view.color[pixel];
            self.weight += weight;
        }
    }

    /// The colour, if any view showed the point.
    pub fn color(&self) -> Option<Vec3> {
        (self.weight > 0.0).then(|| (self.sum / self.weight).clamp(Vec3::ZERO, Vec3::ONE))
    }
}

/// Colours of all positions. Positions that no view shows (armpits, soles) have the mean colour of their neighbours.
pub fn colors(mesh: &Mesh, views: &[View], cell: f32) -> Vec<Vec3> {
    let normals = mesh.normals();
    let color = |(place, normal): (&Vec3, &Vec3)| {
        let mut mean = Mean::default();
        views.iter().for_each(|view| mean.add(view, *place, *normal, REACH * cell));
        mean.color()
    };
    let mut colors: Vec<Option<Vec3>> = mesh.positions.par_iter().zip(&normals).map(color).collect();
    for _ in 0..ROUNDS {
        if colors.iter().all(Option::is_some) {
            break;
        }
        let mut around = vec![(Vec3::ZERO, 0.0); colors.len()];
        for face in &mesh.faces {
            for (to, from) in [(0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)] {
                let [to, from] = [to, from].map(|corner: usize| face.positions[corner] as usize);
                if let (None, Some(color)) = (colors[to], colors[from]) {
                    around[to].0 += color;
                    around[to].1 += 1.0;
                }
            }
        }
        for (color, (sum, count)) in colors.iter_mut().zip(around) {
            if count > 0.0 {
                *color = Some(sum / count);
            }
        }
    }
    colors.into_iter().map(Option::unwrap_or_default).collect()
}

/// The values of a tensor.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line")
}
