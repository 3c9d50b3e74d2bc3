//! Exact nearest neighbours for millions of queries at a time, for any geometry.
//!
//! A k-d tree prunes by the distance to a *splitting plane*. That bound is useless for queries that are far from all points,
//! and with random weights every side point is: kiddo 6.3 takes 17 s and more where this tree takes 0.1 s (docs/notes/inference.md).
//!
//! * Points lie in a binary tree of tight boxes; its leaves are [`LANES`] points side by side.
//! * Queries are sorted into the same order, so that [`LANES`] neighbours in space descend the tree together. A box is entered
//!   if *any* of them may find a nearer point in it, judged by its own best distance.
//!
//! # What "nearest" means
//!
//! The row that minimises the f32 value `(dx² + dy²) + dz²`, every operation rounded, none fused, hence the same on
//! every machine; among equal values the smallest row. Distances that overflow are equal. The answer does not depend on
//! the shape of the tree, the order of the queries or the number of threads.
//!
//! # Why pruning keeps that exact
//!
//! For a point p of a box, |p − q| along an axis is at least g = max(low − q, q − high, 0). Rounding is monotone, so
//! the same holds after rounding the differences, their squares and the sums, if both sides do the same operations
//! in the same order: the rounded bound never exceeds the rounded distance. A box whose bound *equals* the best
//! distance may hold an equal with a smaller row; every box has its smallest row.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Points of a leaf and queries of a packet: two registers of AVX-512, four of AVX2. With 16, every query costs up to
/// twice the visits; more lanes do needless work on surfaces.
const LANES: usize = 32;
type Lanes = [f32; LANES];

/// Packets per task: enough to pay for the task, little enough to share them out.
const PACKETS: usize = 64;

/// Points that one thread orders alone: handing over fewer costs more than it saves.
const ALONE: usize = 8192;

/// Finite points, ordered for searches.
pub struct Neighbours {
    leaves: Vec<Leaf>,
    /// Parent before children, left subtree before right: a node over `n` leaves has its children at +1 and at
    /// +2·⌈n/2⌉, and nothing needs to be stored to find them.
    boxes: Vec<Bounds>,
}

/// `LANES` points, rows ascending; the last leaf repeats its first point.
struct Leaf {
    at: [Lanes; 3],
    rows: [u32; LANES],
}

/// Box along the axes.
#[derive(Clone, Copy)]
struct Bounds {
    low: [f32; 3],
    high: [f32; 3],
    /// Smallest row of its points.
    first_row: u32,
}

/// A point and its row among those given.
#[derive(Clone, Copy)]
struct Placed {
    at: [f32; 3],
    row: u32,
}

/// Cost of a search; the same for any number of threads.
#[derive(Debug, Clone, Copy, Default)]
struct Work {
    /// Boxes tested, per packet.
    boxes: u64,
    /// Leaves entered: `LANES²` distances each.
    leaves: u64,
}

impl Neighbours {
    /// Orders the finite points; `None` without any. Rows count all points that are given.
    ///
    /// # Panics
    /// With more points than `u32` can number.
    pub fn new(points: &[[f32; 3]]) -> Option<Self> {
        let placed = arranged(points);
        if placed.is_empty() {
            return None;
        }
        let leaves: Vec<Leaf> = placed.par_chunks(LANES).map(Leaf::new).collect();
        let mut boxes = vec![Bounds::NOTHING; 2 * leaves.len() - 1];
        enclose(&leaves, &mut boxes);
        Some(Self { leaves, boxes })
    }

    /// Row of the nearest point for each query, on all cores; 0 for a query that is not finite.
    pub fn nearest(&self, queries: &[[f32; 3]]) -> Vec<u32> {
        self.search(queries).0
    }

    fn search(&self, queries: &[[f32; 3]]) -> (Vec<u32>, Work) {
        const TASK: usize = LANES * PACKETS;
        let placed = arranged(queries);
        let mut found = vec![0; placed.len()];
        let arch = Arch::new();
        let tasks = placed.par_chunks(TASK).zip(found.par_chunks_mut(TASK));
        let work = tasks
            .map(|(queries, found)| arch.dispatch(Task { tree: self, queries, found }))
            .reduce(Work::default, |a, b| Work { boxes: a.boxes + b.boxes, leaves: a.leaves + b.leaves });
        let mut rows = vec![0; queries.len()];
        for (query, found) in placed.iter().zip(found) {
            rows[query.row as usize] = found;
        }
        (rows, work)
    }
}

/// The finite ones among `points`, so that each run of `LANES` is near in space and so is each run of runs.
fn arranged(points: &[[f32; 3]]) -> Vec<Placed> {
    assert!(u32::try_from(points.len()).is_ok(), "more points than u32 can number");
    let all = points.iter().zip(0..).map(|(&at, row)| Placed { at, row });
    let mut placed: Vec<Placed> = all.filter(|p| p.at.iter().all(|v| v.is_finite())).collect();
    arrange(&mut placed);
    placed
}

/// Halves at the median of the longest axis until a run is left.
///
/// Cells of equal size would be faster to sort into, but a cluster of half the points could fall into one of them.
fn arrange(points: &mut [Placed]) {
    let runs = points.len().div_ceil(LANES);
    if runs <= 1 {
        return;
    }
    let middle = left_of(runs) * LANES;
    let bounds = points
        .iter()
        .fold(Bounds::NOTHING, |b, p| b.with(&Bounds { low: p.at, high: p.at, first_row: p.row }));
    let widths: [f32; 3] = std::array::from_fn(|k| bounds.high[k] - bounds.low[k]);
    let axis = (0..3).fold(0, |best, k| if widths[k] > widths[best] { k } else { best });
    if widths[axis] > 0.0 {
        points.select_nth_unstable_by(middle, |a, b| a.at[axis].total_cmp(&b.at[axis]));
    }
    let alone = points.len() <= ALONE;
    let (left, right) = points.split_at_mut(middle);
    if alone {
        arrange(left);
        arrange(right);
    } else {
        rayon::join(|| arrange(left), || arrange(right));
    }
}

/// Leaves in the left half of a node over `count` leaves.
#[inline(always)]
fn left_of(count: usize) -> usize {
    count.div_ceil(2)
}

/// Boxes of all nodes over `leaves`, in the order of [`Neighbours::boxes`].
fn enclose(leaves: &[Leaf], boxes: &mut [Bounds]) {
    if let [leaf] = leaves {
        boxes[0] = leaf.bounds();
        return;
    }
    let left = left_of(leaves.len());
    let (top, below) = boxes.split_at_mut(1);
    let (low, high) = below.split_at_mut(2 * left - 1);
    enclose(&leaves[..left], low);
    enclose(&leaves[left..], high);
    top[0] = low[0].with(&high[0]);
}

impl Leaf {
    fn new(points: &[Placed]) -> Self {
        let mut full = [points[0]; LANES];
        full[..points.len()].copy_from_slice(points);
        full.sort_unstable_by_key(|p| p.row);
        Self { at: [0, 1, 2].map(|k| full.map(|p| p.at[k])), rows: full.map(|p| p.row) }
    }

    fn bounds(&self) -> Bounds {
        let low = self.at.map(|axis| axis.into_iter().fold(f32::INFINITY, f32::min));
        let high = self.at.map(|axis| axis.into_iter().fold(f32::NEG_INFINITY, f32::max));
        Bounds { low, high, first_row: self.rows[0] }
    }
}

impl Bounds {
    const NOTHING: Self = Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3], first_row: u32::MAX };

    #[inline(always)]
    fn with(&self, other: &Self) -> Self {
        Self {
            low: std::array::from_fn(|k| self.low[k].min(other.low[k])),
            high: std::array::from_fn(|k| self.high[k].max(other.high[k])),
            first_row: self.first_row.min(other.first_row),
        }
    }

    /// No more than the squared distance from `q` to any point inside, rounding included.
    #[inline(always)]
    fn lower_bound(&self, q: [f32; 3]) -> f32 {
        let square = |k: usize| {
            let gap = larger(larger(self.low[k] - q[k], q[k] - self.high[k]), 0.0);
            gap * gap
        };
        (square(0) + square(1)) + square(2)
    }
}

/// `f32::max` without its care for NaN, which costs two more instructions.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// `LANES` queries on their way through the tree; the last packet repeats its last query.
#[repr(align(64))]
struct Packet {
    at: [Lanes; 3],
    /// Squared distance to the nearest point so far; infinity and row 0 are right where all distances overflow.
    best: Lanes,
    rows: [u32; LANES],
}

impl Packet {
    #[inline(always)]
    fn new(queries: &[Placed]) -> Self {
        let full: [[f32; 3]; LANES] = std::array::from_fn(|i| queries[i.min(queries.len() - 1)].at);
        Self { at: [0, 1, 2].map(|k| full.map(|q| q[k])), best: [f32::INFINITY; LANES], rows: [0; LANES] }
    }

    #[inline(always)]
    fn query(&self, i: usize) -> [f32; 3] {
        [self.at[0][i], self.at[1][i], self.at[2][i]]
    }

    /// Whether a box may hold a nearer point for any query.
    #[inline(always)]
    fn may_gain(&self, bounds: &Bounds) -> bool {
        let mut any = false;
        for i in 0..LANES {
            let least = bounds.lower_bound(self.query(i));
            any |= (least < self.best[i]) | ((least == self.best[i]) & (bounds.first_row < self.rows[i]));
        }
        any
    }

    /// Compares all queries with all points of `leaf`; whether any query gained.
    ///
    /// Written with registers in hand: the compiler would carry the best distances through memory.
    #[inline(always)]
    fn visit<S: Simd>(&mut self, simd: S, leaf: &Leaf) -> bool {
        let [xs, ys, zs] = self.at.each_ref().map(|axis| S::as_simd_f32s(axis).0);
        let (bests, rows) = (S::as_mut_simd_f32s(&mut self.best).0, S::as_mut_simd_u32s(&mut self.rows).0);
        let mut any = false;
        for ((((&x, &y), &z), best), row) in xs.iter().zip(ys).zip(zs).zip(bests).zip(rows) {
            let mut leaf_best = simd.splat_f32s(f32::INFINITY);
            let mut leaf_row = simd.splat_u32s(leaf.rows[0]);
            for i in 0..LANES {
                let square = |q: S::f32s, p: f32| {
                    let d = simd.sub_f32s(q, simd.splat_f32s(p));
                    simd.mul_f32s(d, d)
                };
                let plane = simd.add_f32s(square(x, leaf.at[0][i]), square(y, leaf.at[1][i]));
                let distance = simd.add_f32s(plane, square(z, leaf.at[2][i]));
                // Rows ascend, so the first of equals stays.
                let closer = simd.less_than_f32s(distance, leaf_best);
                leaf_best = simd.select_f32s(closer, distance, leaf_best);
                leaf_row = simd.select_u32s(closer, simd.splat_u32s(leaf.rows[i]), leaf_row);
            }
            let tie = simd.and_m32s(simd.equal_f32s(leaf_best, *best), simd.less_than_u32s(leaf_row, *row));
            let gain = simd.or_m32s(simd.less_than_f32s(leaf_best, *best), tie);
            *best = simd.select_f32s(gain, leaf_best, *best);
            *row = simd.select_u32s(gain, leaf_row, *row);
            any |= simd.first_true_m32s(gain) < S::F32_LANES;
        }
        any
    }
}

/// A run of packets, one after the other.
struct Task<'a> {
    tree: &'a Neighbours,
    queries: &'a [Placed],
    /// Rows of the nearest points.
    found: &'a mut [u32],
}

/// A node by its place in the tree: its number, its first leaf, its leaves.
#[derive(Clone, Copy)]
struct Node {
    number: usize,
    first: usize,
    count: usize,
}

impl Node {
    #[inline(always)]
    fn children(self) -> [Self; 2] {
        let left = left_of(self.count);
        [
            Self { number: self.number + 1, first: self.first, count: left },
            Self { number: self.number + 2 * left, first: self.first + left, count: self.count - left },
        ]
    }
}

impl WithSimd for Task<'_> {
    type Output = Work;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Work {
        let mut work = Work::default();
        let mut stack = Vec::with_capacity(64);
        // Where the packet before gained last is a good place to begin.
        let mut start = 0;
        let mut before: Option<Packet> = None;
        for (queries, found) in self.queries.chunks(LANES).zip(self.found.chunks_mut(LANES)) {
            let mut packet = Packet::new(queries);
            match &before {
                Some(before) if before.at == packet.at => packet.rows = before.rows,
                _ => start = self.tree.descend(simd, &mut packet, start, &mut stack, &mut work),
            }
            found.copy_from_slice(&packet.rows[..found.len()]);
            before = Some(packet);
        }
        work
    }
}

impl Neighbours {
    /// Finds the nearest points of a packet, nearer children first; the leaf where it gained last.
    #[inline(always)]
    fn descend<S: Simd>(
        &self,
        simd: S,
        packet: &mut Packet,
        start: usize,
        stack: &mut Vec<Node>,
        work: &mut Work,
    ) -> usize {
        let (mut gained, mut entered) = (start, 1);
        packet.visit(simd, &self.leaves[start]);
        let middle = packet.query(LANES / 2);
        stack.push(Node { number: 0, first: 0, count: self.leaves.len() });
        while let Some(node) = stack.pop() {
            work.boxes += 1;
            if !packet.may_gain(&self.boxes[node.number]) {
                continue;
            }
            if node.count > 1 {
                let children = node.children();
                let [left, right] = children.map(|child| {
                    let bounds = &self.boxes[child.number];
                    (bounds.lower_bound(middle), bounds.first_row)
                });
                // The last one pushed comes first.
                stack.extend(if left < right { [children[1], children[0]] } else { children });
            } else if node.first != start {
                entered += 1;
                if packet.visit(simd, &self.leaves[node.first]) {
                    gained = node.first;
                }
            }
        }
        work.leaves += entered;
        gained
    }
}

#[cfg(test)]
mod tests;
