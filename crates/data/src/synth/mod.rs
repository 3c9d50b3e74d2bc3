//! Synthetic people: an articulated body of signed distances, posed and dressed, meshed and painted.
//!
//! Everything about a person follows from a name, the same on every machine.

mod anatomy;
pub(crate) mod atlas;
pub(crate) mod body;
pub(crate) mod figure;
pub(crate) mod math;
pub(crate) mod outfit;
pub(crate) mod paint;
pub(crate) mod surface;
#[cfg(test)]
mod tests;

use crate::mesh::Mesh;
use crate::random::stream;
use body::Body;
use figure::{Build, Figure, Pose};
use outfit::Outfit;
use paint::Painter;

/// Side of the cells that bodies are meshed with, metres.
pub const CELL: f32 = 0.005;

/// The person of this name: life-size in metres, standing on y = 0 and facing +z.
pub fn person(name: &str) -> Mesh {
    let mut random = stream(&format!("synth/{name}"));
    let build = Build::draw(&mut random);
    let mut pose = Pose::draw(&mut random);
    let outfit = Outfit::draw(&mut random, &build);
    pose.spread_arms(outfit.breadth());
    let figure = Figure::new(build, &pose);
    let body = Body::new(&figure, &outfit);
    let mut surface = surface::mesh(&body, CELL);
    let mut mesh = atlas::paint(&body, &surface, &Painter::new(&figure, &outfit));
    let floor = surface.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    for p in &mut surface.positions {
        p.y -= floor;
    }
    mesh.positions = surface.positions;
    mesh
}
