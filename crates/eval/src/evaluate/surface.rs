//! Geometry of a person: ground-truth points of all views, and distances of reconstructions from them.

use glam::DVec3;
use rayon::prelude::*;
use snapsnap_data::sample::PhotographChanges;
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_mesh::mesh::Mesh;
use snapsnap_mesh::view::{Renderer, ViewOptions};
use snapsnap_net::dilated;
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use super::person::{People, means, nearest_view, part_of};
use super::shared::at_once;
use crate::geometry::{Chamfer, chamfer, consistency, double, normals, opaque_centres, sampled, thinned};
use crate::{EvalError, Result};

/// Largest number of ground-truth points per view.
const PER_VIEW: usize = 4000;
/// Largest number of compared Gaussians.
const MOST: usize = 60_000;
/// Largest side of maps of normals in pixels. A pixel is then about a centimetre wide; finer maps measure roughness.
const NORMALS: usize = 256;
/// Seed of the points drawn from a mesh.
const SEED: u64 = 1;
/// Directions from which surfaces are compared, degrees from the first view. Normals are compared from the first four.
const DIRECTIONS: [f64; 8] = [0.0, 90.0, 180.0, 270.0, 45.0, 135.0, 225.0, 315.0];
/// Least coverage of a pixel that is closed.
const CLOSED: f32 = 0.9;
/// Largest distance in metres of a closed pixel's surface behind the true one. The back's inner side lies farther off.
const BEHIND: f32 = 0.06;
/// Width, in pixels of a map of side [`NORMALS`], of the rim that does not count, beside outlines and beside depth
/// steps of [`BEHIND`]. A slightly wrong outline is no hole.
const RIM: usize = 3;

/// Distances of a surface from the ground truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Distances in metres.
    pub chamfer: Chamfer,
    /// Mean cosine of normals from four sides, at pixels with both normals.
    pub normals: Option<f64>,
    /// Share of the true surface's pixels, from eight sides, that are open ([`Truth::open`]); `None` for meshes.
    pub open: Option<f64>,
}

/// A view of the truth with at most 256² pixels.
pub struct TrueView {
    /// Its camera.
    pub camera: Camera,
    /// Metres, 0 where the person is not.
    pub depth: Vec<f32>,
    /// Normals, if they are compared.
    pub normals: Option<Vec<Option<DVec3>>>,
}

/// Ground truth of a person.
pub struct Truth {
    /// World frame, metres.
    pub points: Vec<[f32; 3]>,
    /// The views nearest to the eight directions.
    pub views: Vec<TrueView>,
}

/// Ground truth of a person from the depth maps.
///
/// # Errors
/// [`EvalError`] for files that cannot be read, or if no view has a point.
pub fn truth(people: &People, row: usize) -> Result<Truth> {
    let cameras = people.test.sample(row, &[], &PhotographChanges::default())?.cameras;
    let directions = DIRECTIONS.map(|wanted| nearest_view(&cameras, 0, wanted));
    let of_view = |(view, camera): (usize, &Camera)| {
        let (points, valid) = people.test.points(row, &[view])?;
        let to_world = camera.world_to_camera.inverse();
        let there: Vec<usize> = (0..valid.len()).filter(|i| valid[*i] > 0.5).collect();
        let in_world = |i| to_world.apply(double(points.as_chunks().0[i])).as_vec3().to_array();
        let kept: Vec<[f32; 3]> = thinned(&there, PER_VIEW).into_iter().map(in_world).collect();
        let seen = directions.contains(&view).then(|| {
            let stored = camera.width as usize;
            let side = part_of(stored, NORMALS);
            let (points, valid) = means(&points, &valid, stored, side);
            let camera = camera.resized(side as u32, side as u32);
            let depth = |i: usize| if valid[i] > 0.5 { points[3 * i + 2] } else { 0.0 };
            let depth: Vec<f32> = (0..valid.len()).map(depth).collect();
            let normals = directions[..4].contains(&view).then(|| normals(&depth, &camera));
            TrueView { camera, depth, normals }
        });
        Ok((kept, seen))
    };
    let numbered: Vec<(usize, &Camera)> = cameras.iter().enumerate().collect();
    let parts = numbered.chunks(at_once(people.folder.description().resolution as usize));
    let found = parts.map(|views| views.par_iter().map(|view| of_view(*view)).collect::<Result<Vec<_>>>());
    let (points, views): (Vec<_>, Vec<_>) = found.collect::<Result<Vec<_>>>()?.into_iter().flatten().unzip();
    let truth = Truth { points: points.concat(), views: views.into_iter().flatten().collect() };
    if truth.points.is_empty() {
        return Err(EvalError::new("no view has a depth: there is no ground truth"));
    }
    Ok(truth)
}

impl Truth {
    /// Mean cosine between the true normals and the normals of the depth maps that `depth` returns for the views.
    pub fn agreement(&self, depth: impl Fn(usize) -> Vec<f32>) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0);
        for (i, view) in self.views.iter().enumerate() {
            let Some(expected) = &view.normals else { continue };
            if let Some((cosine, pixels)) = consistency(&normals(&depth(i), &view.camera), expected) {
                sum += cosine * pixels as f64;
                count += pixels;
            }
        }
        (count > 0).then(|| sum / count as f64)
    }

    /// [`Self::agreement`] for the depth maps of a mesh (world frame, metres).
    ///
    /// # Errors
    /// [`EvalError::Message`] for a mesh that cannot be drawn.
    pub fn agreement_of_mesh(&self, mesh: &Mesh) -> Result<Option<f64>> {
        let renderer = Renderer::new(mesh).map_err(EvalError::new)?;
        let options = ViewOptions { samples: 1, ..ViewOptions::default() };
        Ok(self.agreement(|i| renderer.draw(&self.views[i].camera, &options).depth))
    }

    /// Share of the true surface's pixels that are open: hardly covered, or showing a surface far behind. `drawn` has
    /// each view's depth (metres times coverage) and coverage. `None` if no pixel counts.
    pub fn open(&self, drawn: &[[Vec<f32>; 2]]) -> Option<f64> {
        let (mut open, mut count) = (0_u64, 0_u64);
        for (TrueView { camera, depth: truth, .. }, [depth, alpha]) in self.views.iter().zip(drawn) {
            let width = camera.width as usize;
            let is_step = |i: usize| {
                let beside = [(i % width + 1 < width).then_some(i + 1), Some(i + width)];
                let to = beside.into_iter().flatten().filter_map(|to| truth.get(to));
                truth[i] <= 0.0 || to.into_iter().any(|z| (z - truth[i]).abs() > BEHIND)
            };
            let steps: Vec<bool> = (0..truth.len()).map(is_step).collect();
            let is_left_out = dilated(&steps, width, (RIM * width).div_ceil(NORMALS));
            for i in (0..truth.len()).filter(|i| !is_left_out[*i]) {
                count += 1;
                open += u64::from(alpha[i] < CLOSED || depth[i] / alpha[i] > truth[i] + BEHIND);
            }
        }
        (count > 0).then(|| open as f64 / count as f64)
    }
}

impl Surface {
    /// Compares Gaussians (world frame) with the truth: the centres of Gaussians that are at least half opaque, and the
    /// rendered depths.
    ///
    /// # Errors
    /// [`EvalError`] if no Gaussian is so opaque.
    pub fn of_gaussians(gaussians: &Gaussians, truth: &Truth) -> Result<Self> {
        let centres = opaque_centres(gaussians, MOST)?;
        let options = RenderOptions { depth: true, ..RenderOptions::inria() };
        let drawn = |view: &TrueView| {
            let rendered = render(gaussians, std::slice::from_ref(&view.camera), &options)?;
            Ok([rendered.depth.expect("an option"), rendered.alpha].map(snapsnap_ops::host))
        };
        let drawn: Vec<[Vec<f32>; 2]> = truth.views.iter().map(drawn).collect::<Result<_>>()?;
        // Depths are weighted by coverage. A pixel of a surface has a coverage above ½.
        let surface = |[depth, alpha]: &[Vec<f32>; 2]| {
            depth.iter().zip(alpha).map(|(z, a)| if *a > 0.5 { z / a } else { 0.0 }).collect()
        };
        let normals = truth.agreement(|i| surface(&drawn[i]));
        Ok(Self { chamfer: chamfer(&centres, &truth.points)?, normals, open: truth.open(&drawn) })
    }

    /// Compares the mesh of Gaussians (world frame) with the truth: points drawn from the mesh, and its depth maps.
    ///
    /// # Errors
    /// [`EvalError`] if no mesh can be made of the Gaussians.
    pub fn of_mesh(gaussians: &Gaussians, truth: &Truth) -> Result<Self> {
        let fused = fuse(&gaussians.clone().into(), Options::default(), &|_| {});
        let mesh = fused.map_err(EvalError::new)?.mesh;
        let drawn = sampled(&mesh, MOST, SEED)?;
        let normals = truth.agreement_of_mesh(&mesh)?;
        Ok(Self { chamfer: chamfer(&drawn, &truth.points)?, normals, open: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall of 32 × 80 pixels whose lower half stands back. It is drawn with a hole, with a part that shows a
    /// surface far behind, and with a thin part.
    #[test]
    fn open_pixels_are_uncovered_or_show_what_lies_behind() {
        let side = 256;
        let camera = Camera::orbit_at_yaw_degrees(0.0, side as u32);
        let is_wall = |i: usize| (10..42).contains(&(i % side)) && (12..92).contains(&(i / side));
        // The lower half stands back by 10 cm.
        let depth = |i: usize| if i / side < 52 { 2.0 } else { 2.1 };
        let depth: Vec<f32> = (0..side * side).map(|i| if is_wall(i) { depth(i) } else { 0.0 }).collect();
        let views = vec![TrueView { camera, depth: depth.clone(), normals: None }];
        let truth = Truth { points: Vec::new(), views };
        let drawn = |of: &dyn Fn(usize) -> (f32, f32)| {
            let (depth, alpha): (Vec<f32>, Vec<f32>) = (0..side * side).map(of).unzip();
            truth.open(&[[depth, alpha]]).expect("pixels")
        };
        // Without three pixels inside the outline. On the right and below, the edge includes the last pixel before it.
        let (columns, rows) = ((13..38), (15..48).chain(55..88));
        let (wide, high) = (columns.len() as f64, rows.clone().count() as f64);
        let share = |of: &dyn Fn(usize, usize) -> bool| {
            let open = rows.clone().flat_map(|row| columns.clone().map(move |column| (row, column)));
            open.filter(|(row, column)| of(*row, *column)).count() as f64 / (wide * high)
        };
        // Depths are weighted by coverage. A surface 5 cm too far is wrong, but no hole.
        assert_eq!(drawn(&|i| (0.95 * (depth[i] + 0.05), 0.95)), 0.0);
        let hole = drawn(&|i| if i % side == 20 { (0.0, 0.0) } else { (depth[i], 1.0) });
        assert_eq!(hole, share(&|_, column| column == 20));
        let thin = drawn(&|i| if i % side < 23 { (0.8 * depth[i], 0.8) } else { (depth[i], 1.0) });
        assert_eq!(thin, share(&|_, column| column < 23));
        let behind = drawn(&|i| (if i / side < 20 { 2.2 } else { depth[i] }, 1.0));
        assert_eq!(behind, share(&|row, _| row < 20));
        // Outlines and steps may be wrong by three pixels.
        assert_eq!(drawn(&|i| if i % side < 13 { (0.0, 0.0) } else { (depth[i], 1.0) }), 0.0);
        assert_eq!(drawn(&|i| (if (49..52).contains(&(i / side)) { 2.1 } else { depth[i] }, 1.0)), 0.0);
        let nobody = Truth { points: Vec::new(), views: Vec::new() };
        assert_eq!(nobody.open(&[]), None);
    }
}
