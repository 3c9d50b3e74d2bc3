//! What a MakeHuman person wears of the asset collection: suits, shoes, hats and hair, in own patterns.

use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::RgbImage;
use rand::Rng;
use rayon::prelude::*;
use snapsnap_mesh::mesh::{Face, Material, Mesh};

use super::Person;
use super::files::Library;
use super::net::Net;
use super::proxy::{Fitted, Kind, Proxy};
use crate::math::noise2;
use crate::pattern::Pattern;
use crate::synth::outfit::{Cut, Outfit};

/// Share of people in a suit of the collection, among those without a skirt or a coat.
const SUITS: f32 = 0.7;
/// Share of people in its shoes, of those without such a suit.
const SHOES: f32 = 0.4;
/// Share of people with its hair, of those that are not bald and have no cap.
const HAIR: f32 = 0.65;
/// Share of people with its hat.
const HATS: f32 = 0.06;
/// Side of a piece's texture.
const TEXTURE: u32 = 512;
/// Smallest piece that is a garment, and no button or sole, as a share of the largest.
const GARMENT: f32 = 0.2;

/// The proxies that a person wears.
#[derive(Default)]
pub struct Worn {
    pub suit: Option<Arc<Proxy>>,
    pub shoes: Option<Arc<Proxy>>,
    pub hair: Option<Arc<Proxy>>,
    pub hat: Option<Arc<Proxy>>,
    /// Cloth of hats, and of what hangs between top and bottom.
    other: Option<Pattern>,
}

impl Worn {
    pub fn draw(
        library: &Library,
        outfit: &Outfit,
        sex: f32,
        is_draped: bool,
        random: &mut impl Rng,
    ) -> Self {
        let [suit, shoes, hair, hat] = [(); 4].map(|()| random.random_range(0.0..1.0_f32));
        let mut choose =
            |kind: Kind, is_wanted: bool| library.wardrobe.choose(kind, sex, random).filter(|_| is_wanted);
        let own_shoes = choose(Kind::Shoes, true);
        let suit = choose(Kind::Suit, !is_draped && suit < SUITS && own_shoes.is_some());
        let has_shoes = suit.is_some() || shoes < SHOES;
        let has_hair = !matches!(outfit.cut, Cut::Bald | Cut::Cap);
        let hair = choose(Kind::Hair, has_hair && hair < HAIR);
        let hat = choose(Kind::Hat, has_hair && hat < HATS);
        let other = Some(Pattern::draw_quiet(random));
        Self { suit, shoes: own_shoes.filter(|_| has_shoes), hair, hat, other }
    }

    /// Whether a vertex of the base mesh lies below clothes.
    pub fn hides(&self, row: u32) -> bool {
        let worn = [&self.suit, &self.shoes];
        worn.into_iter().flatten().any(|proxy| proxy.hides.get(row as usize) == Some(&true))
    }
}

impl Person<'_> {
    /// Adds the meshes of what is worn.
    pub fn add_worn(&self, mesh: &mut Mesh) {
        let Worn { suit, shoes, hair, hat, other } = &self.worn;
        let outfit = &self.outfit;
        let other = other.as_ref().unwrap_or(&outfit.bottom);
        if let Some(suit) = suit {
            let mut suit = self.fit(suit).subdivide();
            suit.net.inflate(|vertex| 1.2 * self.folds(vertex));
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
            let shoes = self.fit(shoes).subdivide();
            let garments = shoes.garments();
            let sole = Vec3::splat(if outfit.trim.element_sum() > 1.5 { 0.9 } else { 0.12 });
            shoes.add_to(mesh, |piece| {
                if garments.contains(&piece) { Cloth::Pattern(&outfit.shoes) } else { Cloth::Plain(sole) }
            });
        }
        if let Some(hair) = hair {
            self.fit(hair).subdivide().add_to(mesh, |_| Cloth::Hair(outfit.hair, outfit.seed));
        }
        if let Some(hat) = hat {
            self.fit(hat).subdivide().add_to(mesh, |_| Cloth::Pattern(other));
        }
    }

    /// A proxy on the posed body.
    pub fn fit(&self, proxy: &Proxy) -> Fitted {
        proxy.fit(&self.vertices, |shares, p| {
            let bones = shares.iter().flat_map(|(row, share)| {
                self.library.weights[*row as usize].iter().map(move |(bone, weight)| (*bone, share * weight))
            });
            bones.map(|(bone, share)| share * self.placed[bone as usize].apply(p)).sum()
        })
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
    /// Colour at texture coordinates, `size` metres each.
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
    /// The pieces that are no small parts, from the top down.
    fn garments(&self) -> Vec<usize> {
        let count = self.pieces.iter().max().map_or(0, |last| last + 1);
        let mut sums = vec![(0.0_f32, 0.0_f32); count];
        for (face, piece) in self.net.faces.iter().zip(&self.pieces) {
            sums[*piece].0 += self.net.vertices[face[0] as usize].rest.y;
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
        let Net { vertices, faces } = &self.net;
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(vertices.iter().map(|vertex| vertex.posed));
        let size = self.metres();
        let mut materials: Vec<Option<u32>> = vec![None; self.pieces.iter().max().map_or(0, |last| last + 1)];
        // Hair and hats have many pieces of one colour.
        let mut made: Vec<(Cloth, u32)> = Vec::new();
        for ((face, texcoords), piece) in faces.iter().zip(&self.texcoords).zip(&self.pieces) {
            let material = *materials[*piece].get_or_insert_with(|| {
                let cloth = cloth(*piece);
                if let Some((_, material)) = made.iter().find(|(other, _)| *other == cloth) {
                    return *material;
                }
                let row = mesh.materials.len() as u32;
                mesh.materials.push(material(&cloth, size));
                made.push((cloth, row));
                row
            });
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
        for (face, at) in self.net.faces.iter().zip(&self.texcoords) {
            let corner = |i: usize| self.net.vertices[face[i] as usize].rest;
            surface += (corner(1) - corner(0)).cross(corner(2) - corner(0)).length();
            chart += (at[1] - at[0]).perp_dot(at[2] - at[0]).abs();
        }
        if chart > 0.0 { (surface / chart).sqrt().clamp(0.02, 20.0) } else { 0.0 }
    }
}

fn material(cloth: &Cloth, size: f32) -> Material {
    if let Cloth::Plain(color) = cloth {
        return Material { color: *color, texture: None };
    }
    let mut texture = RgbImage::new(TEXTURE, TEXTURE);
    let row = 3 * TEXTURE as usize;
    texture.as_mut().par_chunks_exact_mut(row).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let at = Vec2::new(x as f32 + 0.5, TEXTURE as f32 - y as f32 - 0.5) / TEXTURE as f32;
            let color = cloth.color(at, size).clamp(Vec3::ZERO, Vec3::ONE);
            pixel.copy_from_slice(&(color * 255.0).round().to_array().map(|c| c as u8));
        }
    });
    Material { color: Vec3::ONE, texture: Some(Arc::new(texture)) }
}
