//! Textured triangle meshes: what scans and synthetic people are made of.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::RgbImage;

/// A mesh that can be drawn: indices in range, numbers finite.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// World positions, metres, y up.
    pub positions: Vec<Vec3>,
    /// Colour of each position in [0, 1]; empty where materials give the colour.
    pub colors: Vec<Vec3>,
    /// Texture coordinates, (0, 0) at the texture's lower left corner, repeated outside [0, 1].
    pub texcoords: Vec<Vec2>,
    /// Triangles, counter-clockwise as seen from outside.
    pub faces: Vec<Face>,
    /// What faces refer to.
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

/// How a face reflects light: colour times texture times the positions' colours.
#[derive(Debug, Clone)]
pub struct Material {
    /// Diffuse colour in [0, 1].
    pub color: Vec3,
    /// Texture, if any.
    pub texture: Option<Arc<RgbImage>>,
}

impl Default for Material {
    fn default() -> Self {
        Self { color: Vec3::ONE, texture: None }
    }
}

/// What makes a mesh unusable.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MeshError {
    /// Nothing to draw.
    #[error("there is no triangle")]
    NoTriangle,
    /// A NaN or an infinity.
    #[error("{what} {index} is not finite")]
    NotFinite {
        /// Kind of number.
        what: &'static str,
        /// Its row.
        index: usize,
    },
    /// A reference to nothing.
    #[error("face {face} refers to {what} {index}, there are {count}")]
    OutOfRange {
        /// Row of the face.
        face: usize,
        /// Kind of reference.
        what: &'static str,
        /// Where it points.
        index: u32,
        /// How many there are.
        count: usize,
    },
    /// All positions at one height: nothing that could be stood up.
    #[error("the mesh has no height")]
    NoHeight,
    /// Colours that do not belong to the positions.
    #[error("{colors} vertex colours for {positions} positions")]
    Colors {
        /// Number of colours.
        colors: usize,
        /// Number of positions.
        positions: usize,
    },
}

impl Mesh {
    /// Triangles in the colours of their positions.
    pub fn colored(positions: Vec<Vec3>, colors: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> Self {
        let face = |positions| Face { positions, texcoords: None, material: 0 };
        let faces = triangles.into_iter().map(face).collect();
        Self { positions, colors, faces, materials: vec![Material::default()], ..Self::default() }
    }

    /// Whether the mesh can be drawn.
    ///
    /// # Errors
    /// [`MeshError`] for the first thing that is wrong.
    pub fn check(&self) -> Result<(), MeshError> {
        if self.faces.is_empty() {
            return Err(MeshError::NoTriangle);
        }
        let not_finite = |what, index: Option<usize>| match index {
            Some(index) => Err(MeshError::NotFinite { what, index }),
            None => Ok(()),
        };
        not_finite("position", self.positions.iter().position(|p| !p.is_finite()))?;
        not_finite("texture coordinate", self.texcoords.iter().position(|t| !t.is_finite()))?;
        not_finite("vertex colour", self.colors.iter().position(|c| !c.is_finite()))?;
        if !self.colors.is_empty() && self.colors.len() != self.positions.len() {
            return Err(MeshError::Colors { colors: self.colors.len(), positions: self.positions.len() });
        }
        for (face, f) in self.faces.iter().enumerate() {
            let within =
                |what, rows: &[u32], count: usize| match rows.iter().find(|row| **row as usize >= count) {
                    Some(&index) => Err(MeshError::OutOfRange { face, what, index, count }),
                    None => Ok(()),
                };
            within("position", &f.positions, self.positions.len())?;
            within("texture coordinate", f.texcoords.as_ref().map_or(&[], |t| t), self.texcoords.len())?;
            within("material", &[f.material], self.materials.len())?;
        }
        Ok(())
    }

    /// Smooth normals: at each position the mean of its faces' normals, weighted by their area. Zero where a position has
    /// no face.
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

    /// Makes positions one that are equal in place and colour: files repeat them along the seams of textures, where
    /// shading would show an edge.
    pub fn weld(&mut self) {
        let bits = |v: Vec3| v.to_array().map(|x| if x == 0.0 { 0 } else { x.to_bits() });
        let mut rows = HashMap::with_capacity(self.positions.len());
        let mut kept = Vec::new();
        let places: Vec<u32> = (0..self.positions.len())
            .map(|row| {
                let color = self.colors.get(row).map(|color| bits(*color));
                *rows.entry((bits(self.positions[row]), color)).or_insert_with(|| {
                    kept.push(row);
                    kept.len() as u32 - 1
                })
            })
            .collect();
        self.positions = kept.iter().map(|row| self.positions[*row]).collect();
        if !self.colors.is_empty() {
            self.colors = kept.iter().map(|row| self.colors[*row]).collect();
        }
        self.faces.iter_mut().for_each(|f| f.positions = f.positions.map(|row| places[row as usize]));
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.positions.iter().fold(start, |(low, high), p| (low.min(*p), high.max(*p)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> Mesh {
        Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            faces: vec![Face { positions: [0, 1, 2], texcoords: None, material: 0 }],
            materials: vec![Material::default()],
            ..Mesh::default()
        }
    }

    #[test]
    fn unusable_meshes_are_named() {
        assert_eq!(triangle().check(), Ok(()));
        let wrong = |change: fn(&mut Mesh)| {
            let mut mesh = triangle();
            change(&mut mesh);
            mesh.check().expect_err("wrong").to_string()
        };
        assert_eq!(wrong(|m| m.faces.clear()), "there is no triangle");
        assert_eq!(wrong(|m| m.positions[1].y = f32::NAN), "position 1 is not finite");
        assert_eq!(wrong(|m| m.faces[0].positions[2] = 3), "face 0 refers to position 3, there are 3");
        assert_eq!(wrong(|m| m.faces[0].material = 1), "face 0 refers to material 1, there are 1");
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
    fn normals_point_outwards() {
        assert_eq!(triangle().normals(), [Vec3::Z; 3]);
        assert_eq!(triangle().bounds(), (Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0)));
    }
}
