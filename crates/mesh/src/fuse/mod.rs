//! One closed surface from Gaussians. Depths that are rendered from all around are fused into a signed distance field
//! (Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996), of which one body is
//! kept.

mod atlas;
mod color;
mod grid;
mod join;
mod manifold;
mod simplify;
mod tunnels;
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
use grid::{Grid, Kept};
use views::{View, host};

/// Cubes along the longest side of the body's box, unless the field would have more corners than [`MAX_CORNERS`].
const CUBES: f32 = 320.0;
/// Most corners of the field. A person with level arms has eight million; a cube-shaped scene gets larger cubes.
const MAX_CORNERS: f32 = 12e6;
/// Side in pixels of the pictures for distances.
const SIDE: u32 = 640;
/// Side in pixels of the pictures for a texture, of which one at a time is in memory.
const TEXTURE_SIDE: u32 = 1600;
/// Largest distance from the surface that the field contains, in cubes.
const TRUNCATION: f32 = 4.0;
/// Largest distance between the inner and the outer side of one surface, in cubes.
const THICKNESS: f32 = 2.0;
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
const MAX_TRIANGLES: usize = 3_000_000;
/// Fewest Gaussians of a body.
const FEWEST: usize = 50;
/// Least size of the box of the centres, as a share of the box of the Gaussians. Pictures of depth show the centres of Gaussians, so
/// that a few large ones have no surface.
const RESOLVED: f32 = 0.5;
/// Distance of a body from the origin, in lengths of its box, beyond which its positions are measured from its middle: in f32 they would
/// fall together.
const FAR: f64 = 100.0;

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
    /// One closed piece, with a texture or a colour at each position; metres, measured from `offset`.
    pub mesh: Mesh,
    /// Place of the mesh's origin in the Gaussians' world, metres. Zero unless the body is far from the world's origin.
    pub offset: DVec3,
    /// Connected gaps between the shells that were closed because too few views pass through them.
    pub closed: usize,
    /// Hollows inside that were filled.
    pub filled: usize,
    /// Walls across narrow tunnels through the body.
    pub walls: usize,
    /// Handles of the surface before the reduction, such as the ring of an arm whose hand is on the hip.
    pub handles: usize,
    /// Parts apart from the body that were joined with it.
    pub joined: usize,
    /// Pieces beside the body that were dropped.
    pub dropped: usize,
    /// Volume of the largest dropped piece, as a share of the body's.
    pub largest_dropped: f64,
    /// Triangles before the reduction.
    pub faces: usize,
    /// Edge of the field's cubes, metres.
    pub cell: f32,
}

impl Fused {
    /// The mesh in the Gaussians' world, rounded to f32.
    pub fn into_world(self) -> Mesh {
        let Self { mut mesh, offset, .. } = self;
        mesh.positions.iter_mut().for_each(|place| *place = (place.as_dvec3() + offset).as_vec3());
        mesh
    }
}

/// Makes a mesh of Gaussians. `stage` receives the name of each step.
///
/// # Errors
/// [`FuseError`].
pub fn fuse(scene: &Loaded, options: Options, stage: &dyn Fn(&str)) -> Result<Fused, FuseError> {
    let body = Placing::of(&scene.gaussians)?;
    let scene = body.scene(scene);
    let size = body.size;
    let roomy = (size.element_product() / MAX_CORNERS).cbrt();
    let cell = (size.max_element() / CUBES).max(roomy);
    // The border stays outside.
    let margin = cell * (TRUNCATION + 2.0);
    let counts = ((size + 2.0 * margin) / cell).ceil().as_usizevec3() + 1;

    stage("views from all around");
    let radius = f64::from(0.5 * size.length());
    let cameras = views::cameras(radius, SIDE).into_iter();
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
    let mut grid = Grid { origin: -0.5 * size - margin, cell, counts, values: Vec::new() };
    let rows = (0..counts.y * counts.z).into_par_iter();
    let (values, gaps): (Vec<f32>, Vec<bool>) =
        rows.flat_map_iter(|row| distances(&grid, row * counts.x, &views)).unzip();
    grid.values = gaps.iter().map(|gap| if *gap { -1.0 } else { 1.0 }).collect();
    let closed = grid.pieces().bodies();
    grid.values = values;
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
    let walls = grid.close_tunnels();
    let Kept { dropped, filled, largest_dropped } = grid.keep_one_body();

    stage("surface");
    let (positions, triangles) = grid.surface();
    drop(grid);
    if triangles.is_empty() {
        return Err(FuseError::Hollow);
    }
    let faces = triangles.len();
    // Euler's formula for a closed surface of one piece.
    let handles = (faces / 2 + 2).saturating_sub(positions.len()) / 2;
    let mut mesh = Mesh::colored(positions, Vec::new(), triangles);
    stage("colours");
    mesh.colors = color::colors(&mesh, &views, cell);
    stage("reducing");
    let mut mesh = simplify::simplify(mesh, options.faces)?;
    if options.texture > 0 {
        drop(views);
        stage("texture");
        textured(&mut mesh, &scene, radius, options.texture, cell)?;
    }
    let offset = body.offset();
    mesh.positions.iter_mut().for_each(|place| *place = (body.world(*place) - offset).as_vec3());
    let cell = (f64::from(cell) / body.scale) as f32;
    Ok(Fused { mesh, offset, closed, filled, walls, handles, joined, dropped, largest_dropped, faces, cell })
}

/// Place and size of a body. The surface is made around the origin, of a body one to two units long: f32 is finest there, and neither a
/// figure of a micrometre nor one in the coordinates of a survey is lost.
struct Placing {
    /// Middle of the body's box, world metres.
    centre: DVec3,
    /// Units per metre, a power of two.
    scale: f64,
    /// Sides of the box, units.
    size: Vec3,
}

impl Placing {
    fn of(gaussians: &Gaussians) -> Result<Self, FuseError> {
        let (low, high) = bounds(gaussians)?;
        let size = high - low;
        if !(size.max_element() > 0.0 && size.is_finite()) {
            return Err(FuseError::Hollow);
        }
        // The powers of two in both directions that f32 contains.
        let scale = (-size.max_element().log2().floor()).clamp(-126.0, 126.0).exp2();
        // Exact in f32, as the means are.
        let centre = (0.5 * (low + high)).as_vec3().as_dvec3();
        Ok(Self { centre, scale, size: (size * scale).as_vec3() })
    }

    /// The Gaussians in units around the origin.
    fn scene(&self, scene: &Loaded) -> Loaded {
        let Gaussians { means, scales, .. } = scene.gaussians.clone();
        let centre = Tensor::<1>::from_floats(self.centre.as_vec3().to_array(), &means.device());
        let means = (means - centre.unsqueeze::<2>()).mul_scalar(self.scale);
        let scales = scales.mul_scalar(self.scale);
        let mut scene = scene.clone();
        scene.gaussians = Gaussians { means, scales, ..scene.gaussians };
        scene
    }

    /// A place in the Gaussians' world, metres.
    fn world(&self, place: Vec3) -> DVec3 {
        place.as_dvec3() / self.scale + self.centre
    }

    /// The origin of the finished mesh in the Gaussians' world.
    fn offset(&self) -> DVec3 {
        let length = f64::from(self.size.max_element()) / self.scale;
        if self.centre.length() > FAR * length { self.centre } else { DVec3::ZERO }
    }
}

/// Replaces the colours of a mesh's positions by a texture, in which they remain at places that no view shows. The body is in
/// the ball of this radius around the origin.
fn textured(mesh: &mut Mesh, scene: &Loaded, radius: f64, side: usize, cell: f32) -> Result<(), FuseError> {
    let atlas = atlas::atlas(mesh, side).map_err(FuseError::Texture)?;
    let mut means = vec![Mean::default(); atlas.texels.len()];
    for camera in views::cameras(radius, TEXTURE_SIDE) {
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

/// The box of the body's Gaussians, world metres.
fn bounds(gaussians: &Gaussians) -> Result<(DVec3, DVec3), FuseError> {
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
    let mut along = vec![0.0; there.len()];
    let skipped = along.len() - 1 - (FLYING * along.len() as f32) as usize;
    let mut end = |place: &dyn Fn(&(Vec3, f32)) -> f32| {
        along.iter_mut().zip(&there).for_each(|(along, row)| *along = place(row));
        f64::from(*along.select_nth_unstable_by(skipped, f32::total_cmp).1)
    };
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
    // The Gaussians that were left out may be those of a hand.
    let margin = 0.06 * size;
    Ok((low - margin, high + margin))
}
