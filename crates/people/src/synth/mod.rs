//! Synthetic people: an articulated body of signed distances, posed and dressed, meshed and painted.
//!
//! Everything about a person follows from a name, the same on every machine.

mod anatomy;
pub(crate) mod atlas;
pub(crate) mod body;
pub(crate) mod figure;
pub(crate) mod outfit;
pub(crate) mod paint;
pub(crate) mod part;
pub(crate) mod surface;
#[cfg(test)]
mod tests;

use glam::Vec3;

use body::Body;
use figure::{Build, Figure, Pose};
use outfit::Outfit;
use paint::Painter;
use snapsnap_base::random::stream;
use snapsnap_mesh::mesh::Mesh;

/// Side of the cells that bodies are meshed with, metres.
pub const CELL: f32 = 0.005;

/// Most small moves that take an arm out of the trunk.
pub(crate) const MOVES: usize = 24;

/// The person of this name: life-size in metres, standing on y = 0 and facing +z.
pub fn person(name: &str) -> Mesh {
    let (figure, outfit, body) = dressed(name);
    let mut surface = surface::mesh(&body, CELL);
    let mut mesh = atlas::paint(&body, &surface, &Painter::new(&figure, &outfit));
    let floor = surface.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    for p in &mut surface.positions {
        p.y -= floor;
    }
    mesh.positions = surface.positions;
    mesh
}

/// The person in a pose, its arms moved away from the trunk as far as is needed for hands to lie on it, not in it.
fn dressed(name: &str) -> (Figure, Outfit, Body) {
    let mut random = stream(&format!("synth/{name}"));
    let build = Build::draw(&mut random);
    let mut pose = Pose::draw(&mut random);
    let outfit = Outfit::draw(&mut random, &build);
    pose.spread_arms(outfit.breadth());
    let posed = |pose: &Pose| {
        let figure = Figure::new(build.clone(), pose);
        let body = Body::new(&figure, &outfit);
        (figure, body)
    };
    let (mut figure, mut body) = posed(&pose);
    for _ in 0..MOVES {
        let sunk = [0, 1].map(|side| {
            let (hand, fore) = (&figure.hands[side], &figure.forearms[side]);
            let points = [fore.at(0.75, Vec3::ZERO), hand.start, hand.at(0.5, Vec3::ZERO), hand.end];
            points.iter().any(|p| body.trunk_distance(*p) < 0.014 * build.stature)
        });
        if sunk == [false; 2] {
            break;
        }
        (0..2).filter(|side| sunk[*side]).for_each(|side| pose.ease_arm(side));
        (figure, body) = posed(&pose);
    }
    (figure, outfit, body)
}
