//! Closed surfaces again out of triangles some of whose edges fell onto one another.

use std::collections::{HashMap, HashSet};

use glam::Vec3;

/// How far copies of a position move into their body, as a share of the mean length of edges there.
const APART: f32 = 0.02;

/// Triangles of which every edge has two and every position one fan.
pub struct Manifold {
    /// Rows of positions; from their number on, those of `copies`.
    pub triangles: Vec<[u32; 3]>,
    /// Of which position, and where it is now.
    pub copies: Vec<(u32, Vec3)>,
    /// For the side of triangle t that begins with corner c, as 3 t + c, the side of another along the same edge.
    pub across: Vec<usize>,
}

/// Takes away triangles that lie on one another and face away from each other, and cuts surfaces apart where more than two
/// triangles meet at an edge, or several fans at a position: bodies that touch there do not any more.
///
/// Each edge must have as many triangles that run along it in one direction as in the other, which collapsing edges of a closed
/// surface does not change; else there is none.
pub fn manifold(positions: &[Vec3], triangles: Vec<[u32; 3]>) -> Option<Manifold> {
    let triangles = unfolded(triangles);
    let across = across(positions, &triangles)?;
    let mut found = Manifold { triangles, copies: Vec::new(), across };
    found.part_fans(positions);
    found.part_edges(positions);
    Some(found)
}

impl Manifold {
    /// Every fan but a position's first gets a copy of it.
    fn part_fans(&mut self, positions: &[Vec3]) {
        let mut has_fan = vec![false; positions.len()];
        let mut known = vec![false; self.across.len()];
        let mut fan = Vec::new();
        for first in 0..known.len() {
            if known[first] {
                continue;
            }
            // Around the position that the side begins with.
            fan.clear();
            let mut side = first;
            while !known[side] {
                known[side] = true;
                fan.push(side);
                side = self.across[around(side, 2)];
            }
            let row = self.triangles[first / 3][first % 3];
            if !std::mem::replace(&mut has_fan[row as usize], true) {
                continue;
            }
            let (mut normal, mut length) = (Vec3::ZERO, 0.0);
            for side in &fan {
                let [here, next, last] = [0, 1, 2].map(|step| self.place(positions, around(*side, step)));
                normal += (next - here).cross(last - here);
                length += (next - here).length() / fan.len() as f32;
            }
            let place = positions[row as usize] - APART * length * normal.normalize_or(Vec3::Y);
            let copy = self.copy(positions, row, place);
            fan.iter().for_each(|side| self.triangles[side / 3][side % 3] = copy);
        }
    }

    /// Every edge that still has more than two triangles, since the fans at both its ends pass it twice, gets positions in the middle,
    /// each for two of them.
    fn part_edges(&mut self, positions: &[Vec3]) {
        let mut there = HashSet::new();
        let ends = |triangles: &[[u32; 3]], side: usize| {
            (triangles[side / 3][side % 3], triangles[side / 3][(side + 1) % 3])
        };
        let sides = 0..self.across.len();
        let mut again: Vec<usize> = sides
            .filter(|side| {
                let (from, to) = ends(&self.triangles, *side);
                from < to && !there.insert((from, to))
            })
            .collect();
        while let Some(side) = again.pop() {
            let pair = [side, self.across[side]];
            let mut normal = Vec3::ZERO;
            for side in pair {
                let [from, to, third] = [0, 1, 2].map(|step| self.place(positions, around(side, step)));
                normal += (to - from).cross(third - from);
            }
            let [from, to] = [0, 1].map(|step| self.place(positions, around(side, step)));
            let inwards = APART * (to - from).length() * normal.normalize_or(Vec3::Y);
            let row = self.triangles[side / 3][side % 3];
            let middle = self.copy(positions, row, 0.5 * (from + to) - inwards);
            // Both triangles keep the half that the side begins with; new ones get the other.
            let halves = pair.map(|side| {
                let (half, moved) = (self.across.len(), around(side, 1));
                let [_, to, third] = [0, 1, 2].map(|step| self.triangles[side / 3][(side + step) % 3]);
                self.triangles[side / 3][(side + 1) % 3] = middle;
                self.triangles.push([middle, to, third]);
                self.across.extend([usize::MAX; 3]);
                self.pair(half + 1, self.across[moved]);
                self.pair(half + 2, moved);
                again.iter_mut().filter(|side| **side == moved).for_each(|side| *side = half + 1);
                half
            });
            self.pair(pair[0], halves[1]);
            self.pair(pair[1], halves[0]);
        }
    }

    fn pair(&mut self, side: usize, other: usize) {
        (self.across[side], self.across[other]) = (other, side);
    }

    /// Where the corner is that a side begins with.
    fn place(&self, positions: &[Vec3], side: usize) -> Vec3 {
        let row = self.triangles[side / 3][side % 3] as usize;
        if row < positions.len() { positions[row] } else { self.copies[row - positions.len()].1 }
    }

    /// A further position like that in this row, somewhere else.
    fn copy(&mut self, positions: &[Vec3], row: u32, place: Vec3) -> u32 {
        let source = (row as usize).checked_sub(positions.len()).map_or(row, |copy| self.copies[copy].0);
        self.copies.push((source, place));
        (positions.len() + self.copies.len() - 1) as u32
    }

    /// For each triangle which piece it is in, from 0, and how many pieces there are.
    pub fn pieces(&self) -> (Vec<usize>, usize) {
        let mut piece = vec![usize::MAX; self.triangles.len()];
        let (mut count, mut waiting) = (0, Vec::new());
        for first in 0..piece.len() {
            if piece[first] != usize::MAX {
                continue;
            }
            piece[first] = count;
            waiting.push(first);
            while let Some(face) = waiting.pop() {
                for next in self.across[3 * face..3 * face + 3].iter().map(|side| side / 3) {
                    if piece[next] == usize::MAX {
                        piece[next] = count;
                        waiting.push(next);
                    }
                }
            }
            count += 1;
        }
        (piece, count)
    }
}

/// The side so many steps farther around the same triangle.
fn around(side: usize, steps: usize) -> usize {
    side - side % 3 + (side + steps) % 3
}

/// Without triangles that have less than three corners, and pairs of the same corners in opposite orders.
fn unfolded(mut triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    let mut there: HashMap<[u32; 3], Vec<usize>> = HashMap::new();
    let mut kept = vec![true; triangles.len()];
    for (face, triangle) in triangles.iter().enumerate() {
        let mut key = *triangle;
        while key[0] > key[1] || key[0] > key[2] {
            key.rotate_left(1);
        }
        if key[0] == key[1] || key[1] == key[2] || key[2] == key[0] {
            kept[face] = false;
        } else if let Some(other) = there.get_mut(&[key[0], key[2], key[1]]).and_then(Vec::pop) {
            (kept[face], kept[other]) = (false, false);
        } else {
            there.entry(key).or_default().push(face);
        }
    }
    let mut kept = kept.into_iter();
    triangles.retain(|_| kept.next() == Some(true));
    triangles
}

/// See [`Manifold::across`].
fn across(positions: &[Vec3], triangles: &[[u32; 3]]) -> Option<Vec<usize>> {
    // Both ends, the smaller first, then whether it runs from the larger one.
    let mut sides: Vec<(u32, u32, bool, usize)> = Vec::with_capacity(3 * triangles.len());
    for (face, triangle) in triangles.iter().enumerate() {
        for at in 0..3 {
            let (from, to) = (triangle[at], triangle[(at + 1) % 3]);
            sides.push((from.min(to), from.max(to), from > to, 3 * face + at));
        }
    }
    sides.sort_unstable();
    let mut across = vec![usize::MAX; sides.len()];
    let mut pair = |a: usize, b: usize| (across[a], across[b]) = (b, a);
    for edge in sides.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        if let [(_, _, false, one), (_, _, true, other)] = edge {
            pair(*one, *other);
            continue;
        }
        // Around the edge, counter-clockwise as seen from its larger end: what runs from there begins a body, what runs towards
        // it ends one.
        let [from, to] = [edge[0].0, edge[0].1].map(|row| positions[row as usize]);
        let axis = (to - from).normalize_or(Vec3::Y);
        let x = axis.any_orthonormal_vector();
        let y = axis.cross(x);
        let angle = |side: usize| {
            let third = positions[triangles[side / 3][(side + 2) % 3] as usize] - from;
            third.dot(y).atan2(third.dot(x))
        };
        let mut around: Vec<(f32, bool, usize)> = edge.iter().map(|e| (angle(e.3), e.2, e.3)).collect();
        around.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
        let mut open = Vec::new();
        // A body may reach over the angle at which counting begins.
        for _ in 0..2 {
            around.retain(|&(_, begins, side)| {
                if begins {
                    open.push(side);
                    return false;
                }
                let Some(begun) = open.pop() else { return true };
                pair(begun, side);
                false
            });
        }
    }
    across.iter().all(|side| *side != usize::MAX).then_some(across)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuse::grid::tests::{is_closed, volume};

    /// Outwards for a right-handed (a, b, c) as seen from d.
    fn tetrahedron([a, b, c, d]: [u32; 4]) -> [[u32; 3]; 4] {
        [[a, c, b], [a, b, d], [b, c, d], [c, a, d]]
    }

    /// What is left of `triangles`, so many pieces with so many copies.
    fn check(positions: &[Vec3], triangles: &[[u32; 3]], pieces: usize, copies: usize) -> Manifold {
        let found = manifold(positions, triangles.to_vec()).expect("closed");
        assert_eq!((found.pieces().1, found.copies.len()), (pieces, copies));
        assert!(is_closed(&found.triangles));
        let sides =
            |side: usize| (found.triangles[side / 3][side % 3], found.triangles[side / 3][(side + 1) % 3]);
        for (side, other) in found.across.iter().enumerate() {
            let ((a, b), (c, d)) = (sides(side), sides(*other));
            assert_eq!((a, b), (d, c));
        }
        let mut all = positions.to_vec();
        all.extend(found.copies.iter().map(|copy| copy.1));
        let (before, after) = (volume(positions, triangles), volume(&all, &found.triangles));
        assert!(after > 0.9 * before && after <= before * 1.000_001, "{after} of {before}");
        found
    }

    #[test]
    fn bodies_that_touch_are_cut_apart() {
        // An edge from 0 to 1, and one body on either side of it; from any angle.
        for turn in 0..12 {
            let turned = |x: f32, y: f32| Vec3::new(x, y, 0.5).rotate_z(0.55 * turn as f32);
            let edge = [Vec3::ZERO, Vec3::Z];
            let ends = [turned(1.0, -0.3), turned(1.0, 0.3), turned(-1.0, 0.3), turned(-1.0, -0.3)];
            let positions = [&edge[..], &ends].concat();
            let (one, other) = (tetrahedron([0, 2, 3, 1]), tetrahedron([0, 4, 5, 1]));
            let found = check(&positions, &[one, other].concat(), 2, 2);
            // Every triangle of one body has neighbours in the same.
            assert!(found.across.iter().enumerate().all(|(side, other)| (side < 12) == (*other < 12)));
            // The second body has the copies, which lie farther on its side.
            assert_eq!(found.copies.iter().map(|copy| copy.0).collect::<Vec<u32>>(), [0, 1]);
            assert!(found.copies.iter().all(|(_, place)| place.dot(turned(-1.0, 0.0).with_z(0.0)) > 0.001));
        }
        // At one position.
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
        check(&positions, &[tetrahedron([0, 1, 2, 3]), tetrahedron([0, 5, 4, 6])].concat(), 2, 1);
    }

    /// The surface of the cubes of a grid of n³ that are solid; cubes that touch share their corners.
    fn cubes(n: usize, solid: impl Fn([usize; 3]) -> bool) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let row = |[x, y, z]: [usize; 3]| (x + (n + 1) * (y + (n + 1) * z)) as u32;
        let each = |n: usize| (0..n * n * n).map(move |i| [i % n, i / n % n, i / n / n]);
        let positions = each(n + 1).map(|at| Vec3::from_array(at.map(|c| c as f32))).collect();
        let mut triangles = Vec::new();
        for at in each(n).filter(|at| solid(*at)) {
            for axis in 0..3 {
                for up in [false, true] {
                    let mut beside = at.map(|c| c as isize);
                    beside[axis] += if up { 1 } else { -1 };
                    let within = beside.iter().all(|c| (0..n as isize).contains(c));
                    if within && solid(beside.map(|c| c as usize)) {
                        continue;
                    }
                    let corner = |u: usize, v: usize| {
                        let mut corner = at;
                        corner[axis] += usize::from(up);
                        corner[(axis + 1) % 3] += u;
                        corner[(axis + 2) % 3] += v;
                        row(corner)
                    };
                    let mut quad = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    if !up {
                        quad.reverse();
                    }
                    triangles.extend([[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]);
                }
            }
        }
        (positions, triangles)
    }

    #[test]
    fn an_edge_on_which_a_hole_has_closed_is_parted() {
        // Two cubes that touch along an edge, between two full layers: around both its ends there is one fan.
        let (positions, triangles) = cubes(3, |[x, y, z]| x < 2 && z < 2 && (y != 1 || x == z));
        let found = check(&positions, &triangles, 1, 1);
        assert_eq!(found.triangles.len(), triangles.len() + 2);
    }

    #[test]
    fn whatever_touches_is_parted() {
        for seed in 0..40_u64 {
            let solid = |[x, y, z]: [usize; 3]| {
                let mixed = (seed << 9 | (x + 6 * y + 36 * z) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 32 & 1 == 0
            };
            let (positions, triangles) = cubes(6, solid);
            let found = manifold(&positions, triangles.clone()).expect("closed");
            let found = check(&positions, &triangles, found.pieces().1, found.copies.len());
            let mut all = positions.clone();
            all.extend(found.copies.iter().map(|copy| copy.1));
            let again = manifold(&all, found.triangles.clone()).expect("closed");
            assert!(again.copies.is_empty() && again.triangles == found.triangles);
            let places: HashSet<[u32; 3]> = all.iter().map(|p| p.to_array().map(f32::to_bits)).collect();
            assert_eq!(places.len(), all.len());
        }
    }

    #[test]
    fn folds_are_taken_away_and_open_surfaces_refused() {
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::ONE];
        let body = tetrahedron([0, 1, 2, 3]);
        // A fin on the edge from 2 to 3, and a triangle without a third corner.
        let fin = [[2, 4, 3], [4, 2, 3], [1, 1, 2], [2, 1, 1]];
        let found = check(&positions, &[&body[..], &fin].concat(), 1, 0);
        assert_eq!(found.triangles, body);
        assert!(manifold(&positions, body[1..].to_vec()).is_none());
        assert!(manifold(&positions, [&body[..], &fin[..1]].concat()).is_none());
    }
}
