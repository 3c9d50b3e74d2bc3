//! One closed surface from Gaussians. Depths that are rendered from all around are fused into a signed distance field
//! (Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996), of which one body is
//! kept.

mod atlas;
mod color;
mod grid;
mod join;
mod manifold;
mod simplify;
mod views;

use std::collections::HashMap;
use std::sync::Arc;

use burn::tensor::Tensor;
use glam::{DVec3, Vec3};
use image::RgbImage;
use rayon::prelude::*;
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Gaussians, SplatError};

use crate::mesh::Mesh;
use color::Mean;
use grid::Grid;
use views::{View, host};

/// Cubes along the longest side of the body's box without its margins.
const CUBES: f32 = 320.0;
/// Side in pixels of the pictures for distances.
const SIDE: u32 = 640;
/// Side in pixels of the pictures for a texture, of which one at a time is in memory.
const TEXTURE_SIDE: u32 = 1600;
/// Largest distance from the surface that the field contains, in cubes.
const TRUNCATION: f32 = 4.0;
/// Fewest views through a place that is outside. Gaps between the shells of front, back and sides are visible from few
/// directions, the surroundings of a body from many.
const FREE_VIEWS: u8 = 3;
/// Least opacity of the Gaussians that determine the body's box.
const OPAQUE: f32 = 0.1;
/// Share of the Gaussians at either end of each axis that the body's box leaves out, since some lie far from the body.
const FLYING: f32 = 0.002;
/// Extent of a Gaussian around its centre, in standard deviations.
const SEEN: f32 = 2.0;
/// Number of times that neighbouring distances are averaged, against steps between views and the grain of Gaussians.
const SMOOTHED: usize = 2;
/// Seconds on two cores that a scene may take without [`Options::force`]. A person takes half as long.
const LONG: u32 = 20;
/// Pairs of a splat and a tile in one of the views, and triangles before the reduction, that take about that time.
const MAX_INTERSECTIONS: u64 = 20_000_000;
const MAX_TRIANGLES: usize = 4_000_000;
/// Fewest Gaussians of a body.
const FEWEST: usize = 50;

/// Errors of [`fuse`].
#[derive(Debug, thiserror::Error)]
pub enum FuseError {
    /// Too few visible Gaussians.
    #[error("no surface: fewer than {0} Gaussians are finite and opaque")]
    Nothing(usize),
    /// Gaussians without a body.
    #[error("no surface: nothing that the Gaussians show is solid from any side")]
    Hollow,
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

/// A surface and counts of the steps that lead to it.
#[derive(Debug, Clone)]
pub struct Fused {
    /// One closed piece, with a texture or a colour at each position; in the Gaussians' world, metres.
    pub mesh: Mesh,
    /// Connected gaps between the shells that were closed because too few views pass through them.
    pub closed: usize,
    /// Hollows inside that were filled.
    pub filled: usize,
    /// Parts apart from the body that were joined with it.
    pub joined: usize,
    /// Pieces beside the body that were dropped.
    pub dropped: usize,
    /// Triangles before the reduction.
    pub faces: usize,
    /// Edge of the field's cubes, metres.
    pub cell: f32,
}

/// Makes a mesh of Gaussians. `stage` receives the name of each step.
///
/// # Errors
/// [`FuseError`].
pub fn fuse(scene: &Loaded, options: Options, stage: &dyn Fn(&str)) -> Result<Fused, FuseError> {
    let (low, high) = bounds(&scene.gaussians)?;
    // f32 is finest around the origin, from which people in the coordinates of a survey are far away.
    let away = (0.5 * low + 0.5 * high).round();
    let (low, high) = (low - away, high - away);
    let mut scene = scene.clone();
    let means = scene.gaussians.means;
    let by = Tensor::<1>::from_floats((-away).to_array(), &means.device()).unsqueeze::<2>();
    scene.gaussians.means = means + by;

    let size = high - low;
    let cell = size.max_element() / CUBES;
    // The border stays outside.
    let margin = cell * (TRUNCATION + 2.0);
    let counts = ((size + 2.0 * margin) / cell).ceil().as_usizevec3() + 1;

    stage("views from all around");
    let (centre, radius) = ((0.5 * (low + high)).as_dvec3(), f64::from(0.5 * size.length()));
    let cameras = views::cameras(centre, radius, SIDE).into_iter();
    let most = if options.force { u64::MAX } else { MAX_INTERSECTIONS };
    let views: Result<Vec<View>, SplatError> =
        cameras.map(|camera| View::new(&scene, camera, radius, most)).collect();
    let views = views.map_err(|e| match e {
        SplatError::TooManyIntersections { found, limit } if limit == most => {
            let millions = found / 1_000_000;
            FuseError::Long(format!("a view of it has {millions} million pairs of a splat and a tile"))
        }
        e => e.into(),
    })?;

    stage("distance field");
    let mut grid = Grid { origin: low - margin, cell, counts, values: Vec::new() };
    let rows = (0..counts.y * counts.z).into_par_iter();
    let (values, gaps): (Vec<f32>, Vec<bool>) =
        rows.flat_map_iter(|row| distances(&grid, row * counts.x, &views)).unzip();
    grid.values = gaps.iter().map(|gap| if *gap { -1.0 } else { 1.0 }).collect();
    let closed = grid.pieces().bodies();
    grid.values = values;
    (0..SMOOTHED).for_each(|_| grid.smooth());
    let joined = grid.join_parts();
    let (dropped, filled) = grid.keep_one_body();

    stage("surface");
    let (positions, triangles) = grid.surface();
    drop(grid);
    if triangles.is_empty() {
        return Err(FuseError::Hollow);
    }
    let faces = triangles.len();
    if faces > MAX_TRIANGLES && !options.force {
        let millions = faces as f64 / 1e6;
        return Err(FuseError::Long(format!(
            "its surface has {millions:.1} million triangles, far more than a person's"
        )));
    }
    let mut mesh = Mesh::colored(positions, Vec::new(), triangles);
    stage("colours");
    mesh.colors = color::colors(&mesh, &views, cell);
    stage("reducing");
    let mut mesh = simplify::simplify(mesh, options.faces)?;
    if options.texture > 0 {
        drop(views);
        stage("texture");
        textured(&mut mesh, &scene, (centre, radius), options.texture, cell)?;
    }
    mesh.positions.iter_mut().for_each(|place| *place += away);
    Ok(Fused { mesh, closed, filled, joined, dropped, faces, cell })
}

/// Replaces the colours of a mesh's positions by a texture, in which they remain at places that no view shows. The body is in
/// the ball with this centre and radius.
fn textured(
    mesh: &mut Mesh,
    scene: &Loaded,
    (centre, radius): (DVec3, f64),
    side: usize,
    cell: f32,
) -> Result<(), FuseError> {
    let atlas = atlas::atlas(mesh, side).map_err(FuseError::Texture)?;
    let mut means = vec![Mean::default(); atlas.texels.len()];
    for camera in views::cameras(centre, radius, TEXTURE_SIDE) {
        let view = View::new(scene, camera, radius, u64::MAX)?;
        means.par_iter_mut().zip(&atlas.texels).for_each(|(mean, texel)| {
            mean.add(&view, texel.place, texel.normal, color::REACH * cell);
        });
    }
    let mut texture = vec![None; side * side];
    let bytes = |color: Vec3| color.to_array().map(|c| (255.0 * c).round() as u8);
    for (mean, texel) in means.iter().zip(&atlas.texels) {
        texture[texel.at as usize] = Some(bytes(mean.color().unwrap_or(texel.color)));
    }
    atlas::spread(&mut texture, side);
    // Filters do not reach the other texels.
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

/// Weighted mean of the distances of a place in the views.
#[derive(Default, Clone, Copy)]
struct Distance {
    sum: f32,
    weight: f32,
    /// Views through the place.
    free: u8,
}

impl Distance {
    /// Adds the distance and cosine of [`View::surface`].
    fn add(&mut self, (distance, facing): (f32, f32), reach: f32) {
        // The view shows nothing behind the surface.
        if distance < -reach {
            return;
        }
        // From a distance along the ray to one along the normal.
        let apart = (distance * facing).min(reach);
        self.sum += facing * apart;
        self.weight += facing;
        self.free = self.free.saturating_add(u8::from(apart >= reach));
    }

    /// Signed distance from the surface, truncated, and whether the place is a gap between the shells.
    fn finish(self, reach: f32) -> (f32, bool) {
        let mean = if self.weight > 0.0 { self.sum / self.weight } else { -reach };
        // Within reach of a surface its own distance decides.
        let gap = mean >= 0.99 * reach && self.free < FREE_VIEWS;
        (if gap { -reach } else { mean }, gap)
    }
}

/// Distances of the row of corners along x that begins with `first`.
fn distances(grid: &Grid, first: usize, views: &[View]) -> impl Iterator<Item = (f32, bool)> {
    let reach = TRUNCATION * grid.cell;
    let start = grid.place(first);
    let mut distances = vec![Distance::default(); grid.counts.x];
    // View by view: neighbours on a row are neighbours in a picture and in the cache.
    for view in views {
        for (x, distance) in distances.iter_mut().enumerate() {
            let place = Vec3 { x: start.x + grid.cell * x as f32, ..start };
            if let Some(surface) = view.surface(place) {
                distance.add(surface, reach);
            }
        }
    }
    distances.into_iter().map(move |distance| distance.finish(reach))
}

/// The box of the body's Gaussians.
fn bounds(gaussians: &Gaussians) -> Result<(Vec3, Vec3), FuseError> {
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
    let (mut low, mut high) = (Vec3::ZERO, Vec3::ZERO);
    for axis in 0..3 {
        let end = |sign: f32| {
            let mut along: Vec<f32> = there.iter().map(|(p, reach)| sign * p[axis] + reach).collect();
            let skipped = along.len() - 1 - (FLYING * along.len() as f32) as usize;
            sign * *along.select_nth_unstable_by(skipped, f32::total_cmp).1
        };
        (low[axis], high[axis]) = (end(-1.0), end(1.0));
    }
    // The Gaussians that were left out may be those of a hand.
    let margin = 0.06 * (high - low).max_element().max(1e-3);
    Ok((low - margin, high + margin))
}
