//! Textured triangle meshes, of scans and synthetic people.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::{GrayImage, RgbImage};

/// A triangle mesh. [`Mesh::check`] refuses indices out of range and numbers that are not finite.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Positions, y up, in metres from the world's origin unless the maker of the mesh says otherwise.
    pub positions: Vec<Vec3>,
    /// Colour of each position in [0, 1]; empty where materials give the colour.
    pub colors: Vec<Vec3>,
    /// Texture coordinates, (0, 0) at the texture's lower left corner, repeated outside [0, 1].
    pub texcoords: Vec<Vec2>,
    /// Triangles, counter-clockwise as seen from outside.
    pub faces: Vec<Face>,
    /// Materials of the faces.
    pub materials: Vec<Material>,
}

/// A triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Face {
    /// Rows of [`Mesh::positions`].
    pub positions: [u32; 3],
    /// Rows of [`Mesh::texcoords`], where the face has a texture.
    pub texcoords: Option<[u32; 3]>,
    /// Row of [`Mesh::materials`].
    pub material: u32,
}

/// Reflectance of a surface: `color` times texture times vertex colour.
#[derive(Debug, Clone)]
pub struct Material {
    /// Diffuse colour in [0, 1].
    pub color: Vec3,
    /// Texture, if any.
    pub texture: Option<Arc<RgbImage>>,
    /// 0 where the surface is cut out of its triangles, such as between the strands of a hair card. `None`: nowhere.
    pub opacity: Option<Arc<GrayImage>>,
}

impl Default for Material {
    fn default() -> Self {
        Self { color: Vec3::ONE, texture: None, opacity: None }
    }
}

/// Faults of a mesh.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MeshError {
    /// No faces.
    #[error("there is no triangle")]
    NoTriangle,
    /// All positions at one height: the mesh cannot be stood upright.
    #[error("the mesh has no height")]
    NoHeight,
    /// A number that is not finite, a reference out of range, or colours that do not match the positions.
    #[error("{0}")]
    Invalid(String),
}

impl Mesh {
    /// Triangles in the colours of their positions, or white ones without `colors`.
    pub fn colored(positions: Vec<Vec3>, colors: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> Self {
        let face = |positions| Face { positions, texcoords: None, material: 0 };
        let faces = triangles.into_iter().map(face).collect();
        Self { positions, colors, faces, materials: vec![Material::default()], ..Self::default() }
    }

    /// Checks that the mesh can be drawn.
    ///
    /// # Errors
    /// [`MeshError`] for the first fault.
    pub fn check(&self) -> Result<(), MeshError> {
        if self.faces.is_empty() {
            return Err(MeshError::NoTriangle);
        }
        let not_finite = [
            ("position", self.positions.iter().position(|p| !p.is_finite())),
            ("texture coordinate", self.texcoords.iter().position(|t| !t.is_finite())),
            ("vertex colour", self.colors.iter().position(|c| !c.is_finite())),
        ];
        if let Some((what, index)) = not_finite.iter().find_map(|(what, index)| Some((what, (*index)?))) {
            return Err(MeshError::Invalid(format!("{what} {index} is not finite")));
        }
        let (colors, positions) = (self.colors.len(), self.positions.len());
        if colors > 0 && colors != positions {
            return Err(MeshError::Invalid(format!("{colors} vertex colours for {positions} positions")));
        }
        for (face, f) in self.faces.iter().enumerate() {
            let references = [
                ("position", &f.positions[..], positions),
                ("texture coordinate", f.texcoords.as_ref().map_or(&[], |t| t), self.texcoords.len()),
                ("material", &[f.material], self.materials.len()),
            ];
            for (what, rows, count) in references {
                if let Some(row) = rows.iter().find(|row| **row as usize >= count) {
                    let message = format!("face {face} refers to {what} {row}, there are {count}");
                    return Err(MeshError::Invalid(message));
                }
            }
        }
        Ok(())
    }

    /// Vertex normals: the area-weighted mean of the adjacent faces' normals. Zero at positions without a face.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions.len()];
        for face in &self.faces {
            let [a, b, c] = face.positions.map(|row| self.positions[row as usize]);
            let normal = (b - a).cross(c - a);
            for row in face.positions {
                normals[row as usize] += normal;
            }
        }
        normals.into_iter().map(Vec3::normalize_or_zero).collect()
    }

    /// Merges vertices with equal position and colour. Files duplicate vertices along texture seams, where smooth
    /// shading would otherwise show an edge. Returns the former index of each vertex.
    pub fn weld(&mut self) -> Vec<usize> {
        let bits = |v: Vec3| v.to_array().map(|x| if x == 0.0 { 0 } else { x.to_bits() });
        let mut rows = HashMap::with_capacity(self.positions.len());
        let mut kept = Vec::new();
        let place = |row: usize| {
            let color = self.colors.get(row).map(|color| bits(*color));
            *rows.entry((bits(self.positions[row]), color)).or_insert_with(|| {
                kept.push(row);
                kept.len() as u32 - 1
            })
        };
        let places: Vec<u32> = (0..self.positions.len()).map(place).collect();
        self.positions = kept.iter().map(|row| self.positions[*row]).collect();
        if !self.colors.is_empty() {
            self.colors = kept.iter().map(|row| self.colors[*row]).collect();
        }
        self.faces.iter_mut().for_each(|f| f.positions = f.positions.map(|row| places[row as usize]));
        kept
    }

    /// Smallest and largest coordinates of the positions.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        bounds(self.positions.iter().copied())
    }
}

/// Smallest and largest coordinates; infinite without points.
pub fn bounds(points: impl Iterator<Item = Vec3>) -> (Vec3, Vec3) {
    points.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

/// A colour as bytes. Values outside of [0, 1] are clamped.
pub fn bytes(color: Vec3) -> [u8; 3] {
    color.to_array().map(|c| (255.0 * c).round() as u8)
}

/// For each face the number of its connected piece. Faces that share one of the `positions` are connected. Piece 0 has
/// the most faces, and so on. Faces have at least one corner.
pub fn pieces<'a>(positions: usize, faces: impl Iterator<Item = &'a [u32]> + Clone) -> Vec<usize> {
    fn root(parents: &mut [usize], mut row: usize) -> usize {
        while parents[row] != row {
            parents[row] = parents[parents[row]];
            row = parents[row];
        }
        row
    }
    let mut parents: Vec<usize> = (0..positions).collect();
    for face in faces.clone() {
        let first = root(&mut parents, face[0] as usize);
        for corner in &face[1..] {
            let other = root(&mut parents, *corner as usize);
            parents[other] = first;
        }
    }
    let roots: Vec<usize> = faces.map(|face| root(&mut parents, face[0] as usize)).collect();
    let mut sizes = vec![0_usize; positions];
    roots.iter().for_each(|root| sizes[*root] += 1);
    let mut order: Vec<usize> = (0..positions).filter(|row| sizes[*row] > 0).collect();
    // The sort is stable: of two pieces of one size, the piece with the smaller root is the first.
    order.sort_by_key(|row| Reverse(sizes[*row]));
    let mut numbers = vec![0; positions];
    order.into_iter().enumerate().for_each(|(number, root)| numbers[root] = number);
    roots.into_iter().map(|root| numbers[root]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> Mesh {
        Mesh::colored(vec![Vec3::ZERO, Vec3::X, Vec3::Y], Vec::new(), vec![[0, 1, 2]])
    }

    #[test]
    fn unusable_meshes_are_named() {
        assert_eq!(triangle().check(), Ok(()));
        let wrong = |change: fn(&mut Mesh)| {
            let mut mesh = triangle();
            change(&mut mesh);
            mesh.check().expect_err("wrong").to_string()
        };
        assert_eq!(wrong(|m| m.faces[0].positions[2] = 3), "face 0 refers to position 3, there are 3");
        let texcoord = wrong(|m| m.faces[0].texcoords = Some([0; 3]));
        assert_eq!(texcoord, "face 0 refers to texture coordinate 0, there are 0");
        assert_eq!(wrong(|m| m.colors = vec![Vec3::ONE]), "1 vertex colours for 3 positions");
    }

    #[test]
    fn equal_positions_become_one() {
        let mut mesh = triangle();
        mesh.positions.extend([Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y]);
        mesh.faces.push(Face { positions: [3, 4, 5], texcoords: None, material: 0 });
        mesh.weld();
        assert_eq!(mesh.positions.len(), 4);
        assert_eq!(mesh.faces[1].positions, [1, 3, 2]);
        assert_eq!(mesh.check(), Ok(()));
    }

    #[test]
    fn pieces_are_numbered_from_the_largest_on() {
        let faces: [&[u32]; 4] = [&[0, 1, 2], &[3, 4, 5], &[5, 6, 7, 8], &[9, 10, 11]];
        assert_eq!(pieces(12, faces.into_iter()), [1, 0, 0, 2]);
    }
}
