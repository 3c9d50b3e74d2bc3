//! Suits, shoes, hats and hair of MakeHuman's asset collection on a person, in own patterns.

use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::RgbImage;
use rayon::prelude::*;
use snapsnap_mesh::mesh::{Face, Material, Mesh, bytes};

use super::patch::Patch;
use super::person::Person;
use super::proxy::{Fitted, Proxy, Worn};
use crate::math::noise2;
use crate::pattern::Pattern;

/// Side of a piece's texture.
const TEXTURE: u32 = 512;
/// Smallest size of a garment, as a share of the largest piece. Smaller pieces are buttons or soles.
const GARMENT: f32 = 0.2;

impl Person<'_> {
    pub fn add_worn(&self, mesh: &mut Mesh) {
        let Worn { suit, shoes, hair, hat, other } = &self.worn;
        let outfit = &self.outfit;
        if let Some(suit) = suit {
            let mut suit = self.fit(suit);
            suit.patch.inflate(|vertex| 1.2 * self.folds(vertex));
            let garments = suit.garments();
            let cloth = |piece: usize| match garments.iter().position(|garment| *garment == piece) {
                Some(0) => Cloth::Pattern(&outfit.top),
                Some(place) if place + 1 == garments.len() => Cloth::Pattern(&outfit.bottom),
                Some(_) => Cloth::Pattern(other),
                None => Cloth::Plain(outfit.trim),
            };
            suit.add_to(mesh, cloth);
        }
        if let Some(shoes) = shoes {
            let shoes = self.fit(shoes);
            let garments = shoes.garments();
            let sole = Vec3::splat(if outfit.trim.element_sum() > 1.5 { 0.9 } else { 0.12 });
            shoes.add_to(mesh, |piece| {
                if garments.contains(&piece) { Cloth::Pattern(&outfit.shoes) } else { Cloth::Plain(sole) }
            });
        }
        if let Some(hair) = hair {
            self.fit(hair).add_to(mesh, |_| Cloth::Hair(outfit.hair, outfit.seed));
        }
        if let Some(hat) = hat {
            self.fit(hat).add_to(mesh, |_| Cloth::Pattern(other));
        }
    }

    /// A proxy on the posed body.
    pub fn fit(&self, proxy: &Proxy) -> Fitted {
        let fitted = proxy.fit(&self.vertices, |shares, p| {
            let bones = shares.iter().flat_map(|(row, share)| {
                self.library.weights[*row as usize].iter().map(move |(bone, weight)| (*bone, share * weight))
            });
            bones.map(|(bone, share)| share * self.placed[bone as usize].apply(p)).sum()
        });
        (0..self.detail.steps(1)).fold(fitted, |fitted, _| fitted.subdivide())
    }
}

/// The colour of a piece.
#[derive(PartialEq)]
enum Cloth<'a> {
    Plain(Vec3),
    Pattern(&'a Pattern),
    /// Hair of a colour, with a seed.
    Hair(Vec3, u32),
}

impl Cloth<'_> {
    /// Colour at texture coordinates, whose unit is `size` metres.
    fn color(&self, at: Vec2, size: f32) -> Vec3 {
        match self {
            Self::Plain(color) => *color,
            Self::Pattern(pattern) => pattern.color(at * size),
            Self::Hair(color, seed) => {
                let strand = noise2(Vec2::new(at.x * 90.0, at.y * 9.0), seed ^ 21);
                let fine = noise2(Vec2::new(at.x * 300.0, at.y * 24.0), seed ^ 22);
                *color * (0.55 + 0.55 * strand + 0.3 * fine)
            }
        }
    }
}

impl Fitted {
    /// The pieces that are garments, from top to bottom.
    fn garments(&self) -> Vec<usize> {
        let count = self.pieces.iter().max().map_or(0, |last| last + 1);
        let mut sums = vec![(0.0_f32, 0.0_f32); count];
        for (face, piece) in self.patch.faces.iter().zip(&self.pieces) {
            sums[*piece].0 += self.patch.vertices[face[0] as usize].rest.y;
            sums[*piece].1 += 1.0;
        }
        let least = sums.iter().map(|(_, faces)| *faces).fold(0.0, f32::max) * GARMENT;
        let mut garments: Vec<usize> = (0..count).filter(|piece| sums[*piece].1 >= least).collect();
        let height = |piece: &usize| sums[*piece].0 / sums[*piece].1;
        garments.sort_by(|a, b| height(b).total_cmp(&height(a)));
        garments
    }

    /// Adds the surface to a mesh, with a texture for each colour.
    fn add_to<'a>(&self, mesh: &mut Mesh, cloth: impl Fn(usize) -> Cloth<'a>) {
        let Patch { vertices, faces } = &self.patch;
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(vertices.iter().map(|vertex| vertex.posed));
        let size = self.metres();
        // Hair and hats have many pieces of one colour.
        let mut made: Vec<Cloth> = Vec::new();
        let before = mesh.materials.len();
        for ((face, texcoords), piece) in faces.iter().zip(&self.texcoords).zip(&self.pieces) {
            let cloth = cloth(*piece);
            let row = made.iter().position(|other| *other == cloth).unwrap_or_else(|| {
                mesh.materials.push(material(&cloth, size));
                made.push(cloth);
                made.len() - 1
            });
            let material = (before + row) as u32;
            let place = mesh.texcoords.len() as u32;
            mesh.texcoords.extend(texcoords);
            for i in 1..face.len() as u32 - 1 {
                let corners = [0, i, i + 1];
                mesh.faces.push(Face {
                    positions: corners.map(|corner| first + face[corner as usize]),
                    texcoords: Some(corners.map(|corner| place + corner)),
                    material,
                });
            }
        }
    }

    /// Metres of cloth per texture coordinate.
    fn metres(&self) -> f32 {
        let (mut surface, mut chart) = (0.0, 0.0);
        for (face, at) in self.patch.faces.iter().zip(&self.texcoords) {
            let corner = |i: usize| self.patch.vertices[face[i] as usize].rest;
            surface += (corner(1) - corner(0)).cross(corner(2) - corner(0)).length();
            chart += (at[1] - at[0]).perp_dot(at[2] - at[0]).abs();
        }
        if chart > 0.0 { (surface / chart).sqrt().clamp(0.02, 20.0) } else { 0.0 }
    }
}

fn material(cloth: &Cloth, size: f32) -> Material {
    if let Cloth::Plain(color) = cloth {
        return Material { color: *color, ..Material::default() };
    }
    let mut texture = RgbImage::new(TEXTURE, TEXTURE);
    let row = 3 * TEXTURE as usize;
    texture.as_mut().par_chunks_exact_mut(row).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let at = Vec2::new(x as f32 + 0.5, TEXTURE as f32 - y as f32 - 0.5) / TEXTURE as f32;
            pixel.copy_from_slice(&bytes(cloth.color(at, size)));
        }
    });
    Material { texture: Some(Arc::new(texture)), ..Material::default() }
}
