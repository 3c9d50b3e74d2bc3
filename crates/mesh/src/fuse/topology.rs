//! Makes one body without narrow tunnels of the parts of a field. Separate parts are joined with the body, such as a foot
//! below a skirt or a hand beyond a cuff. Narrow tunnels through the body are closed, such as a hole between the shells of
//! a shoulder: a dilation fills them; it is thinned from outside inwards, and only the walls across tunnels are kept of it.

use std::collections::VecDeque;
use std::sync::LazyLock;

use glam::I64Vec3;

use super::grid::{Grid, STEPS};

/// Least size of a part, as a share of the body's corners. Smaller pieces are dropped later.
const PART: f64 = 0.002;
/// Largest distance of a part from the body, in cubes.
const FARTHEST: usize = 32;
/// Not reached yet.
const NOWHERE: u32 = u32::MAX;
/// Width of the widest closed tunnel in cubes, 5 cm for a person of 1.7 m.
const WIDEST: f32 = 8.0;

/// Above the squares of all distances up to half of [`WIDEST`].
const FAR: u8 = (0.25 * WIDEST * WIDEST) as u8 + 1;

/// The 14 corners that share an edge with a corner: their offsets, and bit sets of their neighbours among the 14. The
/// edges are the edges of Kuhn's subdivision, in which corners that are neighbours in pairs form a simplex.
static AROUND: LazyLock<[(I64Vec3, u16); 14]> = LazyLock::new(|| {
    let steps = STEPS.map(|step| I64Vec3::from_array(step.map(|s| s as i64)));
    let offsets: Vec<I64Vec3> = steps.into_iter().flat_map(|step| [step, -step]).collect();
    std::array::from_fn(|i| {
        let is_neighbour = |other: &I64Vec3| {
            steps.contains(&(offsets[i] - *other)) || steps.contains(&(*other - offsets[i]))
        };
        let bits = (0..14).filter(|j| is_neighbour(&offsets[*j])).map(|j| 1 << j).sum();
        (offsets[i], bits)
    })
});

/// Whether a subset of the 14 corners is connected.
fn is_connected(corners: u16) -> bool {
    let (mut before, mut reached) = (0, corners & corners.wrapping_neg());
    while reached != before {
        before = reached;
        let next = AROUND.iter().enumerate().filter(|(i, _)| before >> i & 1 == 1);
        reached = next.fold(before, |all, (_, (_, neighbours))| all | (neighbours & corners));
    }
    corners != 0 && reached == corners
}

/// [`is_connected`] of each subset of the 14 corners.
static CONNECTED: LazyLock<Vec<bool>> = LazyLock::new(|| (0..1_u16 << 14).map(is_connected).collect());

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
        let begin = |number: usize, from: &mut [u32], front: &mut VecDeque<(usize, usize)>| {
            for row in (0..from.len()).filter(|row| pieces.of[*row] as usize == number) {
                from[row] = row as u32;
                front.push_back((row, 0));
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

    /// Closes the tunnels through the inside that are narrower than [`WIDEST`].
    pub fn close_tunnels(&mut self) {
        let inside: Vec<bool> = self.values.iter().map(|value| *value < 0.0).collect();
        let distances = self.distances(&inside);
        let is_added = |row: usize| distances[row] < FAR && !inside[row] && !self.on_border(row);

        // Thinning: the farthest added corners are removed first, unless two parts of the outside would meet.
        let steps = AROUND.map(|(offset, _)| self.step(offset));
        let near = |row: usize| steps.map(|step| row.wrapping_add_signed(step));
        let link = |kept: &[bool], row: usize| {
            near(row).iter().enumerate().fold(0_u16, |bits, (i, at)| bits | u16::from(kept[*at]) << i)
        };
        let all = (1 << 14) - 1;
        let added: Vec<usize> = (0..inside.len()).filter(|row| is_added(*row)).collect();
        let mut kept = inside.clone();
        let mut waiting: [VecDeque<usize>; FAR as usize] = Default::default();
        let mut is_waiting = vec![false; inside.len()];
        for row in &added {
            kept[*row] = true;
            is_waiting[*row] = true;
            waiting[distances[*row] as usize].push_back(*row);
        }
        while let Some(row) = waiting.iter_mut().rev().find_map(VecDeque::pop_front) {
            is_waiting[row] = false;
            if CONNECTED[usize::from(!link(&kept, row) & all)] {
                kept[row] = false;
                for at in near(row).into_iter().filter(|at| kept[*at] && is_added(*at)) {
                    if !std::mem::replace(&mut is_waiting[at], true) {
                        waiting[distances[at] as usize].push_back(at);
                    }
                }
            }
        }

        // Walls of one cube would be lost when the surface is reduced. Each side gets one more cube.
        let walls = added.iter().filter(|row| kept[**row]);
        let around: Vec<usize> = walls.flat_map(|row| near(*row)).collect();
        for row in around.into_iter().filter(|row| is_added(*row)) {
            let bits = link(&kept, row);
            if CONNECTED[usize::from(bits)] && CONNECTED[usize::from(!bits & all)] {
                kept[row] = true;
            }
        }
        for row in added.into_iter().filter(|row| kept[*row]) {
            self.values[row] = -0.5 * self.cell;
        }
    }

    /// Difference of indices for this offset.
    fn step(&self, offset: I64Vec3) -> isize {
        let strides = self.strides().map(|stride| stride as i64);
        offset.dot(I64Vec3::from_array(strides)) as isize
    }

    /// Squared distances from the marked corners in cubes; [`FAR`] beyond half of [`WIDEST`].
    fn distances(&self, marked: &[bool]) -> Vec<u8> {
        let reach = 0.5 * WIDEST;
        let side = reach as i64;
        let cube = (-side..=side).flat_map(|z| {
            (-side..=side).flat_map(move |y| (-side..=side).map(move |x| I64Vec3::new(x, y, z)))
        });
        let ball = cube.filter(|offset| offset.as_vec3().length() <= reach);
        let ball = ball.map(|offset| (offset, self.step(offset), offset.length_squared() as u8));
        let ball: Vec<(I64Vec3, isize, u8)> = ball.collect();
        let strides = self.strides();
        let counts = self.counts.as_i64vec3();
        let mut distances: Vec<u8> = marked.iter().map(|marked| if *marked { 0 } else { FAR }).collect();
        for row in (0..marked.len()).filter(|row| marked[*row]) {
            if !self.on_border(row) && strides.iter().all(|step| marked[row - step] && marked[row + step]) {
                continue;
            }
            let at = self.at(row).as_i64vec3();
            let within = (at - side).min_element() >= 0 && (at + side).cmplt(counts).all();
            for (offset, step, distance) in &ball {
                let to = at + *offset;
                if within || (to.min_element() >= 0 && to.cmplt(counts).all()) {
                    let found = &mut distances[row.wrapping_add_signed(*step)];
                    *found = (*found).min(*distance);
                }
            }
        }
        distances
    }
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};

    use super::*;
    use crate::fuse::grid::tests::{grid, is_closed, volume};

    /// Number of handles of the surface, and its volume.
    fn handles(grid: &Grid) -> (i64, f64) {
        let (positions, faces) = grid.surface();
        assert!(is_closed(&faces));
        (1 - (positions.len() as i64 - faces.len() as i64 / 2) / 2, volume(&positions, &faces))
    }

    #[test]
    fn narrow_tunnels_are_closed_by_walls_and_wide_ones_stay() {
        let cell = 2.0 / 80.0;
        // A plate of this half thickness with round holes of these radii in cubes.
        let plate_of = |thickness: f32, radii: &[f32]| {
            grid(81, |p| {
                let plate = ((p.abs() - Vec3::new(0.8, 0.8, thickness * cell)) / cell).max_element();
                let holes = radii.iter().enumerate().map(|(i, radius)| {
                    let middle = Vec2::new(-0.5 + 0.5 * i as f32, 0.1);
                    radius - p.truncate().distance(middle) / cell
                });
                cell * holes.fold(plate, f32::max)
            })
        };
        let plate = |radii: &[f32]| plate_of(8.0, radii);
        let mut narrow = plate(&[1.2, 2.0]);
        let before = handles(&narrow);
        narrow.close_tunnels();
        let after = handles(&narrow);
        assert_eq!((before.0, after.0), (2, 0));
        // Walls are thin.
        let whole = handles(&plate(&[])).1;
        assert!(after.1 < before.1 + 0.5 * (whole - before.1));
        // A ball that touches the edge of a hole in a thin plate does not reach into the hole.
        let mut thin = plate_of(1.1, &[2.0, 3.0]);
        thin.close_tunnels();
        assert_eq!(handles(&thin).0, 0);
        let mut wide = plate(&[6.0, 8.0]);
        let values = wide.values.clone();
        wide.close_tunnels();
        assert_eq!(handles(&wide).0, 2);
        assert_eq!(wide.values, values);
        let mut both = plate(&[6.0, 2.0]);
        both.close_tunnels();
        assert_eq!(handles(&both).0, 1);
    }

    #[test]
    fn gaps_between_limbs_stay_open() {
        // Two limbs that come close to each other at two places, and a body that joins them above.
        let mut scene = grid(81, |p| {
            let limb = |side: f32| {
                let middle = side * (0.2 + 0.05 * (9.0 * p.y).cos());
                Vec2::new(p.x - middle, p.z).length() - 0.13
            };
            let body = (p - Vec3::new(0.0, 0.7, 0.0)).length() - 0.25;
            limb(-1.0).min(limb(1.0)).min(body).max(p.y.abs() - 0.8)
        });
        let values = scene.values.clone();
        assert_eq!(handles(&scene).0, 0);
        scene.close_tunnels();
        assert_eq!(scene.values, values);
    }

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
        assert_eq!((grid.join_parts(), grid.keep_one_body().0), (0, 1));
        // One foot 20 cubes below the body, the other 20 cubes beside the first.
        let (one, other) = (Vec3::new(0.0, -0.8, 0.0), Vec3::new(0.7, -0.8, 0.0));
        let mut grid = scene(&[one, other]);
        assert_eq!((grid.join_parts(), grid.keep_one_body().0), (2, 1));
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
