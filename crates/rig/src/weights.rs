//! Skin weights: heat that spreads from the bones within the closed body (Baran and Popović, "Automatic Rigging and
//! Animation of 3D Characters", 2007), here in the cells of a grid, so that mesh and Gaussians follow one field. Ways lead
//! through the body: an arm beside the hip is far from it.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

use glam::{IVec3, Vec3};
use rayon::prelude::*;
use snapsnap_mesh::import::Weights;

use crate::body::{Body, Grid, around};

/// Heat that flows from the nearest bone, beside the heat that flows between cells a bone's distance apart.
const HEAT: f32 = 1.0;
/// Rounds of conjugate gradients. Heat spreads by about the distance to the bone, which is some cells.
const ROUNDS: usize = 60;
/// Residual at which a bone's heat is known, relative to the first one.
const ACCURATE: f32 = 1e-3;
/// No cell.
const NONE: u32 = u32::MAX;

/// A bone as a source of heat.
#[derive(Debug, Clone)]
pub struct Source {
    /// Row of the bone in the skeleton.
    pub bone: usize,
    /// Both ends, metres.
    pub ends: [Vec3; 2],
    /// Distance of a limb from its skin in metres, and the bone that cloth beyond it follows.
    pub cloth: Option<(f32, usize)>,
}

/// Skin weights everywhere in and around a body.
#[derive(Debug, Clone)]
pub struct Field {
    grid: Grid,
    /// By cell, x first: row of `weights` of the nearest cell inside.
    rows: Vec<u32>,
    weights: Vec<Weights>,
}

impl Field {
    /// The field of a body. `bones` is the number of bones. `None` if no bone lies in the body.
    pub fn new(body: Body, sources: &[Source], bones: usize) -> Option<Self> {
        let Body { grid, mut inside } = body;
        let cells = grid.counts.as_usizevec3().element_product();
        let mut field = Self { grid, rows: vec![NONE; cells], weights: Vec::new() };
        field.number(&inside);
        let mut nearest = field.nearest(&inside, sources);
        // From cells of their own no way leads to a bone.
        let mut reached = nearest.iter().map(|(_, length)| length.is_finite());
        inside.retain(|_| reached.next().expect("one for each cell"));
        nearest.retain(|(_, length)| length.is_finite());
        if inside.is_empty() {
            return None;
        }
        field.number(&inside);
        field.weights = field.heat(&inside, sources, &nearest, bones);
        field.extend();
        Some(field)
    }

    /// Gives the cells inside their rows, and no other one.
    fn number(&mut self, inside: &[usize]) {
        self.rows.fill(NONE);
        inside.iter().enumerate().for_each(|(row, cell)| self.rows[*cell] = row as u32);
    }

    /// The weights at a place: those of the eight cells around it.
    pub fn at(&self, place: Vec3) -> Weights {
        let last = (self.grid.counts - 2).as_vec3();
        let at = ((place - self.grid.origin) / self.grid.cell).clamp(Vec3::ZERO, last);
        let low = at.as_ivec3().min(self.grid.counts - 2);
        let share = at - low.as_vec3();
        let mut sums: Vec<(u32, f32)> = Vec::with_capacity(16);
        for corner in 0..8 {
            let step = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
            let parts = Vec3::select(step.cmpeq(IVec3::ONE), share, 1.0 - share);
            let weights = &self.weights[self.rows[self.grid.index(low + step)] as usize];
            for (bone, weight) in weights.iter().filter(|(_, weight)| *weight > 0.0) {
                let weight = weight * parts.element_product();
                match sums.iter_mut().find(|(known, _)| known == bone) {
                    Some((_, sum)) => *sum += weight,
                    None => sums.push((*bone, weight)),
                }
            }
        }
        largest(sums)
    }

    /// For every cell inside its nearest source and the length of the way to it through the body, metres.
    fn nearest(&self, inside: &[usize], sources: &[Source]) -> Vec<(usize, f32)> {
        let mut nearest = vec![(0, f32::INFINITY); inside.len()];
        // Distances as bits: those of numbers above 0 have the same order.
        let mut open = BinaryHeap::new();
        for (source, Source { ends: [from, to], .. }) in sources.iter().enumerate() {
            let steps = (from.distance(*to) / (0.5 * self.grid.cell)).ceil().max(1.0) as usize;
            for step in 0..=steps {
                let place = from.lerp(*to, step as f32 / steps as f32);
                let row = self.rows[self.grid.index(self.grid.containing(place))];
                if row != NONE {
                    let centre = self.grid.centre(inside[row as usize]);
                    open.push(Reverse((centre.distance(place).to_bits(), row, source)));
                }
            }
        }
        while let Some(Reverse((bits, row, source))) = open.pop() {
            let length = f32::from_bits(bits);
            if length >= nearest[row as usize].1 {
                continue;
            }
            nearest[row as usize] = (source, length);
            let at = self.grid.place(inside[row as usize]);
            for (step, distance) in around() {
                let next = self.rows[self.grid.index(at + step)];
                let length = length + self.grid.cell * distance;
                if next != NONE && length < nearest[next as usize].1 {
                    open.push(Reverse((length.to_bits(), next, source)));
                }
            }
        }
        nearest
    }

    /// The weights of all cells inside: for every bone the temperatures w of (L + H) w = H p. L is the Laplacian, and p is
    /// 1 where the bone is the nearest one; H falls with the square of its distance.
    fn heat(
        &self,
        inside: &[usize],
        sources: &[Source],
        nearest: &[(usize, f32)],
        bones: usize,
    ) -> Vec<Weights> {
        let steps = [IVec3::X, IVec3::Y, IVec3::Z, IVec3::NEG_X, IVec3::NEG_Y, IVec3::NEG_Z];
        let neighbours: Vec<[u32; 6]> = inside
            .iter()
            .map(|cell| steps.map(|step| self.rows[self.grid.index(self.grid.place(*cell) + step)]))
            .collect();
        let heat =
            |(_, length): &(usize, f32)| HEAT * (self.grid.cell / length.max(0.5 * self.grid.cell)).powi(2);
        let heats: Vec<f32> = nearest.iter().map(heat).collect();
        let share = |bone: usize, (source, length): (usize, f32)| {
            let source = &sources[source];
            let cloth = source.cloth.map_or(0.0, |(skin, _)| ((length / skin - 1.0) / 0.5).clamp(0.0, 1.0));
            let own = if source.bone == bone { 1.0 - cloth } else { 0.0 };
            own + if source.cloth.is_some_and(|(_, follows)| follows == bone) { cloth } else { 0.0 }
        };
        let temperatures: Vec<Vec<f32>> = (0..bones)
            .into_par_iter()
            .map(|bone| {
                let shares: Vec<f32> = nearest.iter().map(|near| share(bone, *near)).collect();
                solve(&neighbours, &heats, &shares)
            })
            .collect();
        let weights = |row: usize| {
            largest((0..bones).map(|bone| (bone as u32, temperatures[bone][row].max(0.0))).collect())
        };
        (0..inside.len()).into_par_iter().map(weights).collect()
    }

    /// Gives the cells outside the weights of a near cell inside.
    fn extend(&mut self) {
        let mut open: VecDeque<usize> =
            (0..self.rows.len()).filter(|cell| self.rows[*cell] != NONE).collect();
        while let Some(cell) = open.pop_front() {
            let at = self.grid.place(cell);
            for (step, _) in around() {
                let next = at + step;
                if next.cmplt(IVec3::ZERO).any() || next.cmpge(self.grid.counts).any() {
                    continue;
                }
                let next = self.grid.index(next);
                if self.rows[next] == NONE {
                    self.rows[next] = self.rows[cell];
                    open.push_back(next);
                }
            }
        }
    }
}

/// Solves (L + H) w = H p by conjugate gradients, with the diagonal as preconditioner.
fn solve(neighbours: &[[u32; 6]], heats: &[f32], shares: &[f32]) -> Vec<f32> {
    let mut w = shares.to_vec();
    if shares.iter().all(|share| *share == 0.0) {
        return w;
    }
    let there = |around: &[u32; 6]| around.iter().filter(|next| **next != NONE).count() as f32;
    let diagonal: Vec<f32> =
        neighbours.iter().zip(heats).map(|(around, heat)| there(around) + heat).collect();
    let times = |x: &[f32], out: &mut [f32]| {
        for (row, out) in out.iter_mut().enumerate() {
            let sum: f32 =
                neighbours[row].iter().filter(|next| **next != NONE).map(|next| x[*next as usize]).sum();
            *out = diagonal[row] * x[row] - sum;
        }
    };
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let mut product = vec![0.0; w.len()];
    times(&w, &mut product);
    let mut rest: Vec<f32> = (0..w.len()).map(|row| heats[row] * shares[row] - product[row]).collect();
    let mut scaled: Vec<f32> = rest.iter().zip(&diagonal).map(|(r, d)| r / d).collect();
    let mut way = scaled.clone();
    let mut size = dot(&rest, &scaled);
    let first = size;
    for _ in 0..ROUNDS {
        if size <= f64::from(ACCURATE * ACCURATE) * first {
            break;
        }
        times(&way, &mut product);
        let step = (size / dot(&way, &product)) as f32;
        for row in 0..w.len() {
            w[row] += step * way[row];
            rest[row] -= step * product[row];
            scaled[row] = rest[row] / diagonal[row];
        }
        let next = dot(&rest, &scaled);
        let keep = (next / size) as f32;
        way.iter_mut().zip(&scaled).for_each(|(way, scaled)| *way = scaled + keep * *way);
        size = next;
    }
    w
}

/// The four largest weights, with a sum of 1.
fn largest(mut sums: Vec<(u32, f32)>) -> Weights {
    sums.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut weights = Weights::default();
    weights.iter_mut().zip(&sums).for_each(|(to, from)| *to = *from);
    let sum: f32 = weights.iter().map(|(_, weight)| weight).sum();
    weights.iter_mut().for_each(|(_, weight)| *weight /= sum.max(f32::MIN_POSITIVE));
    weights
}

#[cfg(test)]
mod tests {
    use snapsnap_mesh::mesh::Mesh;

    use super::*;

    /// A closed mesh around cubes of 3 cm.
    fn cubes(is_solid: impl Fn(IVec3) -> bool) -> Mesh {
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        for cube in (0..40).flat_map(|x| (0..30).flat_map(move |y| (0..4).map(move |z| IVec3::new(x, y, z))))
        {
            for way in [IVec3::X, IVec3::Y, IVec3::Z].into_iter().flat_map(|way| [way, -way]) {
                if is_solid(cube) && !is_solid(cube + way) {
                    let outside = cube.as_vec3() + 0.5 + 0.5 * way.as_vec3();
                    let (u, v) = way.as_vec3().any_orthonormal_pair();
                    let first = positions.len() as u32;
                    let corners = [u + v, v - u, -u - v, u - v];
                    positions.extend(corners.map(|corner| 0.03 * (outside + 0.5 * corner)));
                    triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
                }
            }
        }
        let colors = vec![Vec3::ONE; positions.len()];
        Mesh::colored(positions, colors, triangles)
    }

    /// Two legs, one cube apart from each other, below a trunk; and beside them a piece without a bone.
    #[test]
    fn heat_takes_no_way_through_the_air() {
        let mesh = cubes(|IVec3 { x, y, z }| {
            let is_body = if y < 20 { x != 2 } else { y < 24 };
            let is_there = (0..2).contains(&z) && y >= 0;
            is_there && (is_body && (0..5).contains(&x) || (20..24).contains(&x) && y < 4)
        });
        let source = |bone, ends: [[f32; 2]; 2]| Source {
            bone,
            ends: ends.map(|[x, y]| 0.03 * Vec3::new(x, y, 1.0)),
            cloth: None,
        };
        let sources = [
            source(0, [[2.5, 23.0], [2.5, 21.0]]),
            source(1, [[1.0, 20.0], [1.0, 0.5]]),
            source(2, [[4.0, 20.0], [4.0, 0.5]]),
        ];
        let field = Field::new(Body::new(&mesh), &sources, 3).expect("bones within");
        let share = |x: f32, y: f32, bone: u32| {
            let weights = field.at(0.03 * Vec3::new(x, y, 1.0));
            weights.iter().filter(|(row, _)| *row == bone).map(|(_, weight)| weight).sum::<f32>()
        };
        // The other leg is as near here as the own bone.
        assert!(share(1.9, 10.0, 1) > 0.95 && share(1.9, 10.0, 2) < 0.01);
        assert!(share(3.1, 10.0, 2) > 0.95 && share(3.1, 10.0, 1) < 0.01);
        assert!(share(2.5, 23.0, 0) > 0.6);
        // The hip is bent by both bones.
        assert!((0.1..0.9).contains(&share(1.0, 20.0, 1)));
        for (x, y) in (-2..30).flat_map(|x| (-2..30).map(move |y| (x as f32, y as f32))) {
            let sum: f32 = (0..3).map(|bone| share(x, y, bone)).sum();
            assert!((sum - 1.0).abs() < 1e-5, "{x} {y}: {sum}");
        }
        assert!(Field::new(Body::new(&mesh), &[source(0, [[12.0, 2.0], [12.0, 3.0]])], 1).is_none());
    }
}
