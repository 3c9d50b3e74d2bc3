//! Visibility of directions from the surfaces of a mesh, and the light that arrives from visible directions.

use std::collections::HashMap;

use glam::{IVec3, Mat3, Vec3};
use rayon::prelude::*;

use super::light::{PAIRS, SHARE, Surroundings, WAYS, ways};
use crate::mesh::bounds;

/// Number of pairs that are computed before their results are merged, which bounds the memory.
const AT_ONCE: usize = 16;
/// Cells of a depth map along the mesh's largest extent. Vertices in one cell share their visibility.
const CELLS: f32 = 160.0;
/// Offset along the normal, in cells, at which a surface is looked up in the depth map.
const OFF: f32 = 0.6;

/// A bit for each direction.
type Seen = [u64; WAYS / 64];

/// Clusters of nearby vertices that face about the same direction. A cluster is called place.
struct Places {
    /// Index of the place of each vertex.
    rows: Vec<u32>,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    faces: Vec<[u32; 3]>,
}

impl Places {
    fn new(positions: &[Vec3], normals: &[Vec3], faces: &[[u32; 3]], cell: f32) -> Self {
        let mut found: HashMap<(IVec3, u8), u32> = HashMap::new();
        let mut places =
            Self { rows: Vec::new(), positions: Vec::new(), normals: Vec::new(), faces: Vec::new() };
        let mut counts = Vec::new();
        for (p, n) in positions.iter().zip(normals) {
            let size = n.abs();
            let axis = (0..3).max_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(0);
            let facing = 2 * axis as u8 + u8::from(n[axis] < 0.0);
            let row = *found.entry(((*p / cell).floor().as_ivec3(), facing)).or_insert_with(|| {
                places.positions.push(Vec3::ZERO);
                places.normals.push(Vec3::ZERO);
                counts.push(0.0);
                counts.len() as u32 - 1
            });
            places.rows.push(row);
            places.positions[row as usize] += *p;
            places.normals[row as usize] += *n;
            counts[row as usize] += 1.0;
        }
        places.positions.iter_mut().zip(counts).for_each(|(p, count)| *p /= count);
        places.normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
        let rows = faces.iter().map(|face| face.map(|row| places.rows[row as usize]));
        places.faces = rows.filter(|[a, b, c]| a != b && b != c && c != a).collect();
        places
    }
}

/// Directions that are visible from the surfaces of a mesh.
pub struct Occlusion {
    ways: Vec<Vec3>,
    places: Places,
    /// By place. A direction in front of the surface is seen from its front, a direction behind it from its back.
    seen: Vec<Seen>,
}

impl Occlusion {
    /// Renders a depth map of the nearest and the farthest surface along each pair of directions.
    pub fn new(positions: &[Vec3], normals: &[Vec3], faces: &[[u32; 3]]) -> Self {
        let (low, high) = bounds(positions.iter().copied());
        let middle = 0.5 * (low + high);
        let cell = ((high - low).max_element() / CELLS).max(f32::MIN_POSITIVE);
        let places = Places::new(positions, normals, faces, cell);
        let ways = ways();
        let mut seen: Vec<Seen> = vec![Seen::default(); places.positions.len()];
        for (chunk, some) in ways[..PAIRS].chunks(AT_ONCE).enumerate() {
            let look = |way: &Vec3| -> Vec<[bool; 2]> {
                let map = DepthMap::new(*way, middle, (high - low).length(), cell, &places);
                let sees = |(p, n): (&Vec3, &Vec3)| map.sees(*p, *n);
                places.positions.iter().zip(&places.normals).map(sees).collect()
            };
            let pairs: Vec<Vec<[bool; 2]>> = some.par_iter().map(look).collect();
            seen.par_iter_mut().enumerate().for_each(|(row, bits)| {
                for (pair, both) in (chunk * AT_ONCE..).zip(&pairs) {
                    for (way, seen) in [pair, pair + PAIRS].into_iter().zip(both[row]) {
                        bits[way / 64] |= u64::from(seen) << (way % 64);
                    }
                }
            });
        }
        Self { ways, places, seen }
    }

    /// Linear light that each vertex reflects on its front and on its back.
    pub fn light(&self, surroundings: &Surroundings, normals: &[Vec3]) -> Vec<[Vec3; 2]> {
        let light: Vec<Vec3> = self.ways.iter().map(|way| surroundings.from(*way) * SHARE).collect();
        // By colour channel: the sum of the visible directions times their light. Its product with a normal is the
        // reflected light. The normals of a place's vertices differ a little.
        let arriving = |(seen, normal): (&Seen, &Vec3)| {
            let mut sides = [Mat3::ZERO; 2];
            for (word, bits) in seen.iter().enumerate() {
                let mut bits = *bits;
                while bits != 0 {
                    let way = 64 * word + bits.trailing_zeros() as usize;
                    bits &= bits - 1;
                    let (way, light) = (self.ways[way], light[way]);
                    let side = &mut sides[usize::from(normal.dot(way) < 0.0)];
                    *side += Mat3::from_cols(way * light.x, way * light.y, way * light.z);
                }
            }
            sides
        };
        let arriving: Vec<[Mat3; 2]> = self.seen.par_iter().zip(&self.places.normals).map(arriving).collect();
        let vertex = |(row, normal): (&u32, &Vec3)| {
            let [front, back] = arriving[*row as usize];
            [front.transpose() * *normal, back.transpose() * -*normal].map(|light| light.max(Vec3::ZERO))
        };
        self.places.rows.par_iter().zip(normals).map(vertex).collect()
    }
}

/// Nearest and farthest surface along a direction, on a grid perpendicular to it.
struct DepthMap {
    /// Right and up across the direction, and the direction itself.
    axes: [Vec3; 3],
    middle: Vec3,
    cell: f32,
    side: usize,
    /// Smallest and largest coordinate along the direction.
    depths: Vec<[f32; 2]>,
}

impl DepthMap {
    fn new(way: Vec3, middle: Vec3, diagonal: f32, cell: f32, places: &Places) -> Self {
        let right = way.any_orthonormal_vector();
        let side = (diagonal / cell).ceil() as usize + 2;
        let depths = vec![[f32::INFINITY, f32::NEG_INFINITY]; side * side];
        let mut map = Self { axes: [right, way.cross(right), way], middle, cell, side, depths };
        let corners: Vec<Vec3> = places.positions.iter().map(|p| map.place(*p)).collect();
        for face in &places.faces {
            map.add(face.map(|row| corners[row as usize]));
        }
        map
    }

    /// Column, row (integers at the centres of cells) and depth of a point.
    fn place(&self, p: Vec3) -> Vec3 {
        let [x, y, z] = self.axes.map(|axis| axis.dot(p - self.middle));
        let half = self.side as f32 / 2.0 - 0.5;
        Vec3::new(x / self.cell + half, y / self.cell + half, z)
    }

    fn add(&mut self, [a, b, c]: [Vec3; 3]) {
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let last = (self.side - 1) as f32;
        // Casts truncate. Without SSE4.1, floor and ceil are function calls.
        let ceil = |x: f32| x as usize + usize::from((x as usize as f32) < x);
        let columns = ceil(low.x)..high.x.min(last) as usize + 1;
        let rows = ceil(low.y)..high.y.min(last) as usize + 1;
        let normal = (b - a).cross(c - a);
        if columns.is_empty() || rows.is_empty() || normal.z == 0.0 {
            return;
        }
        let edge = |from: Vec3, to: Vec3, x: f32, y: f32| {
            ((to.x - from.x) * (y - from.y) - (to.y - from.y) * (x - from.x)) * normal.z
        };
        for row in rows {
            for column in columns.clone() {
                let (x, y) = (column as f32, row as f32);
                if edge(a, b, x, y) >= 0.0 && edge(b, c, x, y) >= 0.0 && edge(c, a, x, y) >= 0.0 {
                    let z = a.z - (normal.x * (x - a.x) + normal.y * (y - a.y)) / normal.z;
                    let [nearest, farthest] = &mut self.depths[row * self.side + column];
                    (*nearest, *farthest) = (nearest.min(z), farthest.max(z));
                }
            }
        }
    }

    /// Whether the surface at `p` with this normal sees the direction and its opposite, each from the side facing it.
    fn sees(&self, p: Vec3, normal: Vec3) -> [bool; 2] {
        let cosine = self.axes[2].dot(normal);
        // Depth change of the surface within a cell.
        let slope = (1.0 - cosine * cosine).max(0.0).sqrt() / cosine.abs().max(0.2);
        let tolerance = self.cell * (OFF + 0.7 * slope);
        let away = if cosine < 0.0 { -OFF } else { OFF } * self.cell;
        let at = |p: Vec3| {
            let place = self.place(p);
            let (column, row) = (place.x + 0.5, place.y + 0.5);
            let inside = column >= 0.0 && row >= 0.0 && column.max(row) < self.side as f32;
            let depths = inside.then(|| self.depths[row as usize * self.side + column as usize]);
            (place.z, depths.unwrap_or([f32::INFINITY, f32::NEG_INFINITY]))
        };
        let ((z, [_, farthest]), (opposite, [nearest, _])) = (at(p + away * normal), at(p - away * normal));
        [z + tolerance >= farthest, opposite - tolerance <= nearest]
    }
}
