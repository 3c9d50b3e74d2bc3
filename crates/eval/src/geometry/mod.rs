//! Distances between surfaces, without alignment unless [`icp`] is called. Lengths have the unit of the points, metres
//! in this project. Reports print centimetres.

mod align;
mod normals;

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use parry3d::math::Vector;
use parry3d::query::PointQuery;
use parry3d::shape::TriMesh;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use crate::{EvalError, Result};
pub(crate) use align::{ALIGNED, procrustes};
pub use align::{Align, Alignment, icp};
pub use normals::{consistency, normals};

/// Largest coordinate of a point in metres. The squares of larger coordinates overflow f32.
const FARTHEST: f32 = 1e15;

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
    let areas: Vec<f64> = (0..mesh.faces.len())
        .map(|face| {
            let [a, b, c] = corners(face);
            total += 0.5 * (b - a).cross(c - a).length();
            total
        })
        .collect();
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
