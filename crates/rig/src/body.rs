//! The inside of a person's closed mesh, in the cells of a grid.

use std::collections::HashSet;

use glam::{IVec3, Vec3};
use snapsnap_mesh::mesh::Mesh;

/// Cells along the longest side of the body's box.
const CELLS: f32 = 180.0;
/// Cells around the body, at which Gaussians may lie.
const BORDER: i32 = 3;

/// A grid around a body. Cells are numbered with x first.
#[derive(Debug, Clone, Copy)]
pub struct Grid {
    /// Centre of the first cell, and edge of a cell, metres.
    pub origin: Vec3,
    pub cell: f32,
    pub counts: IVec3,
}

/// The cells inside of a body.
pub struct Body {
    pub grid: Grid,
    pub inside: Vec<usize>,
}

impl Grid {
    pub fn index(&self, at: IVec3) -> usize {
        ((at.z * self.counts.y + at.y) * self.counts.x + at.x) as usize
    }

    pub fn place(&self, cell: usize) -> IVec3 {
        let (cell, IVec3 { x, y, .. }) = (cell as i32, self.counts);
        IVec3::new(cell % x, cell / x % y, cell / (x * y))
    }

    /// The middle of a cell.
    pub fn centre(&self, cell: usize) -> Vec3 {
        self.origin + self.cell * self.place(cell).as_vec3()
    }

    /// The cell that contains a place.
    pub fn containing(&self, place: Vec3) -> IVec3 {
        ((place - self.origin) / self.cell).round().as_ivec3().clamp(IVec3::ZERO, self.counts - 1)
    }

    /// Cells whose centres are inside of the mesh: along z, the inside lies between the first and the second triangle, and
    /// so on.
    fn inside(&self, mesh: &Mesh) -> Vec<usize> {
        // Off the middle, so that no line meets an edge of triangles between cells.
        let shift = Vec3::new(1.3e-3, 2.9e-3, 0.0);
        let mut crossings = vec![Vec::new(); (self.counts.x * self.counts.y) as usize];
        for face in &mesh.faces {
            let corner = |row: u32| (mesh.positions[row as usize] - self.origin) / self.cell - shift;
            let [a, b, c] = face.positions.map(corner);
            let [low, high] = [a.min(b).min(c).ceil().as_ivec3(), a.max(b).max(c).floor().as_ivec3()];
            let (u, v) = (b - a, c - a);
            let area = u.x * v.y - u.y * v.x;
            for (x, y) in (low.y..=high.y).flat_map(|y| (low.x..=high.x).map(move |x| (x, y))) {
                let d = Vec3::new(x as f32, y as f32, 0.0) - a;
                let (s, t) = ((d.x * v.y - d.y * v.x) / area, (u.x * d.y - u.y * d.x) / area);
                if s >= 0.0 && t >= 0.0 && s + t <= 1.0 {
                    crossings[(y * self.counts.x + x) as usize].push(a.z + s * u.z + t * v.z);
                }
            }
        }
        let column = |(column, mut depths): (usize, Vec<f32>)| {
            depths.sort_by(f32::total_cmp);
            let cells = depths
                .as_chunks::<2>()
                .0
                .iter()
                .flat_map(|[from, to]| from.ceil() as i32..=to.floor() as i32);
            let sheet = (self.counts.x * self.counts.y) as usize;
            cells.map(move |z| z as usize * sheet + column).collect::<Vec<_>>()
        };
        crossings.into_iter().enumerate().flat_map(column).collect()
    }
}

impl Body {
    /// The inside of a closed mesh.
    pub fn new(mesh: &Mesh) -> Self {
        let (low, high) = mesh.bounds();
        let cell = (high - low).max_element() / CELLS;
        let origin = low - BORDER as f32 * cell;
        let counts = ((high - low) / cell).ceil().as_ivec3() + 2 * BORDER;
        let grid = Grid { origin, cell, counts };
        Self { inside: grid.inside(mesh), grid }
    }

    /// The middle of the limb that leads `along` at a place: the mean of its cross-section. `None` if there is no limb of
    /// at most this radius, metres: outside, or where the limb touches the body.
    pub fn middle(&self, at: Vec3, along: Vec3, radius: f32) -> Option<Vec3> {
        let offset = |cell: &usize| self.grid.centre(*cell) - at;
        let is_near = |cell: &usize| {
            offset(cell).dot(along).abs() <= self.grid.cell && offset(cell).length() <= 2.0 * radius
        };
        // In the order of the cells, so that the first of several nearest ones is always the same.
        let near: Vec<usize> = self.inside.iter().copied().filter(is_near).collect();
        let nearest = |a: &&usize, b: &&usize| offset(a).length().total_cmp(&offset(b).length());
        let first = *near.iter().min_by(nearest).filter(|cell| offset(cell).length() <= radius)?;
        let mut left: HashSet<usize> = near.into_iter().filter(|cell| *cell != first).collect();
        let mut section = vec![first];
        let mut seen = 0;
        while let Some(cell) = section.get(seen) {
            let place = self.grid.place(*cell);
            seen += 1;
            section.extend(
                around().map(|(step, _)| self.grid.index(place + step)).filter(|next| left.remove(next)),
            );
        }
        let middle = section.iter().map(|cell| self.grid.centre(*cell)).sum::<Vec3>() / section.len() as f32;
        let is_limb = section.iter().all(|cell| self.grid.centre(*cell).distance(middle) <= radius);
        // Only across: the landmark tells the place along the limb.
        is_limb.then(|| at + (middle - at).reject_from_normalized(along))
    }
}

/// Steps to the 26 neighbours of a cell, with their lengths in cells.
pub fn around() -> impl Iterator<Item = (IVec3, f32)> {
    let steps = (-1..=1).flat_map(|z| (-1..=1).flat_map(move |y| (-1..=1).map(move |x| IVec3::new(x, y, z))));
    steps.filter(|step| *step != IVec3::ZERO).map(|step| (step, step.as_vec3().length()))
}
