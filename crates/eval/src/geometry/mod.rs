//! Distances between surfaces and the cosine of their normals, without alignment unless [`icp`] is called. Lengths have
//! the unit of the points, metres in this project. Reports print centimetres.

mod align;

use glam::{DVec2, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use parry3d::math::Vector;
use parry3d::query::PointQuery;
use parry3d::shape::TriMesh;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_ops::host;
use snapsnap_splat::{Camera, Gaussians};

use crate::{EvalError, Result};
pub(crate) use align::{ALIGNED, procrustes};
pub use align::{Align, Alignment, icp};

/// Largest coordinate of a point in metres. The squares of larger coordinates overflow f32.
const FARTHEST: f32 = 1e15;

/// Largest difference of neighbouring depths on one surface, relative to the depth: a slope of 84° at the 2 m and 1024
/// pixels of the published cameras.
const JUMP: f32 = 0.01;

/// Least opacity of Gaussians that belong to the surface.
pub(crate) const OPAQUE: f32 = 0.5;

/// Mean distances between two sets of points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chamfer {
    /// From each point of the first set to the nearest point of the second set.
    pub forward: f64,
    /// From each point of the second set to the nearest point of the first set.
    pub backward: f64,
}

impl Chamfer {
    /// The bidirectional mean.
    pub fn mean(&self) -> f64 {
        0.5 * (self.forward + self.backward)
    }
}

/// Centres of at most `most` Gaussians with an opacity of at least [`OPAQUE`].
///
/// # Errors
/// [`EvalError::Message`] if no Gaussian is so opaque.
pub(crate) fn opaque_centres(gaussians: &Gaussians, most: usize) -> Result<Vec<[f32; 3]>> {
    let means = host(gaussians.means.clone());
    let centres = means.as_chunks().0.iter().zip(host(gaussians.opacities.clone()));
    let centres: Vec<[f32; 3]> = centres.filter(|(_, own)| *own >= OPAQUE).map(|(p, _)| *p).collect();
    if centres.is_empty() {
        return Err(EvalError::new(format!("no Gaussian has an opacity of {OPAQUE} or more")));
    }
    Ok(thinned(&centres, most))
}

/// At most `most` entries of a list, at equal steps.
pub(crate) fn thinned<T: Copy>(all: &[T], most: usize) -> Vec<T> {
    let kept = all.len().min(most);
    (0..kept).map(|i| all[i * all.len() / kept]).collect()
}

fn check_points(points: &[[f32; 3]]) -> Result<()> {
    if points.is_empty() {
        return Err(EvalError::new("there is no point"));
    }
    // Written so that a NaN fails as well.
    match points.iter().position(|p| !p.iter().all(|v| v.abs() <= FARTHEST)) {
        Some(row) => Err(EvalError::new(format!("point {row} is not finite, or beyond {FARTHEST:e} m"))),
        None => Ok(()),
    }
}

/// Mean Euclidean distances to the nearest neighbour, both ways.
///
/// # Errors
/// [`EvalError::Message`] for a set without points or with one that is not finite.
pub fn chamfer(a: &[[f32; 3]], b: &[[f32; 3]]) -> Result<Chamfer> {
    check_points(a)?;
    check_points(b)?;
    let one_way = |from: &[[f32; 3]], to: &[[f32; 3]]| {
        let distances = nearest(from, to).into_iter().map(|(_, distance)| distance);
        distances.sum::<f64>() / from.len() as f64
    };
    Ok(Chamfer { forward: one_way(a, b), backward: one_way(b, a) })
}

/// For each point of `from`, the row of the nearest point of `to` and its distance.
pub(crate) fn nearest(from: &[[f32; 3]], to: &[[f32; 3]]) -> Vec<(usize, f64)> {
    let tree = ImmutableKdTree::<f32, 3>::new_from_slice(to).expect("fewer points than u32 can number");
    let found = tree.query_batch(from).nearest_one::<SquaredEuclidean<f32>>().execute();
    let apart = |(p, row): (&[f32; 3], usize)| (row, distance(*p, to[row]));
    from.iter().zip(found.iter().map(|found| found.item as usize)).map(apart).collect()
}

/// A point in f64.
pub(crate) fn double(point: [f32; 3]) -> DVec3 {
    DVec3::from_array(point.map(f64::from))
}

pub(crate) fn distance(a: [f32; 3], b: [f32; 3]) -> f64 {
    (double(a) - double(b)).length()
}

/// Mean Euclidean distance from points to the triangles of a mesh.
///
/// # Errors
/// [`EvalError::Message`] without points, if a point is not finite, or for a mesh without area.
pub fn point_to_surface(points: &[[f32; 3]], mesh: &Mesh) -> Result<f64> {
    check_points(points)?;
    check_points(&mesh.positions.iter().map(|p| p.to_array()).collect::<Vec<_>>())?;
    let vertices = mesh.positions.iter().map(|p| Vector::new(p.x, p.y, p.z)).collect();
    let mut faces: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.positions).collect();
    // Queries visit every copy of a nearest face. A damaged file may have thousands.
    faces.iter_mut().for_each(|corners| corners.sort_unstable());
    faces.sort_unstable();
    faces.dedup();
    let surface =
        TriMesh::new(vertices, faces).map_err(|e| EvalError::new(format!("the mesh has no surface: {e}")))?;
    let apart = |p: &[f32; 3]| {
        let on = surface.project_local_point(Vector::new(p[0], p[1], p[2]), false).point;
        distance(*p, [on.x, on.y, on.z])
    };
    let distances: Vec<f64> = points.par_iter().map(apart).collect();
    Ok(distances.iter().sum::<f64>() / points.len() as f64)
}

/// Points drawn uniformly from the surface of a mesh. One seed always draws the same points.
///
/// # Errors
/// [`EvalError::Message`] for a mesh without area.
pub fn sampled(mesh: &Mesh, count: usize, seed: u64) -> Result<Vec<[f32; 3]>> {
    let corners = |face: usize| mesh.faces[face].positions.map(|row| mesh.positions[row as usize].as_dvec3());
    let mut total = 0.0;
    let area_up_to = |face: usize| {
        let [a, b, c] = corners(face);
        total += 0.5 * (b - a).cross(c - a).length();
        total
    };
    let areas: Vec<f64> = (0..mesh.faces.len()).map(area_up_to).collect();
    if !(total > 0.0 && total.is_finite()) {
        return Err(EvalError::new("the mesh has no area"));
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut one = || {
        let at = random.random::<f64>() * total;
        let [a, b, c] = corners(areas.partition_point(|sum| *sum <= at).min(areas.len() - 1));
        let (mut u, mut v) = (random.random::<f64>(), random.random::<f64>());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        (a + u * (b - a) + v * (c - a)).as_vec3().to_array()
    };
    Ok((0..count).map(|_| one()).collect())
}

/// Unit normals `[H, W]` towards the camera, in the camera's axes, of a depth map `[H, W]` (metres along the optical
/// axis, 0 for no depth), from central differences of the points. `None` at the rims of surfaces and of the picture.
pub fn normals(depth: &[f32], camera: &Camera) -> Vec<Option<DVec3>> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let point = |x: usize, y: usize| {
        let z = f64::from(depth[y * width + x]);
        let ray = (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - camera.principal_point) / camera.focal;
        z * DVec3::new(ray.x, ray.y, 1.0)
    };
    let normal = |x: usize, y: usize| {
        if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            return None;
        }
        let here = depth[y * width + x];
        let near = |x: usize, y: usize| {
            let there = depth[y * width + x];
            there > 0.0 && (there - here).abs() <= JUMP * here
        };
        if here <= 0.0 || !near(x - 1, y) || !near(x + 1, y) || !near(x, y - 1) || !near(x, y + 1) {
            return None;
        }
        let across = point(x + 1, y) - point(x - 1, y);
        let down = point(x, y + 1) - point(x, y - 1);
        // x right, y down: down × across points back to the camera.
        down.cross(across).try_normalize()
    };
    (0..width * height).map(|i| normal(i % width, i / width)).collect()
}

/// Mean cosine between the normals of two maps and the number of compared pixels, which have a normal in both maps;
/// `None` if there is no such pixel.
pub fn consistency(a: &[Option<DVec3>], b: &[Option<DVec3>]) -> Option<(f64, usize)> {
    let (mut sum, mut count) = (0.0, 0_usize);
    for (a, b) in a.iter().zip(b).filter_map(|(a, b)| a.zip(*b)) {
        sum += a.dot(b);
        count += 1;
    }
    (count > 0).then(|| (sum / count as f64, count))
}
