//! Repair of closed surfaces in which edges coincide.

use std::collections::{HashMap, HashSet};

use glam::Vec3;

use crate::mesh::pieces;

/// Distance by which a copy of a position moves inwards, as a share of the mean length of the edges there.
const APART: f32 = 0.02;

/// A surface with two triangles at every edge and one fan at every position.
pub struct Manifold {
    /// Indices into `places`.
    pub triangles: Vec<[u32; 3]>,
    /// Positions, followed by the copies.
    pub places: Vec<Vec3>,
    /// For each entry of `places` the index of its original position.
    pub sources: Vec<u32>,
    /// For each side the other triangle's side along the same edge. Side 3 t + c of triangle t begins at its corner c.
    pub across: Vec<usize>,
}

/// Removes pairs of triangles that coincide and face opposite directions. Cuts the surface apart where more than two
/// triangles meet at an edge, or several fans at a position.
///
/// `None` unless each edge has as many triangles along it in one direction as in the other. Collapsing edges of a
/// closed surface preserves this.
pub fn manifold(positions: &[Vec3], triangles: Vec<[u32; 3]>) -> Option<Manifold> {
    let triangles = unfolded(triangles);
    let across = across(positions, &triangles)?;
    let sources = (0..positions.len() as u32).collect();
    let mut found = Manifold { triangles, places: positions.to_vec(), sources, across };
    found.part_fans();
    found.part_edges();
    Some(found)
}

impl Manifold {
    /// Gives every fan but the first of a position a copy of the position.
    fn part_fans(&mut self) {
        let mut has_fan = vec![false; self.places.len()];
        let mut known = vec![false; self.across.len()];
        let mut fan = Vec::new();
        for first in 0..known.len() {
            if known[first] {
                continue;
            }
            // The sides of the fan, which begin at the same position.
            fan.clear();
            let mut side = first;
            while !known[side] {
                known[side] = true;
                fan.push(side);
                side = self.across[around(side, 2)];
            }
            let row = self.triangles.as_flattened()[first];
            if !std::mem::replace(&mut has_fan[row as usize], true) {
                continue;
            }
            let (mut normal, mut length) = (Vec3::ZERO, 0.0);
            for side in &fan {
                let [here, next, last] = self.corners(*side);
                normal += (next - here).cross(last - here);
                length += (next - here).length() / fan.len() as f32;
            }
            let place = self.places[row as usize] - APART * length * normal.normalize_or(Vec3::Y);
            let copy = self.copy(row, place);
            fan.iter().for_each(|side| self.triangles.as_flattened_mut()[*side] = copy);
        }
    }

    /// Splits every edge that still has more than two triangles because the fans at both ends pass it twice. Each
    /// pair of triangles gets its own position in the middle.
    fn part_edges(&mut self) {
        let mut there = HashSet::new();
        let corners = self.triangles.as_flattened();
        let is_again = |side: &usize| {
            let (from, to) = (corners[*side], corners[around(*side, 1)]);
            from < to && !there.insert((from, to))
        };
        let mut again: Vec<usize> = (0..corners.len()).filter(is_again).collect();
        while let Some(side) = again.pop() {
            let pair = [side, self.across[side]];
            let mut normal = Vec3::ZERO;
            for side in pair {
                let [from, to, third] = self.corners(side);
                normal += (to - from).cross(third - from);
            }
            let [from, to, _] = self.corners(side);
            let inwards = APART * (to - from).length() * normal.normalize_or(Vec3::Y);
            let row = self.triangles.as_flattened()[side];
            let middle = self.copy(row, 0.5 * (from + to) - inwards);
            // Both triangles keep the first half of the side; new ones get the second.
            let halves = pair.map(|side| {
                let (half, moved) = (self.across.len(), around(side, 1));
                let corners = self.triangles.as_flattened_mut();
                let (to, third) = (corners[moved], corners[around(side, 2)]);
                corners[moved] = middle;
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

    /// Positions of the corners of the side's triangle, beginning at the side's first corner.
    fn corners(&self, side: usize) -> [Vec3; 3] {
        let rows = self.triangles.as_flattened();
        [0, 1, 2].map(|step| self.places[rows[around(side, step)] as usize])
    }

    /// Adds a copy of the position `row` at `place` and returns its index.
    fn copy(&mut self, row: u32, place: Vec3) -> u32 {
        self.sources.push(self.sources[row as usize]);
        self.places.push(place);
        self.places.len() as u32 - 1
    }

    /// For each triangle the number of its piece, and the number of pieces.
    pub fn pieces(&self) -> (Vec<usize>, usize) {
        let piece = pieces(self.places.len(), self.triangles.iter().map(|triangle| &triangle[..]));
        let count = piece.iter().max().map_or(0, |last| last + 1);
        (piece, count)
    }
}

/// The side `steps` farther around the same triangle.
fn around(side: usize, steps: usize) -> usize {
    side - side % 3 + (side + steps) % 3
}

/// Removes triangles without three distinct corners, and pairs with the same corners in opposite order.
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

/// Computes [`Manifold::across`]; `None` if a side has no partner.
pub fn across(positions: &[Vec3], triangles: &[[u32; 3]]) -> Option<Vec<usize>> {
    // Smaller end, larger end, whether the side runs from the larger end, and the side.
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
        // The sides in counter-clockwise order, as seen from the edge's larger end. A side from the larger end begins
        // a body. A side towards the larger end closes it.
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
        // A body may contain the angle at which the order begins.
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

    /// Triangles that face outwards if (a, b, c) is counter-clockwise as seen from d.
    fn tetrahedron([a, b, c, d]: [u32; 4]) -> [[u32; 3]; 4] {
        [[a, c, b], [a, b, d], [b, c, d], [c, a, d]]
    }

    /// Repairs `triangles` and checks the numbers of pieces and copies.
    fn check(positions: &[Vec3], triangles: &[[u32; 3]], pieces: usize, copies: usize) -> Manifold {
        let found = manifold(positions, triangles.to_vec()).expect("closed");
        assert_eq!((found.pieces().1, found.places.len() - positions.len()), (pieces, copies));
        assert!(is_closed(&found.triangles));
        let corners = found.triangles.as_flattened();
        for (side, other) in found.across.iter().enumerate() {
            let ends = (corners[side], corners[around(side, 1)]);
            assert_eq!(ends, (corners[around(*other, 1)], corners[*other]));
        }
        let (before, after) = (volume(positions, triangles), volume(&found.places, &found.triangles));
        assert!(after > 0.9 * before && after <= before * 1.000_001, "{after} of {before}");
        found
    }

    #[test]
    fn bodies_that_touch_are_cut_apart() {
        // An edge from 0 to 1 with one body on either side, at several angles.
        for turn in 0..12 {
            let turned = |x: f32, y: f32| Vec3::new(x, y, 0.5).rotate_z(0.55 * turn as f32);
            let edge = [Vec3::ZERO, Vec3::Z];
            let ends = [turned(1.0, -0.3), turned(1.0, 0.3), turned(-1.0, 0.3), turned(-1.0, -0.3)];
            let positions = [&edge[..], &ends].concat();
            let (one, other) = (tetrahedron([0, 2, 3, 1]), tetrahedron([0, 4, 5, 1]));
            let found = check(&positions, &[one, other].concat(), 2, 2);
            // The neighbours of a triangle belong to the same body.
            assert!(found.across.iter().enumerate().all(|(side, other)| (side < 12) == (*other < 12)));
            // The second body has the copies, which lie on its side.
            assert_eq!(found.sources[positions.len()..], [0, 1]);
            let copies = &found.places[positions.len()..];
            assert!(copies.iter().all(|place| place.dot(turned(-1.0, 0.0).with_z(0.0)) > 0.001));
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
        // Two cubes touch along an edge between two full layers. Each end of the edge has one fan.
        let (positions, triangles) = cubes(3, |[x, y, z]| x < 2 && z < 2 && (y != 1 || x == z));
        let found = check(&positions, &triangles, 1, 1);
        assert_eq!(found.triangles.len(), triangles.len() + 2);
    }

    #[test]
    fn random_cubes_that_touch_are_parted() {
        for seed in 0..40_u64 {
            let solid = |[x, y, z]: [usize; 3]| {
                let mixed = (seed << 9 | (x + 6 * y + 36 * z) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 32 & 1 == 0
            };
            let (positions, triangles) = cubes(6, solid);
            let found = manifold(&positions, triangles.clone()).expect("closed");
            let copies = found.places.len() - positions.len();
            let found = check(&positions, &triangles, found.pieces().1, copies);
            let again = manifold(&found.places, found.triangles.clone()).expect("closed");
            assert!(again.places == found.places && again.triangles == found.triangles);
            let bits = found.places.iter().map(|p| p.to_array().map(f32::to_bits));
            assert_eq!(bits.collect::<HashSet<[u32; 3]>>().len(), found.places.len());
        }
    }

    #[test]
    fn folds_are_removed_and_open_surfaces_refused() {
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
