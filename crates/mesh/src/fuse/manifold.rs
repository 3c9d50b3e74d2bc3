//! Closed surfaces again out of triangles some of whose edges fell onto one another.

use std::collections::HashMap;

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
    let mut triangles = unfolded(triangles);
    let across = across(positions, &triangles)?;
    let corner = |side: usize| (side / 3, side % 3);
    let mut has_fan = vec![false; positions.len()];
    let mut known = vec![false; across.len()];
    let mut copies: Vec<(u32, Vec3)> = Vec::new();
    let mut fan = Vec::new();
    for first in 0..across.len() {
        if known[first] {
            continue;
        }
        // Around the position that the side begins with.
        fan.clear();
        let mut side = first;
        while !known[side] {
            known[side] = true;
            fan.push(side);
            side = across[side - side % 3 + (side + 2) % 3];
        }
        let (face, at) = corner(first);
        let row = triangles[face][at];
        if !std::mem::replace(&mut has_fan[row as usize], true) {
            continue;
        }
        let (mut normal, mut length) = (Vec3::ZERO, 0.0);
        for (face, at) in fan.iter().map(|side| corner(*side)) {
            let place = |step: usize| {
                let row = triangles[face][(at + step) % 3] as usize;
                if row < positions.len() { positions[row] } else { copies[row - positions.len()].1 }
            };
            let (next, last) = (place(1) - place(0), place(2) - place(0));
            normal += next.cross(last);
            length += next.length() / fan.len() as f32;
        }
        let copy = (positions.len() + copies.len()) as u32;
        fan.iter().map(|side| corner(*side)).for_each(|(face, at)| triangles[face][at] = copy);
        copies.push((row, positions[row as usize] - APART * length * normal.normalize_or(Vec3::Y)));
    }
    Some(Manifold { triangles, copies, across })
}

impl Manifold {
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

/// Without triangles that have less than three corners, and pairs of the same corners in opposite orders.
fn unfolded(mut triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    let mut there: HashMap<[u32; 3], Vec<usize>> = HashMap::new();
    let mut kept = vec![true; triangles.len()];
    for (face, &[a, b, c]) in triangles.iter().enumerate() {
        let least = a.min(b).min(c);
        let key = if least == a {
            [a, b, c]
        } else if least == b {
            [b, c, a]
        } else {
            [c, a, b]
        };
        if a == b || b == c || c == a {
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
