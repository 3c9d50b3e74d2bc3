//! The texture of a body: one picture with the charts of its parts side by side.

use std::collections::HashMap;
use std::f32::consts::PI;
use std::sync::Arc;

use glam::Vec2;
use image::RgbImage;
use rayon::prelude::*;

use super::body::Body;
use super::paint::Painter;
use super::part::Part;
use super::surface::Surface;
use crate::Detail;
use snapsnap_mesh::mesh::{Face, Material, Mesh, bytes};

/// Metres per texel of fine people, finer than a pixel of the sharpest views.
const TEXEL: f32 = 0.0016;
/// Radians by which charts extend beyond a full turn at each end, so that no triangle is cut.
const OVERLAP: f32 = 0.5;
/// Texels between charts.
const GAP: usize = 4;
/// Smallest width of the picture.
const WIDTH: usize = 1024;

/// Place of a part's chart in the picture.
#[derive(Clone, Copy, Default)]
struct Chart {
    /// Left and top texel.
    origin: [usize; 2],
    size: [usize; 2],
    /// Metres along the axis at the top row of texels.
    first: f32,
    /// Radians and metres per texel.
    step: [f32; 2],
}

/// The faces of `surface` as a mesh with a texture; the caller adds the positions.
pub fn paint(body: &Body, surface: &Surface, painter: &Painter, detail: Detail) -> Mesh {
    // For each face: the part of most corners, and the positions of the corners on the part's chart.
    let chart = |face: &[u32; 3]| {
        let [a, b, c] = face.map(|row| surface.parts[row as usize]);
        let owner = usize::from(if b == c { b } else { a });
        let mut places = face.map(|row| body.parts[owner].chart(surface.positions[row as usize]));
        let first = places[0].0;
        for place in &mut places[1..] {
            // Unwraps the angle to less than half a turn from the first corner.
            place.0 -= 2.0 * PI * ((place.0 - first) / (2.0 * PI)).round();
        }
        (owner, places)
    };
    let charted: Vec<(usize, [(f32, f32); 3])> = surface.faces.par_iter().map(chart).collect();

    let mut spans = vec![(f32::INFINITY, f32::NEG_INFINITY); body.parts.len()];
    for (owner, places) in &charted {
        for (_, along) in places {
            let (low, high) = &mut spans[*owner];
            (*low, *high) = (low.min(*along), high.max(*along));
        }
    }
    let (charts, size) = pack(body, &spans, detail.length(TEXEL));

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
                row[chart.origin[0] + x] = bytes(painter.color(part, angle, along));
            }
        }
    });
    let picture = picture.into_flattened();
    let texture = RgbImage::from_raw(size[0] as u32, size[1] as u32, picture).expect("three bytes per texel");

    let mut mesh = Mesh {
        materials: vec![Material { texture: Some(Arc::new(texture)), ..Material::default() }],
        ..Mesh::default()
    };
    let mut rows = HashMap::new();
    let scale = Vec2::new(size[0] as f32, size[1] as f32);
    for (face, (owner, places)) in surface.faces.iter().zip(&charted) {
        let chart = &charts[*owner];
        let texcoords = [0, 1, 2].map(|corner| {
            let (angle, along) = places[corner];
            let turns = (angle / (2.0 * PI)).round() as i32;
            *rows.entry((face[corner], *owner, turns)).or_insert_with(|| {
                let x = (angle.clamp(-PI - OVERLAP, PI + OVERLAP) + PI + OVERLAP) / chart.step[0];
                let y = (along - chart.first) / chart.step[1];
                let [left, top] = chart.origin.map(|texel| texel as f32);
                mesh.texcoords.push(Vec2::new((left + x) / scale.x, 1.0 - (top + y) / scale.y));
                mesh.texcoords.len() as u32 - 1
            })
        });
        mesh.faces.push(Face { positions: *face, texcoords: Some(texcoords), material: 0 });
    }
    mesh
}

/// Shelf packing of charts of `texel` metres per texel, the highest first. Also returns width and height of the picture.
fn pack(body: &Body, spans: &[(f32, f32)], texel: f32) -> (Vec<Chart>, [usize; 2]) {
    let chart = |(part, (low, high)): (&Part, &(f32, f32))| {
        if low > high {
            return Chart::default();
        }
        let around = (2.0 * (PI + OVERLAP) * part.radius / texel).ceil().max(8.0);
        let rows = ((high - low) / texel).ceil() + 2.0;
        Chart {
            origin: [0; 2],
            size: [around as usize, rows as usize],
            first: low - texel,
            step: [2.0 * (PI + OVERLAP) / around, texel],
        }
    };
    let mut charts: Vec<Chart> = body.parts.iter().zip(spans).map(chart).collect();
    let width = charts.iter().map(|c| c.size[0] + GAP).fold(WIDTH, usize::max);
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
