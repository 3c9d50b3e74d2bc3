//! Geometry of a person: ground-truth points of all views, and distances of reconstructions from them.

use glam::DVec3;
use rayon::prelude::*;
use snapsnap_data::sample::Handling;
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_mesh::mesh::Mesh;
use snapsnap_mesh::view::{Renderer, ViewOptions};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use super::at_once;
use super::person::{People, means, nearest_view, part_of};
use crate::EvalError;
use crate::geometry::{Chamfer, chamfer, consistency, double, normals, points, sampled};

/// Largest number of ground-truth points per view.
const PER_VIEW: usize = 4000;
/// Largest number of compared Gaussians.
const MOST: usize = 60_000;
/// Largest side of maps of normals, at which a pixel is about a centimetre wide. Finer maps would measure roughness.
const NORMALS: usize = 256;
/// Seed of the points drawn from a mesh.
const SEED: u64 = 1;
/// Directions from which normals are compared, degrees from the first view.
const DIRECTIONS: [f64; 4] = [0.0, 90.0, 180.0, 270.0];

/// Distances of a surface from the ground truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Metres.
    pub chamfer: Chamfer,
    /// Mean cosine of normals from four sides, at pixels with both normals.
    pub normals: Option<f64>,
}

/// Ground truth of a person.
pub struct Truth {
    /// World frame, metres.
    pub points: Vec<[f32; 3]>,
    /// Cameras of the views nearest to the four directions, with at most 256² pixels, and their normals.
    pub views: Vec<(Camera, Vec<Option<DVec3>>)>,
}

/// Ground truth of a person from the depth maps.
///
/// # Errors
/// [`EvalError`] for files that cannot be read, or that have no point.
pub fn truth(people: &People, row: usize) -> Result<Truth, EvalError> {
    let cameras = people.test().sample(row, &[], &Handling::default())?.cameras;
    let directions = DIRECTIONS.map(|wanted| nearest_view(&cameras, 0, wanted));
    let of_view = |(view, camera): (usize, &Camera)| {
        let (points, valid) = people.test().points(row, &[view])?;
        let to_world = camera.world_to_camera.inverse();
        let there: Vec<usize> = (0..valid.len()).filter(|i| valid[*i] > 0.5).collect();
        let in_world = |i| to_world.apply(double(points.as_chunks().0[i])).as_vec3().to_array();
        let kept: Vec<[f32; 3]> = thinned(&there, PER_VIEW).into_iter().map(in_world).collect();
        let normals = directions.contains(&view).then(|| {
            let stored = camera.width as usize;
            let side = part_of(stored, NORMALS);
            let (points, valid) = means(&points, &valid, stored, side);
            let camera = camera.resized(side as u32, side as u32);
            let depth = |i: usize| if valid[i] > 0.5 { points[3 * i + 2] } else { 0.0 };
            (camera, normals(&(0..valid.len()).map(depth).collect::<Vec<f32>>(), &camera))
        });
        Ok((kept, normals))
    };
    let numbered: Vec<(usize, &Camera)> = cameras.iter().enumerate().collect();
    let mut found = Vec::new();
    for views in numbered.chunks(at_once(people.folder().description().resolution as usize)) {
        let part: Result<Vec<_>, EvalError> = views.par_iter().map(|view| of_view(*view)).collect();
        found.extend(part?);
    }
    let (points, views): (Vec<_>, Vec<_>) = found.into_iter().unzip();
    let truth = Truth { points: points.concat(), views: views.into_iter().flatten().collect() };
    if truth.points.is_empty() {
        return Err(EvalError::Empty("no view has a depth: there is no ground truth".into()));
    }
    Ok(truth)
}

impl Truth {
    /// Mean cosine between the normals of the ground truth and those of the depth maps that `depth` returns.
    ///
    /// # Errors
    /// Those of `depth`.
    pub fn agreement(
        &self,
        depth: impl Fn(&Camera) -> Result<Vec<f32>, EvalError>,
    ) -> Result<Option<f64>, EvalError> {
        let (mut sum, mut count) = (0.0, 0);
        for (camera, expected) in &self.views {
            if let Some((cosine, pixels)) = consistency(&normals(&depth(camera)?, camera), expected) {
                sum += cosine * pixels as f64;
                count += pixels;
            }
        }
        Ok((count > 0).then(|| sum / count as f64))
    }

    /// The same for a mesh (world frame, metres).
    ///
    /// # Errors
    /// [`EvalError::Empty`] for a mesh that cannot be drawn.
    pub fn agreement_of_mesh(&self, mesh: &Mesh) -> Result<Option<f64>, EvalError> {
        let renderer = Renderer::new(mesh).map_err(|e| EvalError::Empty(e.to_string()))?;
        let options = ViewOptions { samples: 1, ..ViewOptions::default() };
        self.agreement(|camera| Ok(renderer.draw(camera, &options).depth))
    }
}

/// At most `most` entries of a list, at equal distances.
pub(super) fn thinned<T: Copy>(all: &[T], most: usize) -> Vec<T> {
    let kept = all.len().min(most);
    (0..kept).map(|i| all[i * all.len() / kept]).collect()
}

impl Surface {
    /// Distances of Gaussians (world frame): of the centres of those with an opacity of at least `opaque`, and of their
    /// rendered depths.
    ///
    /// # Errors
    /// [`EvalError`] if no Gaussian is so opaque.
    pub fn of_gaussians(gaussians: &Gaussians, truth: &Truth, opaque: f32) -> Result<Self, EvalError> {
        let opacities = snapsnap_ops::host(gaussians.opacities.clone());
        let centres = points(&gaussians.means)?;
        let there: Vec<[f32; 3]> =
            centres.into_iter().zip(opacities).filter(|(_, o)| *o >= opaque).map(|(p, _)| p).collect();
        let there = thinned(&there, MOST);
        let depth = |camera: &Camera| {
            let options = RenderOptions { depth: true, ..RenderOptions::inria() };
            let rendered = render(gaussians, std::slice::from_ref(camera), &options)?;
            let depth = snapsnap_ops::host(rendered.depth.expect("an option"));
            let alpha = snapsnap_ops::host(rendered.alpha);
            // Depths are weighted by coverage. A surface has at least half.
            Ok(depth.iter().zip(alpha).map(|(z, a)| if a > 0.5 { z / a } else { 0.0 }).collect())
        };
        Ok(Self { chamfer: chamfer(&there, &truth.points)?, normals: truth.agreement(depth)? })
    }

    /// Distances of the mesh of Gaussians (world frame): of points drawn from it, and of the depths of its triangles.
    ///
    /// # Errors
    /// [`EvalError`] if no mesh can be made of them.
    pub fn of_mesh(gaussians: &Gaussians, truth: &Truth) -> Result<Self, EvalError> {
        let fused = fuse(&gaussians.clone().into(), Options::default(), &|_| {});
        let mesh = fused.map_err(|e| EvalError::Empty(e.to_string()))?.into_world();
        let drawn = sampled(&mesh, MOST, SEED)?;
        Ok(Self { chamfer: chamfer(&drawn, &truth.points)?, normals: truth.agreement_of_mesh(&mesh)? })
    }
}
