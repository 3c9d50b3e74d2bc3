//! The surface of a body as triangles.

use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::{IVec3, Vec3};
use ndshape::RuntimeShape;
use rayon::prelude::*;
use snapsnap_mesh::mesh::pieces;

use super::body::Body;

/// Samples along the edge of a block. Blocks without surface are not sampled; others are halved recursively.
const BLOCK: usize = 8;
/// Largest factor by which distances may be too large where surfaces lean or are crumpled.
const SLACK: f32 = 1.4;

/// A closed surface; normals point outwards.
#[derive(Debug, Clone)]
pub struct Surface {
    pub positions: Vec<Vec3>,
    pub faces: Vec<[u32; 3]>,
    /// Index of the part of each position.
    pub parts: Vec<u8>,
}

/// Meshes `body` with cells of `cell` metres; positions lie on the surface itself.
pub fn mesh(body: &Body, cell: f32) -> Surface {
    let (low, high) = body.bounds();
    let origin = low - Vec3::splat(2.0 * cell);
    let counts = ((high - origin) / cell).ceil().as_ivec3() + IVec3::splat(3);
    let [nx, ny, nz] = counts.to_array().map(|n| (n as usize).next_multiple_of(BLOCK));
    let mut values = vec![0.0_f32; nx * ny * nz];
    values.par_chunks_mut(nx * ny * BLOCK).enumerate().for_each(|(slab, values)| {
        let mut slab = Slab { body, origin, first: slab * BLOCK, cell, values, row: nx, layer: nx * ny };
        for y in (0..ny).step_by(BLOCK) {
            for x in (0..nx).step_by(BLOCK) {
                slab.fill([x, y, 0], BLOCK);
            }
        }
    });

    let mut buffer = SurfaceNetsBuffer::default();
    let shape = RuntimeShape::<u32, 3>::new([nx as u32, ny as u32, nz as u32]);
    surface_nets(&values, &shape, [0; 3], [nx as u32 - 1, ny as u32 - 1, nz as u32 - 1], &mut buffer);
    drop(values);
    let positions = buffer.positions.iter().map(|p| origin + cell * Vec3::from_array(*p)).collect();
    let faces = buffer.indices.chunks_exact(3).map(|f| [f[0], f[1], f[2]]).collect();
    let (positions, faces) = largest_piece(positions, faces);
    let (positions, parts) = positions.into_par_iter().map(|p| settle(body, p, cell)).unzip();
    Surface { positions, faces, parts }
}

/// Layers of samples of the distance.
struct Slab<'a> {
    body: &'a Body,
    /// Position of the grid's first sample.
    origin: Vec3,
    /// First layer in the grid.
    first: usize,
    cell: f32,
    values: &'a mut [f32],
    /// Samples of a row and of a layer.
    row: usize,
    layer: usize,
}

impl Slab<'_> {
    /// Samples a cube of `edge` samples. Far from the surface all samples get the distance of the cube's centre.
    fn fill(&mut self, start: [usize; 3], edge: usize) {
        let place = |[x, y, z]: [usize; 3]| {
            self.origin + self.cell * Vec3::new(x as f32, y as f32, (self.first + z) as f32)
        };
        let half = (edge - 1) as f32 / 2.0;
        // The neighbours of the outermost samples count, too.
        let reach = SLACK * self.cell * (3.0_f32.sqrt() * half + 1.0);
        let far = self.body.distance(place(start) + Vec3::splat(self.cell * half), reach).0;
        let corner = |step: usize, i: usize| {
            [0, 1, 2].map(|axis| start[axis] + if i >> axis & 1 == 1 { step } else { 0 })
        };
        if far.abs() > reach {
            for z in start[2]..start[2] + edge {
                for y in start[1]..start[1] + edge {
                    let first = z * self.layer + y * self.row + start[0];
                    self.values[first..first + edge].fill(far);
                }
            }
        } else if edge > 2 {
            (0..8).for_each(|i| self.fill(corner(edge / 2, i), edge / 2));
        } else {
            for [x, y, z] in (0..8).map(|i| corner(1, i)) {
                let value = self.body.distance(place([x, y, z]), 2.0 * self.cell).0;
                self.values[z * self.layer + y * self.row + x] = value;
            }
        }
    }
}

/// Moves a vertex onto the surface by two steps along the gradient, within its cell. Also returns the index of its
/// part.
fn settle(body: &Body, start: Vec3, cell: f32) -> (Vec3, u8) {
    let distance = |p: Vec3| body.distance(p, 4.0 * cell).0;
    // Corners of a tetrahedron: four evaluations, where central differences need six.
    let corners = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]].map(Vec3::from);
    let step = 0.15 * cell;
    let sum: Vec3 = corners.iter().map(|corner| *corner * distance(start + step * *corner)).sum();
    let gradient = sum / (4.0 * step);
    let way = gradient / gradient.length_squared().max(0.1);
    let mut p = start;
    for _ in 0..2 {
        let moved = p - way * distance(p);
        p = start + (moved - start).clamp_length_max(0.7 * cell);
    }
    (p, body.owner(p, cell) as u8)
}

/// The connected piece with the most triangles; the others are crumbs of cloth.
fn largest_piece(positions: Vec<Vec3>, faces: Vec<[u32; 3]>) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let pieces = pieces(positions.len(), faces.iter().map(|face| &face[..]));
    let mut faces: Vec<[u32; 3]> =
        faces.into_iter().zip(pieces).filter(|(_, piece)| *piece == 0).map(|(face, _)| face).collect();
    let mut is_kept = vec![false; positions.len()];
    faces.as_flattened().iter().for_each(|row| is_kept[*row as usize] = true);
    let mut rows = vec![u32::MAX; positions.len()];
    let mut kept = Vec::new();
    for (row, position) in positions.into_iter().enumerate().filter(|(row, _)| is_kept[*row]) {
        rows[row] = kept.len() as u32;
        kept.push(position);
    }
    faces.as_flattened_mut().iter_mut().for_each(|row| *row = rows[*row as usize]);
    (kept, faces)
}
