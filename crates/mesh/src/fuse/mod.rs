//! One closed surface out of Gaussians: depths rendered from all around are fused into a signed distance field (Curless and
//! Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996), of which one body is kept.

mod atlas;
mod color;
mod grid;
mod join;
mod manifold;
mod simplify;
mod views;

use std::collections::HashMap;
use std::sync::Arc;

use burn::tensor::{Tensor, TensorData};
use glam::{DVec3, USizeVec3, Vec3};
use image::RgbImage;
use rayon::prelude::*;
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Gaussians, SplatError};

use crate::mesh::Mesh;
use color::Mean;
use grid::Grid;
use views::{Seen, View};

/// Cubes along the longest side of the body's box and its margins.
const CUBES: f32 = 320.0;
/// Side of the pictures that distances are taken from, pixels.
const SIDE: u32 = 640;
/// Side of those that a texture is taken from: a picture at a time is kept.
const TEXTURE_SIDE: u32 = 1600;
/// Distances are kept up to so many cubes from the surface.
const TRUNCATION: f32 = 4.0;
/// A place that fewer views see through counts as inside: gaps between the shells of front, back and sides are seen through from
/// few directions, whatever lies around a body from many.
const FREE_VIEWS: u8 = 3;
/// Gaussians less opaque than this do not say where the body is.
const OPAQUE: f32 = 0.1;
/// This share of the Gaussians, at either end of each axis, does not say where the body is: some may fly about.
const FLYING: f32 = 0.002;
/// Standard deviations around a Gaussian's centre at which it is no surface any more.
const SEEN: f32 = 2.0;
/// Times that neighbouring distances are averaged: steps between views, and the grain of Gaussians.
const SMOOTHED: usize = 2;

/// What a mesh is made of.
#[derive(Debug, thiserror::Error)]
pub enum FuseError {
    /// Nothing that could be seen.
    #[error("no surface: fewer than {0} Gaussians are finite and opaque")]
    Nothing(usize),
    /// Gaussians in which no body was found.
    #[error("no surface: nothing that the Gaussians show is solid from any side")]
    Hollow,
    /// A texture that is too small.
    #[error("{0}: choose a larger one, or fewer triangles")]
    Texture(String),
    /// A surface that cannot be reduced.
    #[error("the surface cannot be reduced: {0}")]
    Reduce(#[from] meshoptimizer_rs::Error),
    /// The rasteriser's refusal.
    #[error(transparent)]
    Splat(#[from] SplatError),
}

/// Wishes.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Triangles to reduce the surface to, about; 0 keeps all.
    pub faces: usize,
    /// Side of a texture in pixels; 0: positions have colours instead.
    pub texture: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self { faces: 100_000, texture: 0 }
    }
}

/// A surface and how it came about.
#[derive(Debug, Clone)]
pub struct Fused {
    /// Closed, one piece, with a colour at each position; world metres, as the Gaussians were.
    pub mesh: Mesh,
    /// Places between the shells that too few views see through, in connected pieces.
    pub closed: usize,
    /// Hollows inside that were filled.
    pub filled: usize,
    /// Parts that lay apart from the body and were joined with it.
    pub joined: usize,
    /// Pieces beside the body that were dropped.
    pub dropped: usize,
    /// Triangles before they were reduced.
    pub faces: usize,
    /// Edge of the field's cubes, metres.
    pub cell: f32,
}

/// Fewest Gaussians that are taken for a body.
const FEWEST: usize = 50;

/// Makes a mesh of Gaussians. `stage` hears what is being done.
///
/// # Errors
/// [`FuseError`].
pub fn fuse(scene: &Loaded, options: Options, stage: &dyn Fn(&str)) -> Result<Fused, FuseError> {
    let (low, high) = bounds(&scene.gaussians)?;
    // Around the origin f32 is finest: people in the coordinates of a survey lie far from it.
    let away = (0.5 * low + 0.5 * high).round();
    let mut fused = fuse_here(&moved(scene, -away), (low - away, high - away), options, stage)?;
    fused.mesh.positions.iter_mut().for_each(|place| *place += away);
    Ok(fused)
}

/// The same somewhere else.
fn moved(scene: &Loaded, by: Vec3) -> Loaded {
    let mut moved = scene.clone();
    let means = &mut moved.gaussians.means;
    let by = Tensor::<1>::from_floats(by.to_array(), &means.device()).unsqueeze::<2>();
    *means = means.clone() + by;
    moved
}

fn fuse_here(
    scene: &Loaded,
    (low, high): (Vec3, Vec3),
    options: Options,
    stage: &dyn Fn(&str),
) -> Result<Fused, FuseError> {
    let size = high - low;
    let cell = size.max_element() / CUBES;
    // The border stays outside.
    let margin = cell * (TRUNCATION + 2.0);
    let counts = ((size + 2.0 * margin) / cell).ceil();
    let counts = USizeVec3::new(counts.x as usize + 1, counts.y as usize + 1, counts.z as usize + 1);

    stage("views from all around");
    let (centre, radius) = ((0.5 * (low + high)).as_dvec3(), f64::from(0.5 * size.length()));
    let cameras = views::cameras(centre, radius, SIDE).into_iter();
    let views: Result<Vec<View>, SplatError> =
        cameras.map(|camera| View::new(scene, camera, radius)).collect();
    let views = views?;

    stage("distance field");
    let mut grid = Grid { origin: low - margin, cell, counts, values: Vec::new() };
    // Along a row, view by view: neighbours lie beside one another in a picture, and a cache, too.
    let rows = (0..counts.y * counts.z).into_par_iter();
    let (values, closed): (Vec<f32>, Vec<bool>) =
        rows.flat_map_iter(|row| distances(&grid, row * counts.x, &views)).unzip();
    grid.values = closed.iter().map(|closed| if *closed { -1.0 } else { 1.0 }).collect();
    let closed = grid.bodies();
    grid.values = values;
    (0..SMOOTHED).for_each(|_| grid.smooth());
    let joined = grid.join_parts();
    let (dropped, filled) = grid.keep_one_body();

    stage("surface");
    let (positions, triangles) = grid.surface();
    let cell = grid.cell;
    drop(grid);
    if triangles.is_empty() {
        return Err(FuseError::Hollow);
    }
    let faces = triangles.len();
    let mut mesh = Mesh::colored(positions, Vec::new(), triangles);
    stage("colours");
    mesh.colors = color::colors(&mesh, &views, cell);
    stage("reducing");
    let mut mesh = simplify::simplify(mesh, options.faces)?;
    if options.texture > 0 {
        drop(views);
        stage("texture");
        textured(&mut mesh, scene, (centre, radius), options.texture, cell)?;
    }
    Ok(Fused { mesh, closed, filled, joined, dropped, faces, cell })
}

/// Gives a mesh a texture instead of its positions' colours, which stay where no view shows a place. The ball is that of the body,
/// its centre and radius.
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
        let view = View::new(scene, camera, radius)?;
        let hear = |(mean, texel): (&mut Mean, &atlas::Texel)| {
            mean.hear(&view, texel.place, texel.normal, color::REACH * cell);
        };
        means.par_iter_mut().zip(&atlas.texels).for_each(hear);
    }
    let mut texture = vec![None; side * side];
    let bytes = |color: Vec3| color.to_array().map(|c| (255.0 * c).round() as u8);
    for (mean, texel) in means.iter().zip(&atlas.texels) {
        texture[texel.at as usize] = Some(bytes(mean.color().unwrap_or(texel.color)));
    }
    atlas::spread(&mut texture, side);
    // Beyond what filters reach.
    let background = bytes(mesh.colors.iter().sum::<Vec3>() / mesh.colors.len().max(1) as f32);
    let texture = texture.into_iter().flat_map(|color| color.unwrap_or(background)).collect();
    let texture = RgbImage::from_raw(side as u32, side as u32, texture).expect("three bytes for each texel");
    mesh.colors.clear();
    mesh.materials[0].texture = Some(Arc::new(texture));
    // Faces of one piece share their corners' coordinates.
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

/// What views say of a place.
#[derive(Default, Clone, Copy)]
struct Heard {
    sum: f32,
    weight: f32,
    free: u8,
}

impl Heard {
    fn hear(&mut self, seen: Seen, reach: f32) {
        match seen {
            Seen::Unknown => {}
            Seen::Free => {
                self.sum += reach;
                self.weight += 1.0;
                self.free = self.free.saturating_add(1);
            }
            // Behind the surface nothing is known.
            Seen::Surface { distance, .. } if distance < -reach => {}
            Seen::Surface { distance, facing } => {
                // Along the ray to along the normal.
                let apart = (distance * facing).min(reach);
                self.sum += facing * apart;
                self.weight += facing;
                self.free = self.free.saturating_add(u8::from(apart >= reach));
            }
        }
    }

    /// Signed distance from the surface, truncated: the mean of what the views say that meet it squarely enough. And whether the
    /// place counts as inside though a few views see through it.
    fn distance(self, reach: f32) -> (f32, bool) {
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
    let mut heard = vec![Heard::default(); grid.counts.x];
    for view in views {
        for (x, heard) in heard.iter_mut().enumerate() {
            let place = Vec3 { x: start.x + grid.cell * x as f32, ..start };
            heard.hear(view.see(place), reach);
        }
    }
    heard.into_iter().map(move |heard| heard.distance(reach))
}

/// The box of the Gaussians that make the body.
fn bounds(gaussians: &Gaussians) -> Result<(Vec3, Vec3), FuseError> {
    let host = |data: TensorData| -> Vec<f32> {
        data.convert::<f32>().try_into_vec().expect("converted to f32 on this very line")
    };
    let opacities = host(gaussians.opacities.to_data());
    let (means, scales) = (host(gaussians.means.to_data()), host(gaussians.scales.to_data()));
    let rows = means.as_chunks::<3>().0.iter().zip(scales.as_chunks::<3>().0);
    // A place, and how far around it something is seen.
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
    // What was skipped at either end may be a hand.
    let margin = 0.06 * (high - low).max_element().max(1e-3);
    Ok((low - margin, high + margin))
}
