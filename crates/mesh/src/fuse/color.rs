//! Vertex colours of a surface, from the views that face it.

use glam::Vec3;
use rayon::prelude::*;

use super::views::View;
use crate::mesh::Mesh;

/// Largest distance between a point and the surface in a view that gives the point its colour, in cubes of the field.
pub const REACH: f32 = 3.0;
/// The weight of a view is its cosine to this power.
const SHARPNESS: i32 = 6;
/// Number of rounds in which colours spread to neighbours that no view shows.
const ROUNDS: usize = 200;

/// Weighted mean of a point's colours in the views.
#[derive(Debug, Clone, Copy, Default)]
pub struct Mean {
    sum: Vec3,
    weight: f32,
}

impl Mean {
    /// Adds a view if it shows the point `place`, whose normal is `normal`.
    pub fn add(&mut self, view: &View, place: Vec3, normal: Vec3, reach: f32) {
        let square = -view.towards(place).dot(normal);
        if square <= 0.0 {
            return;
        }
        if let Some((color, facing)) = view.color(place, reach) {
            let weight = (square * facing).powi(SHARPNESS);
            self.sum += weight * color;
            self.weight += weight;
        }
    }

    /// The colour, if any view showed the point.
    pub fn color(&self) -> Option<Vec3> {
        (self.weight > 0.0).then(|| (self.sum / self.weight).clamp(Vec3::ZERO, Vec3::ONE))
    }
}

/// Colours of all positions. Positions that no view shows (armpits, soles) have the mean colour of their neighbours.
pub fn colors(mesh: &Mesh, views: &[View], cell: f32) -> Vec<Vec3> {
    let normals = mesh.normals();
    let seen = mesh.positions.par_iter().zip(&normals);
    let color = |(place, normal): (&Vec3, &Vec3)| {
        let mut mean = Mean::default();
        views.iter().for_each(|view| mean.add(view, *place, *normal, REACH * cell));
        mean.color()
    };
    let mut colors: Vec<Option<Vec3>> = seen.map(color).collect();
    for _ in 0..ROUNDS {
        if colors.iter().all(Option::is_some) {
            break;
        }
        let mut around = vec![(Vec3::ZERO, 0.0); colors.len()];
        for face in &mesh.faces {
            for (to, from) in [(0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)] {
                let [to, from] = [to, from].map(|corner: usize| face.positions[corner] as usize);
                if let (None, Some(color)) = (colors[to], colors[from]) {
                    around[to].0 += color;
                    around[to].1 += 1.0;
                }
            }
        }
        for (color, (sum, count)) in colors.iter_mut().zip(around) {
            if count > 0.0 {
                *color = Some(sum / count);
            }
        }
    }
    colors.into_iter().map(Option::unwrap_or_default).collect()
}
