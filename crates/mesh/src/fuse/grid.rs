//! Values on a regular grid, and the closed surface at which their sign changes.

use std::collections::HashMap;

use glam::{USizeVec3, Vec3};
use rayon::prelude::*;

/// Signed distances at the corners of cubes, negative inside. The corners on the border are outside.
#[derive(Debug, Clone)]
pub struct Grid {
    /// Position of the first corner, metres from the body's centre.
    pub origin: Vec3,
    /// Edge of a cube, metres.
    pub cell: f32,
    /// Corners along x, y and z.
    pub counts: USizeVec3,
    /// x runs fastest, then y.
    pub values: Vec<f32>,
}

/// Cubes along the longest side of the body's box, unless the field would have more corners than [`MAX_CORNERS`].
const CUBES: f32 = 320.0;
/// Most corners of the field. A person with level arms has eight million; a cube-shaped scene gets larger cubes.
const MAX_CORNERS: f32 = 12e6;
/// Offsets to half of the corners that share an edge with a corner. The other offsets have the opposite sign. Every
/// cube consists of six tetrahedra around its diagonal (Kuhn's subdivision).
pub const STEPS: [[usize; 3]; 7] =
    [[1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]];
/// Each tetrahedron's order of axes on the way from a cube's first corner to its last, and whether it is left-handed.
const TETRAHEDRA: [([usize; 3], bool); 6] = [
    ([0, 1, 2], false),
    ([1, 2, 0], false),
    ([2, 0, 1], false),
    ([0, 2, 1], true),
    ([2, 1, 0], true),
    ([1, 0, 2], true),
];
/// Smallest distance of the surface from the ends of an edge, as a share of the edge. It avoids degenerate triangles.
const CLEARANCE: f32 = 0.05;

/// Connected components of corners with the same sign. Edges of tetrahedra connect corners, so that the surface
/// between two pieces is connected, too.
pub struct Pieces {
    /// For every corner the number of its piece.
    pub of: Vec<u32>,
    /// For every piece the number of its corners.
    pub sizes: Vec<usize>,
    /// For every piece whether its corners are inside.
    pub inside: Vec<bool>,
}

impl Pieces {
    /// The largest piece inside, if there is one.
    pub fn body(&self) -> Option<usize> {
        (0..self.sizes.len()).filter(|piece| self.inside[*piece]).max_by_key(|piece| self.sizes[*piece])
    }
}

impl Grid {
    /// The grid, still without values, of a box of this size around the origin, with a border of some cubes that stays
    /// outside.
    pub fn around(size: Vec3, border: f32) -> Self {
        let roomy = (size.element_product() / MAX_CORNERS).cbrt();
        let cell = (size.max_element() / CUBES).max(roomy);
        let margin = cell * border;
        let counts = ((size + 2.0 * margin) / cell).ceil().as_usizevec3() + 1;
        Self { origin: -0.5 * size - margin, cell, counts, values: Vec::new() }
    }

    /// Coordinates of a corner in the grid.
    pub fn at(&self, row: usize) -> USizeVec3 {
        let USizeVec3 { x: nx, y: ny, .. } = self.counts;
        USizeVec3::new(row % nx, row / nx % ny, row / (nx * ny))
    }

    /// Position of a corner.
    pub fn place(&self, row: usize) -> Vec3 {
        self.origin + self.cell * self.at(row).as_vec3()
    }

    /// The corner nearest to a place, unless it is nearer than `border` cubes to the grid's border.
    pub fn nearest(&self, place: Vec3, border: usize) -> Option<usize> {
        let at = ((place - self.origin) / self.cell).round();
        let (low, high) = (Vec3::splat(border as f32), (self.counts - 1 - border).as_vec3());
        let USizeVec3 { x, y, z } = at.as_usizevec3();
        (at.cmpge(low) & at.cmple(high)).all().then(|| (z * self.counts.y + y) * self.counts.x + x)
    }

    /// The corners up to `reach` along each axis from a corner that is not nearer to the border, itself included.
    pub fn around_corner(&self, row: usize, reach: usize) -> impl Iterator<Item = usize> + use<> {
        let [_, line, sheet] = self.strides();
        let first = row - reach * (1 + line + sheet);
        let side = 0..=2 * reach;
        let lines = side.clone().flat_map(move |z| side.clone().map(move |y| first + z * sheet + y * line));
        lines.flat_map(move |line| line..=line + 2 * reach)
    }

    /// Whether a corner that is not on the border has a neighbour of the other sign.
    pub fn is_at_surface(&self, row: usize) -> bool {
        let inside = |row: usize| self.values[row] < 0.0;
        let mut around = self.strides().into_iter().flat_map(|step| [row - step, row + step]);
        around.any(|next| inside(next) != inside(row))
    }

    pub fn strides(&self) -> [usize; 3] {
        [1, self.counts.x, self.counts.x * self.counts.y]
    }

    /// [`STEPS`] as differences of indices.
    fn steps(&self) -> [usize; 7] {
        let strides = self.strides();
        STEPS.map(|step| (0..3).map(|axis| step[axis] * strides[axis]).sum())
    }

    /// Whether the corner lies on the border.
    pub fn on_border(&self, row: usize) -> bool {
        let at = self.at(row);
        at.min_element() == 0 || (at + 1).cmpeq(self.counts).any()
    }

    /// The connected pieces of the inside and the outside.
    pub fn pieces(&self) -> Pieces {
        let steps = self.steps();
        let mut pieces = Pieces { of: vec![u32::MAX; self.values.len()], sizes: vec![], inside: vec![] };
        let mut waiting = Vec::new();
        for first in 0..self.values.len() {
            if pieces.of[first] != u32::MAX {
                continue;
            }
            let (number, inside) = (pieces.sizes.len() as u32, self.values[first] < 0.0);
            pieces.of[first] = number;
            waiting.push(first);
            let mut size = 0;
            while let Some(row) = waiting.pop() {
                size += 1;
                let border = self.on_border(row);
                for step in steps {
                    for next in [row.checked_sub(step), row.checked_add(step)].into_iter().flatten() {
                        // A step from the border may wrap around to the other side of the grid.
                        let wraps = || {
                            let apart = self.at(row).as_i64vec3() - self.at(next).as_i64vec3();
                            apart.abs().max_element() > 1
                        };
                        let there = next < self.values.len() && !(border && wraps());
                        if there && pieces.of[next] == u32::MAX && (self.values[next] < 0.0) == inside {
                            pieces.of[next] = number;
                            waiting.push(next);
                        }
                    }
                }
            }
            pieces.sizes.push(size);
            pieces.inside.push(inside);
        }
        pieces
    }

    /// Keeps only the largest piece inside and fills the outside that it encloses, which leaves one closed surface.
    /// Returns the number of dropped pieces, and the corners of the largest one as a share of the body's corners.
    pub fn keep_one_body(&mut self) -> (usize, f64) {
        for row in 0..self.values.len() {
            if self.on_border(row) {
                self.values[row] = self.values[row].abs().max(f32::MIN_POSITIVE);
            }
        }
        let mut pieces = self.pieces();
        let Some(body) = pieces.body() else { return (0, 0.0) };
        let others = (0..pieces.sizes.len()).filter(|i| pieces.inside[*i] && *i != body);
        let dropped = others.clone().count();
        let largest = others.map(|i| pieces.sizes[i]).max().unwrap_or(0);
        let largest_dropped = largest as f64 / pieces.sizes[body] as f64;
        if dropped > 0 {
            for (piece, value) in pieces.of.iter().zip(&mut self.values) {
                if *value < 0.0 && *piece as usize != body {
                    *value = -*value;
                }
            }
            // Pieces of the outside may be connected now.
            pieces = self.pieces();
        }
        let around = pieces.of[0];
        for (piece, value) in pieces.of.iter().zip(&mut self.values) {
            if *value >= 0.0 && *piece != around {
                *value = -value.max(f32::MIN_POSITIVE);
            }
        }
        (dropped, largest_dropped)
    }

    /// Number of positions that [`Self::surface`] returns.
    pub fn crossings(&self) -> usize {
        let steps = self.steps();
        let inside = |row: usize| self.values[row] < 0.0;
        let count = |row: usize| {
            let at = self.at(row);
            let edges = STEPS.iter().zip(steps);
            let there =
                edges.filter(|(step, _)| (at + USizeVec3::from_array(**step)).cmplt(self.counts).all());
            there.filter(|(_, step)| inside(row) != inside(row + step)).count()
        };
        (0..self.values.len()).into_par_iter().map(count).sum()
    }

    /// Replaces each value by a weighted mean with its six neighbours. Values on the border stay.
    pub fn smooth(&mut self) {
        let smoothed = |row| if self.on_border(row) { self.values[row] } else { self.smoothed(row) };
        self.values = (0..self.values.len()).into_par_iter().map(smoothed).collect();
    }

    /// The weighted mean of the values at a corner and its six neighbours. The corner is not on the border.
    pub fn smoothed(&self, row: usize) -> f32 {
        let values = &self.values;
        let around = self.strides().map(|step| values[row - step] + values[row + step]);
        (2.0 * values[row] + around.iter().sum::<f32>()) / 8.0
    }

    /// Marching tetrahedra: the closed surface between inside and outside. Each edge has two triangles. Triangles are
    /// counter-clockwise as seen from outside.
    pub fn surface(&self) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let strides = self.strides();
        let mut corners = HashMap::new();
        let (mut positions, mut faces) = (Vec::new(), Vec::new());
        let mut between = |a: usize, b: usize| {
            // Neighbouring tetrahedra pass the same edge in either direction.
            let key = (a.min(b), a.max(b));
            *corners.entry(key).or_insert_with(|| {
                let [va, vb] = [key.0, key.1].map(|row| self.values[row]);
                let share = (va / (va - vb)).clamp(CLEARANCE, 1.0 - CLEARANCE);
                positions.push(self.place(key.0).lerp(self.place(key.1), share));
                positions.len() as u32 - 1
            })
        };
        let steps = self.steps();
        let inside = |row: usize| self.values[row] < 0.0;
        for first in 0..self.values.len() {
            let is_cube = (self.at(first) + 1).cmplt(self.counts).all();
            if !is_cube || steps.iter().all(|step| inside(first + step) == inside(first)) {
                continue;
            }
            for (order, left_handed) in TETRAHEDRA {
                let second = first + strides[order[0]];
                let third = second + strides[order[1]];
                let corners = [first, second, third, third + strides[order[2]]];
                tetrahedron(corners, left_handed, &inside, &mut between, &mut faces);
            }
        }
        (positions, faces)
    }
}

/// The triangles in one tetrahedron.
fn tetrahedron(
    corners: [usize; 4],
    left_handed: bool,
    inside: &impl Fn(usize) -> bool,
    between: &mut impl FnMut(usize, usize) -> u32,
    faces: &mut Vec<[u32; 3]>,
) {
    // Sorts the corners inside to the front. Each swap mirrors the tetrahedron.
    let mut sorted = corners;
    let mut mirrored = left_handed;
    for end in (1..4).rev() {
        for i in 0..end {
            if !inside(sorted[i]) && inside(sorted[i + 1]) {
                sorted.swap(i, i + 1);
                mirrored = !mirrored;
            }
        }
    }
    let [a, b, c, d] = sorted;
    let mut face = |mut face: [u32; 3]| {
        if mirrored {
            face.swap(1, 2);
        }
        faces.push(face);
    };
    match sorted.iter().filter(|row| inside(**row)).count() {
        1 => face([between(a, b), between(a, c), between(a, d)]),
        2 => {
            let quad = [between(a, c), between(a, d), between(b, d), between(b, c)];
            face([quad[0], quad[1], quad[2]]);
            face([quad[0], quad[2], quad[3]]);
        }
        // Only d is outside. (d, c, b, a) is (a, b, c, d) after two swaps, which keep the orientation.
        3 => face([between(d, a), between(d, b), between(d, c)]),
        _ => {}
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::fuse::manifold::manifold;

    /// Every edge has two faces that run along it in opposite directions.
    pub fn is_closed(faces: &[[u32; 3]]) -> bool {
        let mut edges = HashMap::new();
        for f in faces {
            for (a, b) in [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])] {
                *edges.entry((a, b)).or_insert(0) += 1;
            }
        }
        edges.iter().all(|((a, b), n)| *n == 1 && edges.get(&(*b, *a)) == Some(&1))
    }

    /// A grid of n³ corners from (−1, −1, −1) to (1, 1, 1).
    pub fn grid(n: usize, value: impl Fn(Vec3) -> f32) -> Grid {
        let cell = 2.0 / (n - 1) as f32;
        let mut grid =
            Grid { origin: Vec3::NEG_ONE, cell, counts: USizeVec3::splat(n), values: vec![0.0; n * n * n] };
        for row in 0..grid.values.len() {
            grid.values[row] = value(grid.place(row));
        }
        grid
    }

    pub fn volume(positions: &[Vec3], faces: &[[u32; 3]]) -> f64 {
        let corner = |row: u32| positions[row as usize].as_dvec3();
        faces.iter().map(|f| corner(f[0]).dot(corner(f[1]).cross(corner(f[2]))) / 6.0).sum()
    }

    #[test]
    fn noise_is_closed_and_one_piece_once_one_body_is_kept() {
        let noise = |p: Vec3| (p * 977.0).dot(Vec3::new(12.9898, 78.233, 37.719)).sin();
        // Small pieces inside, then small pieces outside.
        let (dropped, _) = grid(24, |p| noise(p) + 0.95).keep_one_body();
        let mut grid = grid(24, |p| noise(p) - 0.95);
        let before = grid.pieces().sizes.len();
        grid.keep_one_body();
        assert!(dropped > 10 && before > 12, "{dropped} {before}");
        assert_eq!(grid.keep_one_body(), (0, 0.0));
        assert_eq!(grid.pieces().sizes.len(), 2);
        grid.values.iter_mut().for_each(|value| *value += 0.95);
        grid.keep_one_body();
        let (positions, faces) = grid.surface();
        assert!(is_closed(&faces) && volume(&positions, &faces) > 0.0);
        assert_eq!(manifold(&positions, faces).expect("closed").pieces().1, 1);
    }

    #[test]
    fn hollows_of_a_body_are_filled_and_specks_beside_it_dropped() {
        let hollow = |p: Vec3| (p.length() - 0.6).abs() - 0.15;
        let speck = |p: Vec3| (p - Vec3::splat(0.85)).length() - 0.09;
        let mut grid = grid(41, |p| hollow(p).min(speck(p)));
        let (dropped, largest) = grid.keep_one_body();
        // (0.09/0.75)³ without the hollow.
        assert!(dropped == 1 && (0.0005..0.005).contains(&largest), "{dropped} {largest}");
        let (positions, faces) = grid.surface();
        let expected = 4.0 / 3.0 * std::f64::consts::PI * 0.75_f64.powi(3);
        assert!(is_closed(&faces) && (volume(&positions, &faces) / expected - 1.0).abs() < 0.01);
    }

    #[test]
    fn bodies_that_reach_the_border_are_closed_there() {
        let mut grid = grid(9, |_| -1.0);
        assert_eq!(grid.keep_one_body(), (0, 0.0));
        let (positions, faces) = grid.surface();
        assert!(!faces.is_empty() && is_closed(&faces));
        assert_eq!(grid.crossings(), positions.len());
    }
}
