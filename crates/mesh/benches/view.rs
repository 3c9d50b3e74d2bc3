//! Time per view of a mesh: `cargo bench --workspace --bench view`.
//!
//! The mesh is an ellipsoid as high as a person that covers 30 % of the training camera's picture, with a texture of 2048²
//! pixels.

use std::f32::consts::{PI, TAU};
use std::sync::Arc;
use std::time::Instant;

use glam::{Vec2, Vec3};
use image::{Rgb, RgbImage};
use snapsnap_mesh::mesh::{Face, Material, Mesh};
use snapsnap_mesh::view::{Renderer, ViewOptions};
use snapsnap_splat::Camera;

fn ellipsoid(rows: u32, columns: u32) -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..=rows {
        for j in 0..=columns {
            let (v, u) = (i as f32 / rows as f32, j as f32 / columns as f32);
            let ((sin, cos), (s, c)) = ((PI * v).sin_cos(), (TAU * u).sin_cos());
            mesh.positions.push(Vec3::new(0.64 * sin * s, 0.85 + 0.9 * cos, 0.3 * sin * c));
            mesh.texcoords.push(Vec2::new(u, 1.0 - v));
        }
    }
    for i in 0..rows {
        for j in 0..columns {
            let at = |i: u32, j: u32| i * (columns + 1) + j;
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            for rows in [[a, b, c], [a, c, d]] {
                mesh.faces.push(Face { positions: rows, texcoords: Some(rows), material: 0 });
            }
        }
    }
    let texture = RgbImage::from_fn(2048, 2048, |x, y| Rgb([x as u8, y as u8, (x * y) as u8]));
    mesh.materials.push(Material { texture: Some(Arc::new(texture)), ..Material::default() });
    mesh
}

fn main() {
    println!("| triangles | picture | samples per pixel | ms per view |\n|---:|---:|---:|---:|");
    for (rows, columns) in [(100, 100), (200, 250), (500, 1000)] {
        let mesh = ellipsoid(rows, columns);
        let renderer = Renderer::new(&mesh).expect("a sound mesh");
        for size in [512, 1024, 2048] {
            for samples in [1, 2, 3, 4] {
                let options = ViewOptions { samples, ..ViewOptions::default() };
                let mut times: Vec<f64> = (0..8)
                    .map(|i| {
                        let camera = Camera::orbit_at_yaw_degrees(45.0 * f64::from(i), size);
                        let start = Instant::now();
                        let view = renderer.draw(&camera, &options);
                        assert!(view.alpha.contains(&1.0));
                        start.elapsed().as_secs_f64() * 1e3
                    })
                    .collect();
                times.sort_by(f64::total_cmp);
                let median = times[times.len() / 2];
                println!("| {}k | {size}² | {} | {median:.0} |", mesh.faces.len() / 1000, samples * samples);
            }
        }
    }
}
