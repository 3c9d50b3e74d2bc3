//! Pieces of a body's surface, which can be subdivided and cut.

use std::collections::HashMap;

use glam::Vec3;

use crate::synth::part::Kind;

/// Parts of the body that a vertex may belong to.
pub const PARTS: usize = 10;
/// Kinds and sides of the parts of [`Vertex::parts`].
pub const ORDER: [(Kind, usize); PARTS] = [
    (Kind::Trunk, 0),
    (Kind::Head, 0),
    (Kind::Arm, 0),
    (Kind::Arm, 1),
    (Kind::Hand, 0),
    (Kind::Hand, 1),
    (Kind::Leg, 0),
    (Kind::Leg, 1),
    (Kind::Foot, 0),
    (Kind::Foot, 1),
];
/// Index of the head in [`ORDER`].
pub const HEAD: usize = 1;

/// A vertex in the resting pose and in the pose.
#[derive(Debug, Clone, Copy)]
pub struct Vertex {
    pub rest: Vec3,
    pub posed: Vec3,
    /// Share of each part.
    pub parts: [f32; PARTS],
}

impl Vertex {
    /// The mean of vertices with weights that add up to 1.
    fn mean(vertices: impl IntoIterator<Item = (f32, Self)>) -> Self {
        let zero = Self { rest: Vec3::ZERO, posed: Vec3::ZERO, parts: [0.0; PARTS] };
        vertices.into_iter().fold(zero, |sum, (share, vertex)| Self {
            rest: sum.rest + share * vertex.rest,
            posed: sum.posed + share * vertex.posed,
            parts: std::array::from_fn(|i| sum.parts[i] + share * vertex.parts[i]),
        })
    }

    /// The part with the largest share.
    pub fn part(&self) -> usize {
        (1..PARTS).fold(0, |best, part| if self.parts[part] > self.parts[best] { part } else { best })
    }
}

/// A piece of surface; faces have three or four corners.
#[derive(Debug, Clone, Default)]
pub struct Patch {
    pub vertices: Vec<Vertex>,
    pub faces: Vec<Vec<u32>>,
}

impl Patch {
    /// The faces of a group, with only the vertices that they use.
    pub fn of(vertices: &[Vertex], faces: &[[u32; 4]]) -> Self {
        let mut rows = HashMap::new();
        let mut patch = Self::default();
        for face in faces {
            let corners = if face[3] == face[2] { &face[..3] } else { &face[..] };
            let row = |row: &u32| *rows.entry(*row).or_insert_with(|| patch.add(vertices[*row as usize]));
            let face = corners.iter().map(row).collect();
            patch.faces.push(face);
        }
        patch
    }

    /// Adds a vertex and returns its index.
    fn add(&mut self, vertex: Vertex) -> u32 {
        self.vertices.push(vertex);
        self.vertices.len() as u32 - 1
    }

    /// The faces, split into triangles.
    pub fn triangles(&self) -> impl Iterator<Item = [u32; 3]> {
        self.faces.iter().flat_map(|face| (1..face.len() - 1).map(move |i| [face[0], face[i], face[i + 1]]))
    }

    /// After this number of [subdivisions](Self::subdivide).
    pub fn subdivided(self, steps: usize) -> Self {
        (0..steps).fold(self, |patch, _| patch.subdivide())
    }

    /// One step of Catmull and Clark's subdivision; borders become smooth curves.
    pub fn subdivide(&self) -> Self {
        let count = self.vertices.len();
        let middle_of = |face: &Vec<u32>| {
            let share = 1.0 / face.len() as f32;
            Vertex::mean(face.iter().map(|row| (share, self.vertices[*row as usize])))
        };
        let middles: Vec<Vertex> = self.faces.iter().map(middle_of).collect();
        // Edge numbers by ends; ends and faces of each edge; edges and faces of each vertex.
        let mut rows: HashMap<(u32, u32), usize> = HashMap::new();
        let mut edges: Vec<((u32, u32), Vec<usize>)> = Vec::new();
        let mut around: Vec<Vec<usize>> = vec![Vec::new(); count];
        let mut touching: Vec<Vec<usize>> = vec![Vec::new(); count];
        for (index, face) in self.faces.iter().enumerate() {
            for (corner, a) in face.iter().enumerate() {
                let b = face[(corner + 1) % face.len()];
                let key = (*a.min(&b), *a.max(&b));
                let row = *rows.entry(key).or_insert_with(|| {
                    around[*a as usize].push(edges.len());
                    around[b as usize].push(edges.len());
                    edges.push((key, Vec::new()));
                    edges.len() - 1
                });
                edges[row].1.push(index);
                touching[*a as usize].push(index);
            }
        }
        let vertex = |row: u32| self.vertices[row as usize];
        let middle = |edge: usize| {
            let (a, b) = edges[edge].0;
            Vertex::mean([(0.5, vertex(a)), (0.5, vertex(b))])
        };
        // Old vertices, then face points, then edge points.
        let mut vertices = Vec::with_capacity(4 * count);
        for (row, old) in self.vertices.iter().copied().enumerate() {
            let border: Vec<usize> =
                around[row].iter().copied().filter(|edge| edges[*edge].1.len() != 2).collect();
            let n = touching[row].len() as f32;
            vertices.push(match border.len() {
                0 if around[row].len() == touching[row].len() => {
                    let faces = touching[row].iter().map(|face| (1.0 / (n * n), middles[*face]));
                    let edges = around[row].iter().map(|edge| (2.0 / (n * n), middle(*edge)));
                    Vertex::mean(faces.chain(edges).chain([((n - 3.0) / n, old)]))
                }
                2 => Vertex::mean([(0.5, old), (0.25, middle(border[0])), (0.25, middle(border[1]))]),
                // Pieces touch in a single vertex.
                _ => old,
            });
        }
        vertices.extend(&middles);
        for (edge, (_, faces)) in edges.iter().enumerate() {
            vertices.push(match faces[..] {
                [a, b] => Vertex::mean([(0.5, middle(edge)), (0.25, middles[a]), (0.25, middles[b])]),
                _ => middle(edge),
            });
        }
        let mut faces = Vec::with_capacity(4 * self.faces.len());
        let edge = |a: u32, b: u32| (count + self.faces.len() + rows[&(a.min(b), a.max(b))]) as u32;
        for (index, face) in self.faces.iter().enumerate() {
            for (corner, row) in face.iter().enumerate() {
                let (before, after) =
                    (face[(corner + face.len() - 1) % face.len()], face[(corner + 1) % face.len()]);
                faces.push(vec![*row, edge(*row, after), (count + index) as u32, edge(before, *row)]);
            }
        }
        Self { vertices, faces }
    }

    /// Smooth normals of the posed surface.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.vertices.len()];
        for face in &self.faces {
            let at = |i: usize| self.vertices[face[i] as usize].posed;
            let last = face.len() - 1;
            let normal = (at(2) - at(0)).cross(at(last) - at(1));
            face.iter().for_each(|row| normals[*row as usize] += normal);
        }
        normals.into_iter().map(Vec3::normalize_or_zero).collect()
    }

    /// The region where `inside` is positive, as triangles; triangles across its border are cut.
    pub fn cut(&self, inside: impl Fn(&Vertex) -> f32) -> Self {
        let values: Vec<f32> = self.vertices.iter().map(inside).collect();
        let mut patch = Self::default();
        let mut kept: HashMap<u32, u32> = HashMap::new();
        let mut cuts: HashMap<(u32, u32), u32> = HashMap::new();
        for [a, b, c] in self.triangles() {
            let mut polygon: Vec<u32> = Vec::with_capacity(4);
            for (a, b) in [(a, b), (b, c), (c, a)] {
                let (fa, fb) = (values[a as usize], values[b as usize]);
                if fa > 0.0 {
                    polygon.push(*kept.entry(a).or_insert_with(|| patch.add(self.vertices[a as usize])));
                }
                if (fa > 0.0) != (fb > 0.0) {
                    // From the smaller index to the larger, so that both triangles of an edge have the same cut.
                    polygon.push(*cuts.entry((a.min(b), a.max(b))).or_insert_with(|| {
                        let (low, high) = (a.min(b) as usize, a.max(b) as usize);
                        let t = values[low] / (values[low] - values[high]);
                        patch.add(Vertex::mean([(1.0 - t, self.vertices[low]), (t, self.vertices[high])]))
                    }));
                }
            }
            for i in 1..polygon.len().saturating_sub(1) {
                patch.faces.push(vec![polygon[0], polygon[i], polygon[i + 1]]);
            }
        }
        patch
    }

    /// Moves the posed vertices along their normals.
    pub fn inflate(&mut self, by: impl Fn(&Vertex) -> f32) {
        let normals = self.normals();
        for (vertex, normal) in self.vertices.iter_mut().zip(normals) {
            vertex.posed += normal * by(vertex);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube() -> Patch {
        let vertex = |i: u32| {
            let p = Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) - 0.5;
            Vertex { rest: p, posed: p, parts: [0.1; PARTS] }
        };
        let vertices = (0..8).map(vertex).collect();
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        Patch { vertices, faces: faces.map(|f| f.to_vec()).to_vec() }
    }

    #[test]
    fn a_subdivided_cube_is_round_and_closed() {
        let patch = cube().subdivide().subdivide();
        assert_eq!((patch.vertices.len(), patch.faces.len()), (98, 96));
        let lengths: Vec<f32> = patch.vertices.iter().map(|v| v.posed.length()).collect();
        // The limit surface of the cube lies between 0.433 and 0.5 · 5/9·√3.
        assert!(lengths.iter().all(|l| (0.3..0.5).contains(l)), "{lengths:?}");
        assert!(patch.normals().iter().zip(&patch.vertices).all(|(n, v)| n.dot(v.posed) > 0.25));
    }

    #[test]
    fn a_cut_is_straight_and_leaves_the_inside() {
        let patch = cube().subdivide().cut(|v| v.rest.y - 0.1);
        assert!(patch.vertices.iter().all(|v| v.rest.y > 0.1 - 1e-6));
        let on_edge = patch.vertices.iter().filter(|v| (v.rest.y - 0.1).abs() < 1e-6).count();
        assert!(on_edge >= 8, "{on_edge}");
        assert!(patch.faces.iter().all(|f| f.len() == 3));
        assert_eq!(cube().cut(|_| 1.0).faces.len(), 12);
        assert!(cube().cut(|_| -1.0).faces.is_empty());
    }
}
