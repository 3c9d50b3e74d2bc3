//! One closed surface from Gaussians. Depths that are rendered from all around are fused into a signed distance field
//! (Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996), of which one body is
//! kept.

mod atlas;
mod grid;
mod manifold;
mod simplify;
mod stray;
mod topology;
mod views;

use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::sync::Arc;

use burn::tensor::Tensor;
use glam::{DVec3, Vec3};
use image::RgbImage;
use rayon::prelude::*;
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Gaussians, SplatError};

use crate::mesh::{Mesh, bytes};
use grid::Grid;
use views::{Mean, View, host};

pub use stray::on_body;

/// Side in pixels of the pictures for distances.
const SIDE: u32 = 640;
/// Side in pixels of the pictures for a texture. Only one of these pictures is in memory at a time.
const TEXTURE_SIDE: u32 = 1600;
/// Truncation of the signed distances, in cubes.
const TRUNCATION: f32 = 4.0;
/// Largest distance between the inner and the outer side of one surface, in cubes.
const THICKNESS: f32 = 2.0;
/// Smallest number of views that see through a point outside. Gaps between the shells of front, back and sides are
/// visible from few directions, the surroundings of a body from many.
const FREE_VIEWS: u8 = 3;
/// Least opacity of the Gaussians that determine the body's box.
const OPAQUE: f32 = 0.1;
/// Share of the Gaussians at either end of each axis that the body's box leaves out, since some lie far from the body.
const FLYING: f32 = 0.002;
/// Space around the body's box, as a share of its longest side. The Gaussians that were left out may belong to a hand.
const MARGIN: f32 = 0.06;
/// Extent of a Gaussian around its centre, in standard deviations.
const SEEN: f32 = 2.0;
/// Number of smoothing passes, against steps between views and the graininess of Gaussians.
const SMOOTHED: usize = 2;
/// Seconds on two cores that a scene may take without [`Options::force`]. A person takes half as long.
const LONG: u32 = 20;
/// Pairs of a splat and a tile in one view, and triangles before the reduction, that take about [`LONG`] seconds.
const MAX_INTERSECTIONS: u64 = 20_000_000;
const MAX_TRIANGLES: usize = 3_000_000;
/// Fewest Gaussians of a body.
const FEWEST: usize = 50;
/// Smallest size of the box of the centres, as a share of the box of the Gaussians. Depth maps show the centres of
/// Gaussians, so that a few large Gaussians have no surface.
const RESOLVED: f32 = 0.5;
/// Accepted lengths of a body, metres, and its largest distance from the world's origin in lengths of its box. Beyond
/// this distance, positions in f32 are too coarse for the cubes.
const LENGTHS: RangeInclusive<f32> = 1e-3..=1e3;
const FAR: f32 = 1000.0;

/// Errors of [`fuse`].
#[derive(Debug, thiserror::Error)]
pub enum FuseError {
    /// Too few visible Gaussians.
    #[error("no surface: fewer than {0} Gaussians are finite and opaque")]
    Nothing(usize),
    /// Gaussians without a body.
    #[error("no surface: the Gaussians enclose no solid body")]
    Hollow,
    /// Too few Gaussians for the size of the body, or too large ones.
    #[error("no surface: the Gaussians are too large beside the distances between their centres")]
    Coarse,
    /// A body that is far from a person's size or place: longest side of its box, and the box's distance from the
    /// origin, metres.
    #[error("no surface: a body of {length:.1e} m, {distance:.1e} m from the origin: scale or move it")]
    #[allow(missing_docs, reason = "the names say it")]
    Foreign { length: f32, distance: f32 },
    /// Too much work.
    #[error("{0}: this would take longer than {LONG} s on a few cores")]
    Long(String),
    /// A texture that is too small.
    #[error("{0}: choose a larger one, or fewer triangles")]
    Texture(String),
    /// A surface that cannot be reduced.
    #[error("the surface cannot be reduced: {0}")]
    Reduce(#[from] meshoptimizer_rs::Error),
    /// An error of the rasteriser.
    #[error(transparent)]
    Splat(#[from] SplatError),
}

/// Options of [`fuse`].
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Approximate number of triangles of the reduced surface; 0 keeps all.
    pub faces: usize,
    /// Side of a texture in pixels; 0 for colours of positions instead.
    pub texture: usize,
    /// Whether scenes are accepted that take far longer than a person.
    pub force: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { faces: 100_000, texture: 0, force: false }
    }
}

/// A surface, and statistics of its fusion.
#[derive(Debug, Clone)]
pub struct Fused {
    /// One closed piece in the Gaussians' world, with a texture or a colour at each position.
    pub mesh: Mesh,
    /// Parts apart from the body that were joined with it.
    pub joined: usize,
    /// Pieces beside the body that were dropped.
    pub dropped: usize,
    /// Volume of the largest dropped piece, as a share of the body's volume.
    pub largest_dropped: f64,
    /// Triangles before the reduction.
    pub faces: usize,
}

/// Makes a mesh of Gaussians. `stage` receives the name of each step.
///
/// # Errors
/// [`FuseError`].
pub fn fuse(scene: &Loaded, options: Options, stage: &dyn Fn(&str)) -> Result<Fused, FuseError> {
    let (centre, size) = body(&scene.gaussians)?;
    // The surface is computed around the origin, where f32 is finest.
    let mut scene = scene.clone();
    let means = scene.gaussians.means.clone();
    let origin = Tensor::<1>::from_floats(centre.to_array(), &means.device());
    scene.gaussians.means = means - origin.unsqueeze::<2>();
    let mut grid = Grid::around(size, TRUNCATION + 2.0);
    let Grid { cell, counts, .. } = grid;

    stage("views from all around");
    let radius = f64::from(0.5 * size.length());
    let cameras = views::cameras(&views::RINGS, radius, SIDE).into_iter();
    let most = if options.force { u64::MAX } else { MAX_INTERSECTIONS };
    let views: Result<Vec<View>, SplatError> =
        cameras.map(|camera| View::new(&scene, camera, radius, most)).collect();
    let mut views = views.map_err(|e| match e {
        SplatError::TooManyIntersections { found, limit } if limit == most => {
            let millions = found / 1_000_000;
            FuseError::Long(format!("a view of it has {millions} million pairs of a splat and a tile"))
        }
        e => e.into(),
    })?;

    views::distrust_inner_sides(&mut views, THICKNESS * cell);

    stage("distance field");
    let line = |row: usize| distances(&grid, &Vec::from_iter(row * counts.x..(row + 1) * counts.x), &views);
    grid.values = (0..counts.y * counts.z).into_par_iter().flat_map_iter(line).collect();
    (0..SMOOTHED).for_each(|_| grid.smooth());
    // A surface has about twice as many triangles as positions.
    let faces = 2 * grid.crossings();
    if faces > MAX_TRIANGLES && !options.force {
        let millions = faces as f64 / 1e6;
        return Err(FuseError::Long(format!(
            "its surface has some {millions:.1} million triangles, far more than a person's"
        )));
    }
    let joined = grid.join_parts();
    grid.close_tunnels();
    let (dropped, largest_dropped) = grid.keep_one_body();

    stage("surface");
    let (positions, triangles) = grid.surface();
    drop(grid);
    if triangles.is_empty() {
        return Err(FuseError::Hollow);
    }
    let faces = triangles.len();
    let mut mesh = Mesh::colored(positions, Vec::new(), triangles);
    stage("colours");
    mesh.colors = views::colors(&mesh, &views, cell);
    stage("reducing");
    let mut mesh = simplify::simplify(mesh, options.faces)?;
    if options.texture > 0 {
        drop(views);
        stage("texture");
        textured(&mut mesh, &scene, radius, options.texture, cell)?;
    }
    mesh.positions.iter_mut().for_each(|place| *place += centre);
    Ok(Fused { mesh, joined, dropped, largest_dropped, faces })
}

/// Replaces the vertex colours by a texture. Texels that no view shows get the interpolated vertex colour. The body
/// lies in the ball of this radius around the origin.
fn textured(mesh: &mut Mesh, scene: &Loaded, radius: f64, side: usize, cell: f32) -> Result<(), FuseError> {
    let atlas = atlas::atlas(mesh, side).map_err(FuseError::Texture)?;
    let mut means = vec![Mean::default(); atlas.texels.len()];
    for camera in views::cameras(&views::RINGS, radius, TEXTURE_SIDE) {
        let view = View::new(scene, camera, radius, u64::MAX)?;
        means.par_iter_mut().zip(&atlas.texels).for_each(|(mean, texel)| {
            mean.add(&view, texel.place, texel.normal, views::REACH * cell);
        });
    }
    let mut texture = vec![None; side * side];
    for (mean, texel) in means.iter().zip(&atlas.texels) {
        texture[texel.at as usize] = Some(bytes(mean.color().unwrap_or(texel.color)));
    }
    atlas::spread(&mut texture, side);
    // Filters do not reach the remaining texels.
    let background = bytes(mesh.colors.iter().sum::<Vec3>() / mesh.colors.len().max(1) as f32);
    let texture = texture.into_iter().flat_map(|color| color.unwrap_or(background)).collect();
    let texture = RgbImage::from_raw(side as u32, side as u32, texture).expect("three bytes for each texel");
    mesh.colors.clear();
    mesh.materials[0].texture = Some(Arc::new(texture));
    // Faces of one chart share the coordinates of their corners.
    let mut rows = HashMap::new();
    for (face, texcoords) in mesh.faces.iter_mut().zip(atlas.texcoords) {
        face.texcoords = Some([0, 1, 2].map(|corner| {
            let key = (face.positions[corner], texcoords[corner].to_array().map(f32::to_bits));
            *rows.entry(key).or_insert_with(|| {
                mesh.texcoords.push(texcoords[corner]);
                mesh.texcoords.len() as u32 - 1
            })
        }));
    }
    Ok(())
}

/// Weighted mean of a point's distances in the views.
#[derive(Default, Clone, Copy)]
struct Distance {
    sum: f32,
    weight: f32,
    /// Number of views that see through the point.
    free: u8,
}

impl Distance {
    /// Adds the distance and cosine of [`View::surface`].
    fn add(&mut self, (distance, facing): (f32, f32), reach: f32) {
        // A view shows nothing behind a surface.
        if distance < -reach {
            return;
        }
        // Converts the distance along the ray to the distance along the normal.
        let apart = (distance * facing).min(reach);
        self.sum += facing * apart;
        self.weight += facing;
        self.free = self.free.saturating_add(u8::from(apart >= reach));
    }

    /// Truncated signed distance from the surface. A gap between the shells counts as inside.
    fn finish(self, reach: f32) -> f32 {
        let mean = if self.weight > 0.0 { self.sum / self.weight } else { -reach };
        // Close to a surface, the distance decides.
        let is_gap = mean >= 0.99 * reach && self.free < FREE_VIEWS;
        if is_gap { -reach } else { mean }
    }
}

/// Distances of some corners, which should be neighbours: view by view they are neighbours in a picture, too, and in the
/// cache.
fn distances(grid: &Grid, corners: &[usize], views: &[View]) -> Vec<f32> {
    let reach = TRUNCATION * grid.cell;
    let mut found: Vec<_> = corners.iter().map(|row| (grid.place(*row), Distance::default())).collect();
    for view in views {
        for (place, distance) in &mut found {
            if let Some(surface) = view.surface(*place) {
                distance.add(surface, reach);
            }
        }
    }
    found.into_iter().map(|(_, distance)| distance.finish(reach)).collect()
}

/// Centre and size of the box of the body's Gaussians, metres.
///
/// # Errors
/// [`FuseError::Nothing`], [`FuseError::Coarse`] and [`FuseError::Foreign`].
pub fn body(gaussians: &Gaussians) -> Result<(Vec3, Vec3), FuseError> {
    let opacities = host(gaussians.opacities.clone());
    let (means, scales) = (host(gaussians.means.clone()), host(gaussians.scales.clone()));
    let rows = means.as_chunks::<3>().0.iter().zip(scales.as_chunks::<3>().0);
    // Centre and extent.
    let rows = rows.map(|(p, s)| (Vec3::from_array(*p), SEEN * Vec3::from_array(*s).max_element()));
    let solid = |((p, reach), opacity): &((Vec3, f32), &f32)| {
        p.is_finite() && reach.is_finite() && **opacity >= OPAQUE
    };
    let there: Vec<(Vec3, f32)> = rows.zip(&opacities).filter(solid).map(|(row, _)| row).collect();
    if there.len() < FEWEST {
        return Err(FuseError::Nothing(FEWEST));
    }
    let end = |place: &dyn Fn(&(Vec3, f32)) -> f32| f64::from(upper_end(there.iter().map(place)));
    let (mut low, mut high, mut centres) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
    for axis in 0..3 {
        low[axis] = -end(&|(p, reach)| reach - p[axis]);
        high[axis] = end(&|(p, reach)| p[axis] + reach);
        centres[axis] = end(&|(p, _)| p[axis]) + end(&|(p, _)| -p[axis]);
    }
    let size = (high - low).max_element();
    if centres.max_element() < f64::from(RESOLVED) * size {
        return Err(FuseError::Coarse);
    }
    let margin = f64::from(MARGIN) * size;
    let (low, high) = (low - margin, high + margin);
    let (centre, size) = ((0.5 * (low + high)).as_vec3(), (high - low).as_vec3());
    let (length, distance) = (size.max_element(), centre.length());
    if LENGTHS.contains(&length) && distance <= FAR * length {
        Ok((centre, size))
    } else {
        Err(FuseError::Foreign { length, distance })
    }
}

/// The largest value but for [`FLYING`] of all. There is one at least.
fn upper_end(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<f32> = values.collect();
    let skipped = values.len() - 1 - (FLYING * values.len() as f32) as usize;
    *values.select_nth_unstable_by(skipped, f32::total_cmp).1
}
