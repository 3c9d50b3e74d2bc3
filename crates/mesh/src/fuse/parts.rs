//! Joins separate parts with the body, such as a foot below a skirt or a hand beyond a cuff.

use std::collections::{HashMap, VecDeque};

use super::grid::Grid;

/// Least size of a part, as a share of the body's corners. Smaller pieces are dropped later.
const PART: f64 = 0.002;
/// Largest distance of a part from the body, in cubes.
const FARTHEST: usize = 32;
/// Not reached yet.
const NOWHERE: u32 = u32::MAX;

impl Grid {
    /// Joins parts with the body by the shortest paths through the outside, three cubes thick. Returns the part count.
    pub fn join_parts(&mut self) -> usize {
        let pieces = self.pieces();
        let Some(body) = pieces.body() else { return 0 };
        let least = PART * pieces.sizes[body] as f64;
        let is_part = |i: usize| pieces.inside[i] && i != body && pieces.sizes[i] as f64 >= least;
        let mut waits: Vec<bool> = (0..pieces.sizes.len()).map(is_part).collect();
        if !waits.contains(&true) {
            return 0;
        }
        let steps = self.strides();
        // Breadth-first search: the predecessor of every corner on the path from the body.
        let mut from = vec![NOWHERE; pieces.of.len()];
        let mut front = VecDeque::new();
        let mut rows: HashMap<usize, Vec<usize>> = HashMap::new();
        for (row, number) in pieces.of.iter().map(|number| *number as usize).enumerate() {
            if waits[number] || number == body {
                rows.entry(number).or_default().push(row);
            }
        }
        let begin = |number: usize, from: &mut [u32], front: &mut VecDeque<(usize, usize)>| {
            for row in &rows[&number] {
                from[*row] = *row as u32;
                front.push_back((*row, 0));
            }
        };
        begin(body, &mut from, &mut front);
        let (mut joined, mut ways) = (0, Vec::new());
        while let Some((row, far)) = front.pop_front() {
            if far > FARTHEST || self.on_border(row) {
                continue;
            }
            for next in steps.iter().flat_map(|step| [row - step, row + step]) {
                if from[next] != NOWHERE {
                    continue;
                }
                from[next] = row as u32;
                let number = pieces.of[next] as usize;
                if !waits[number] {
                    front.push_back((next, far + 1));
                    continue;
                }
                waits[number] = false;
                joined += 1;
                let mut back = row;
                while from[back] as usize != back {
                    ways.push(back);
                    back = from[back] as usize;
                }
                // Further parts may be joined with this one.
                begin(number, &mut from, &mut front);
            }
        }
        for row in ways {
            for at in self.around_corner(row, 1) {
                self.values[at] = self.values[at].min(-0.5 * self.cell);
            }
        }
        joined
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use crate::fuse::grid::tests::grid;

    #[test]
    fn a_foot_is_joined_with_the_body_and_a_speck_is_not() {
        const N: usize = 81;
        let ball = |p: Vec3, centre: Vec3, radius: f32| (p - centre).length() - radius;
        let cell = 2.0 / (N - 1) as f32;
        let scene = |feet: &[Vec3]| {
            grid(N, |p| {
                let body = ball(p, Vec3::new(0.0, 0.3, 0.0), 0.5);
                let speck = ball(p, Vec3::new(0.7, 0.7, 0.7), 0.04);
                let feet = feet.iter().map(|foot| ball(p, *foot, 0.1)).fold(f32::MAX, f32::min);
                body.min(speck).min(feet)
            })
        };
        let mut grid = scene(&[]);
        assert_eq!((grid.join_parts(), grid.keep_one_body().dropped), (0, 1));
        // One foot 20 cubes below the body, the other 20 cubes beside the first.
        let (one, other) = (Vec3::new(0.0, -0.8, 0.0), Vec3::new(0.7, -0.8, 0.0));
        let mut grid = scene(&[one, other]);
        assert_eq!((grid.join_parts(), grid.keep_one_body().dropped), (2, 1));
        let inside = |place: Vec3, within: f32| {
            (0..grid.values.len())
                .any(|row| grid.values[row] < 0.0 && grid.place(row).distance(place) < within)
        };
        assert!(inside(one, cell) && inside(other, cell));
        // Several paths are equally short.
        assert!(
            inside(Vec3::new(0.0, -0.45, 0.0), 4.0 * cell) && inside(Vec3::new(0.35, -0.8, 0.0), 4.0 * cell)
        );
        assert!(!inside(Vec3::new(0.35, -0.45, 0.0), 4.0 * cell));
    }
}
