//! The texture of a body: the charts of its parts side by side in one picture.

use std::collections::HashMap;
use std::f32::consts::PI;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::RgbImage;
use rayon::prelude::*;

use super::body::Body;
use super::paint::Painter;
use super::surface::Surface;
use snapsnap_mesh::mesh::{Face, Material, Mesh};

/// Metres per texel: finer than a pixel of the sharpest views.
const TEXEL: f32 = 0.0016;
/// Charts go round a little further than once, so that no triangle is cut at their ends.
const OVERLAP: f32 = 0.5;
/// Texels between charts.
const GAP: usize = 4;
/// Smallest width of the picture.
const WIDTH: usize = 1024;

/// Where a part's chart lies in the picture.
#[derive(Clone, Copy, Default)]
struct Chart {
    /// Left and top texel.
    origin: [usize; 2],
    size: [usize; 2],
    /// Metres along the axis at the top row.
    first: f32,
    /// Radians and metres per texel.
    step: [f32; 2],
}

impl Chart {
    /// Texel coordinates of a place on the part.
    fn texel(&self, angle: f32, along: f32) -> Vec2 {
        let x = (angle + PI + OVERLAP) / self.step[0];
        let y = (along - self.first) / self.step[1];
        Vec2::new(self.origin[0] as f32 + x, self.origin[1] as f32 + y)
    }
}

/// The mesh of `surface` with its texture.
pub fn paint(body: &Body, surface: &Surface, painter: &Painter) -> Mesh {
    let parts = body.parts.len();
    // The part that most corners of a face lie on.
    let owners: Vec<u8> = surface
        .faces
        .par_iter()
        .map(|face| {
            let [a, b, c] = face.map(|row| surface.parts[row as usize]);
            if b == c { b } else { a }
        })
        .collect();
    // Where each corner lies on the chart of its face's part.
    let places: Vec<[(f32, f32); 3]> = surface
        .faces
        .par_iter()
        .zip(&owners)
        .map(|(face, owner)| {
            let part = &body.parts[*owner as usize];
            let mut places = face.map(|row| part.chart(surface.positions[row as usize]));
            let first = places[0].0;
            for place in &mut places[1..] {
                // The short way round.
                place.0 -= 2.0 * PI * ((place.0 - first) / (2.0 * PI)).round();
            }
            places
        })
        .collect();

    let mut spans = vec![(f32::INFINITY, f32::NEG_INFINITY); parts];
    for (place, owner) in places.iter().flatten().zip(owners.iter().flat_map(|o| [o; 3])) {
        let span = &mut spans[*owner as usize];
        *span = (span.0.min(place.1), span.1.max(place.1));
    }
    let (charts, size) = pack(body, &spans);

    let mut picture = vec![[0_u8; 3]; size[0] * size[1]];
    picture.par_chunks_mut(size[0]).enumerate().for_each(|(y, row)| {
        for (part, chart) in body.parts.iter().zip(&charts) {
            if !(chart.origin[1]..chart.origin[1] + chart.size[1]).contains(&y) {
                continue;
            }
            let along = chart.first + ((y - chart.origin[1]) as f32 + 0.5) * chart.step[1];
            for x in 0..chart.size[0] {
                let angle = (x as f32 + 0.5) * chart.step[0] - PI - OVERLAP;
                let angle = angle - 2.0 * PI * (angle / (2.0 * PI)).round();
                let color = painter.color(part, angle, along);
                row[chart.origin[0] + x] =
                    color.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|c| (c * 255.0).round() as u8);
            }
        }
    });
    let bytes = picture.into_flattened();
    let texture = RgbImage::from_raw(size[0] as u32, size[1] as u32, bytes).expect("three bytes per texel");

    let mut mesh = Mesh {
        materials: vec![Material { color: Vec3::ONE, texture: Some(Arc::new(texture)) }],
        ..Mesh::default()
    };
    let mut rows = HashMap::new();
    let scale = Vec2::new(size[0] as f32, size[1] as f32);
    for ((face, owner), places) in surface.faces.iter().zip(&owners).zip(&places) {
        let chart = &charts[*owner as usize];
        let texcoords = [0, 1, 2].map(|corner| {
            let (angle, along) = places[corner];
            let turns = (angle / (2.0 * PI)).round() as i32;
            *rows.entry((face[corner], *owner, turns)).or_insert_with(|| {
                let texel = chart.texel(angle.clamp(-PI - OVERLAP, PI + OVERLAP), along) / scale;
                mesh.texcoords.push(Vec2::new(texel.x, 1.0 - texel.y));
                mesh.texcoords.len() as u32 - 1
            })
        });
        mesh.faces.push(Face { positions: *face, texcoords: Some(texcoords), material: 0 });
    }
    mesh
}

/// Charts in shelves, the highest first.
fn pack(body: &Body, spans: &[(f32, f32)]) -> (Vec<Chart>, [usize; 2]) {
    let mut charts: Vec<Chart> = body
        .parts
        .iter()
        .zip(spans)
        .map(|(part, (low, high))| {
            if low > high {
                return Chart::default();
            }
            let around = (2.0 * (PI + OVERLAP) * part.radius / TEXEL).ceil().max(8.0);
            let rows = ((high - low) / TEXEL).ceil() + 2.0;
            Chart {
                origin: [0; 2],
                size: [around as usize, rows as usize],
                first: low - TEXEL,
                step: [2.0 * (PI + OVERLAP) / around, TEXEL],
            }
        })
        .collect();
    let widest = charts.iter().map(|c| c.size[0] + GAP).max().unwrap_or(0);
    let width = WIDTH.max(widest);
    let mut order: Vec<usize> = (0..charts.len()).collect();
    order.sort_by_key(|i| std::cmp::Reverse(charts[*i].size[1]));
    let (mut x, mut y, mut shelf) = (0, 0, 0);
    for i in order {
        let [w, h] = charts[i].size;
        if x + w + GAP > width {
            (x, y, shelf) = (0, y + shelf, 0);
        }
        charts[i].origin = [x, y];
        x += w + GAP;
        shelf = shelf.max(h + GAP);
    }
    (charts, [width, (y + shelf).max(1)])
}
