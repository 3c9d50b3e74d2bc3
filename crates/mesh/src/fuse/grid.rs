//! Values on a regular grid, and the closed surface where they change their sign.

use std::collections::HashMap;

use glam::{USizeVec3, Vec3};
use rayon::prelude::*;

/// Signed distances at the corners of cubes, negative inside. The corners on the border are outside.
#[derive(Debug, Clone)]
pub struct Grid {
    /// Place of the first corner, world metres.
    pub origin: Vec3,
    /// Edge of a cube, metres.
    pub cell: f32,
    /// Corners along x, y and z.
    pub counts: USizeVec3,
    /// x runs fastest, then y.
    pub values: Vec<f32>,
}

/// Steps to half of the corners that share an edge with a corner once every cube is cut into six tetrahedra around its
/// diagonal (Kuhn's subdivision): the others are the same backwards.
const STEPS: [[usize; 3]; 7] = [[1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]];
/// The tetrahedra: in which order they go along the axes from a cube's first corner to its last, and whether that order
/// makes them left-handed.
const TETRAHEDRA: [([usize; 3], bool); 6] = [
    ([0, 1, 2], false),
    ([1, 2, 0], false),
    ([2, 0, 1], false),
    ([0, 2, 1], true),
    ([2, 1, 0], true),
    ([1, 0, 2], true),
];
/// Surfaces keep this share of an edge away from its ends, so that no triangle is without area.
const CLEARANCE: f32 = 0.05;

impl Grid {
    /// Place of a corner.
    pub fn place(&self, row: usize) -> Vec3 {
        let USizeVec3 { x: nx, y: ny, .. } = self.counts;
        self.origin
            + self.cell * Vec3::new((row % nx) as f32, (row / nx % ny) as f32, (row / (nx * ny)) as f32)
    }

    pub(super) fn strides(&self) -> [usize; 3] {
        [1, self.counts.x, self.counts.x * self.counts.y]
    }

    /// Distances between rows of corners that share an edge of a tetrahedron.
    fn steps(&self) -> [usize; 7] {
        let strides = self.strides();
        STEPS.map(|step| (0..3).map(|axis| step[axis] * strides[axis]).sum())
    }

    /// Whether the corner lies on the border.
    pub(super) fn on_border(&self, row: usize) -> bool {
        let USizeVec3 { x: nx, y: ny, z: nz } = self.counts;
        let at = [row % nx, row / nx % ny, row / (nx * ny)];
        at.iter().zip([nx, ny, nz]).any(|(i, n)| *i == 0 || i + 1 == n)
    }

    /// For every corner which piece of connected ones with the same sign it is in, from 0, and how many corners each piece has.
    /// Connected is what the edges of the tetrahedra connect: by them the surface between two pieces is one.
    pub(super) fn pieces(&self) -> (Vec<u32>, Vec<usize>) {
        let steps = self.steps();
        let mut piece = vec![u32::MAX; self.values.len()];
        let (mut sizes, mut waiting) = (Vec::new(), Vec::new());
        for first in 0..self.values.len() {
            if piece[first] != u32::MAX {
                continue;
            }
            let (number, inside) = (sizes.len() as u32, self.values[first] < 0.0);
            piece[first] = number;
            waiting.push(first);
            let mut size = 0;
            while let Some(row) = waiting.pop() {
                size += 1;
                let border = self.on_border(row);
                for step in steps {
                    for next in [row.checked_sub(step), row.checked_add(step)].into_iter().flatten() {
                        // A step from the border may come out on the other side of the grid.
                        let there = next < piece.len() && !(border && self.wraps(row, next));
                        if there && piece[next] == u32::MAX && (self.values[next] < 0.0) == inside {
                            piece[next] = number;
                            waiting.push(next);
                        }
                    }
                }
            }
            sizes.push(size);
        }
        (piece, sizes)
    }

    fn wraps(&self, a: usize, b: usize) -> bool {
        let USizeVec3 { x: nx, y: ny, .. } = self.counts;
        let apart = |a: usize, b: usize| a.abs_diff(b) > 1;
        apart(a % nx, b % nx) || apart(a / nx % ny, b / nx % ny)
    }

    /// How many pieces inside there are.
    pub fn bodies(&self) -> usize {
        let (piece, sizes) = self.pieces();
        let mut inside = vec![false; sizes.len()];
        piece.iter().zip(&self.values).for_each(|(piece, value)| inside[*piece as usize] |= *value < 0.0);
        inside.iter().filter(|inside| **inside).count()
    }

    /// Keeps the largest piece inside alone and fills what of the outside it encloses, so that one closed surface is left.
    /// Returns how many pieces were dropped, and how many were filled.
    pub fn keep_one_body(&mut self) -> (usize, usize) {
        let border: Vec<usize> = (0..self.values.len()).filter(|row| self.on_border(*row)).collect();
        border.iter().for_each(|row| self.values[*row] = self.values[*row].abs().max(f32::MIN_POSITIVE));
        let (piece, sizes) = self.pieces();
        let mut inside = vec![false; sizes.len()];
        piece.iter().zip(&self.values).for_each(|(piece, value)| inside[*piece as usize] |= *value < 0.0);
        let Some(body) = (0..sizes.len()).filter(|i| inside[*i]).max_by_key(|i| sizes[*i]) else {
            return (0, 0);
        };
        let dropped = inside.iter().filter(|inside| **inside).count() - 1;
        // What was dropped is outside now, and may have kept other pieces apart.
        for (piece, value) in piece.iter().zip(&mut self.values) {
            if *value < 0.0 && *piece as usize != body {
                *value = -*value;
            }
        }
        let (piece, sizes) = if dropped > 0 { self.pieces() } else { (piece, sizes) };
        let around = piece[0];
        let mut filled = vec![false; sizes.len()];
        for (piece, value) in piece.iter().zip(&mut self.values) {
            if *value >= 0.0 && *piece != around {
                filled[*piece as usize] = true;
                *value = -value.max(f32::MIN_POSITIVE);
            }
        }
        (dropped, filled.iter().filter(|filled| **filled).count())
    }

    /// Puts the mean of each corner and its six neighbours in its place; those on the border stay.
    pub fn smooth(&mut self) {
        let strides = self.strides();
        let old = std::mem::take(&mut self.values);
        self.values = (0..old.len())
            .into_par_iter()
            .map(|row| {
                if self.on_border(row) {
                    return old[row];
                }
                let around = strides.iter().map(|step| old[row - step] + old[row + step]).sum::<f32>();
                (2.0 * old[row] + around) / 8.0
            })
            .collect();
    }

    /// The surface between inside and outside, from every cube's six tetrahedra: closed, each edge has two triangles, and
    /// counter-clockwise as seen from outside.
    pub fn surface(&self) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let strides = self.strides();
        let mut corners = HashMap::new();
        let (mut positions, mut faces) = (Vec::new(), Vec::new());
        let mut between = |a: usize, b: usize| {
            // Both neighbours ask for the same edge, in either direction.
            let key = (a.min(b), a.max(b));
            *corners.entry(key).or_insert_with(|| {
                let [va, vb] = [key.0, key.1].map(|row| self.values[row]);
                let share = (va / (va - vb)).clamp(CLEARANCE, 1.0 - CLEARANCE);
                positions.push(self.place(key.0).lerp(self.place(key.1), share));
                positions.len() as u32 - 1
            })
        };
        let USizeVec3 { x: nx, y: ny, z: nz } = self.counts;
        for z in 0..nz.saturating_sub(1) {
            for y in 0..ny.saturating_sub(1) {
                for x in 0..nx.saturating_sub(1) {
                    let first = x + nx * (y + ny * z);
                    let inside = |row: usize| self.values[row] < 0.0;
                    let cube = STEPS.iter().map(|s| first + s[0] + nx * (s[1] + ny * s[2]));
                    if cube.into_iter().all(|row| inside(row) == inside(first)) {
                        continue;
                    }
                    for (order, left_handed) in TETRAHEDRA {
                        let second = first + strides[order[0]];
                        let third = second + strides[order[1]];
                        tetrahedron(
                            [first, second, third, third + strides[order[2]]],
                            left_handed,
                            &inside,
                            &mut between,
                            &mut faces,
                        );
                    }
                }
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
    // Those inside first; every exchange of neighbours mirrors the tetrahedron.
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
        // (d, c, b, a) is (a, b, c, d) after two exchanges, and what lies outside is d alone.
        3 => face([between(d, a), between(d, b), between(d, c)]),
        _ => {}
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

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

    /// Of n³ corners from (−1, −1, −1) to (1, 1, 1).
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
    fn a_ball_is_closed_and_has_its_volume() {
        let (positions, faces) = grid(41, |p| p.length() - 0.7).surface();
        assert!(is_closed(&faces));
        let expected = 4.0 / 3.0 * std::f64::consts::PI * 0.7_f64.powi(3);
        let found = volume(&positions, &faces);
        assert!((found / expected - 1.0).abs() < 0.01, "{found} instead of {expected}");
        // One piece without handles.
        assert_eq!(positions.len() as i64 - faces.len() as i64 * 3 / 2 + faces.len() as i64, 2);
    }

    #[test]
    fn noise_is_closed_and_one_piece_once_one_body_is_kept() {
        let noise = |p: Vec3| (p * 977.0).dot(Vec3::new(12.9898, 78.233, 37.719)).sin();
        // Little inside, in crumbs; then little outside, in bubbles.
        let (dropped, _) = grid(24, |p| noise(p) + 0.95).keep_one_body();
        let mut grid = grid(24, |p| noise(p) - 0.95);
        let (_, filled) = grid.keep_one_body();
        assert!(dropped > 10 && filled > 10, "{dropped} {filled}");
        assert_eq!(grid.keep_one_body(), (0, 0));
        let (_, sizes) = grid.pieces();
        assert_eq!(sizes.len(), 2);
        grid.values.iter_mut().for_each(|value| *value += 0.95);
        grid.keep_one_body();
        let (positions, faces) = grid.surface();
        assert!(is_closed(&faces) && volume(&positions, &faces) > 0.0);
        let mut piece: Vec<usize> = (0..positions.len()).collect();
        // The smallest row that a corner is connected with.
        loop {
            let before = piece.clone();
            for f in &faces {
                let least = f.iter().map(|row| piece[*row as usize]).min().expect("three");
                f.iter().for_each(|row| piece[*row as usize] = least);
            }
            if piece == before {
                break;
            }
        }
        assert!(piece.iter().all(|p| *p == 0));
    }

    #[test]
    fn what_a_body_encloses_is_filled_and_what_flies_beside_it_is_dropped() {
        let hollow = |p: Vec3| (p.length() - 0.6).abs() - 0.15;
        let speck = |p: Vec3| (p - Vec3::splat(0.85)).length() - 0.09;
        let mut grid = grid(41, |p| hollow(p).min(speck(p)));
        assert_eq!(grid.keep_one_body(), (1, 1));
        let (positions, faces) = grid.surface();
        let expected = 4.0 / 3.0 * std::f64::consts::PI * 0.75_f64.powi(3);
        assert!(is_closed(&faces) && (volume(&positions, &faces) / expected - 1.0).abs() < 0.01);
    }

    #[test]
    fn bodies_that_reach_the_border_are_closed_there() {
        let mut grid = grid(9, |_| -1.0);
        assert_eq!(grid.keep_one_body(), (0, 0));
        let (_, faces) = grid.surface();
        assert!(!faces.is_empty() && is_closed(&faces));
    }
}
