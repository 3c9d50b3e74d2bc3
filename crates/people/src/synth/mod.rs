//! People of simple shapes: an articulated body of signed distances, posed and dressed, meshed and painted.
//!
//! A name determines a person completely, on every machine.

mod anatomy;
pub(crate) mod atlas;
pub(crate) mod body;
pub(crate) mod outfit;
pub(crate) mod paint;
pub(crate) mod part;
pub(crate) mod surface;
#[cfg(test)]
mod tests;

use crate::Detail;
use crate::figure::{Build, Figure, Pose};
use crate::poses::Poses;
use body::Body;
use outfit::Outfit;
use paint::{FACE, Painter};
use snapsnap_base::random::stream;
use snapsnap_mesh::mesh::Mesh;

/// Side of the cells that fine bodies are meshed with, metres.
const CELL: f32 = 0.005;

/// The person of this name: life-size in metres, standing on y = 0 and facing +z.
/// Often in one of `poses`.
pub fn person(name: &str, poses: Option<&Poses>, detail: Detail) -> Mesh {
    let (figure, outfit, body) = dressed(name, poses);
    let surface = surface::mesh(&body, detail.length(CELL));
    let mut mesh = atlas::paint(&body, &surface, &Painter::new(&figure, &outfit, &FACE, [false; 2]), detail);
    mesh.positions = surface.positions;
    stand(&mut mesh);
    mesh
}

/// Moves a mesh vertically so that its lowest point is at 0.
pub(crate) fn stand(mesh: &mut Mesh) {
    let floor = mesh.bounds().0.y;
    mesh.positions.iter_mut().for_each(|p| p.y -= floor);
}

/// The posed and dressed person. Hands lie outside of the trunk.
fn dressed(name: &str, poses: Option<&Poses>) -> (Figure, Outfit, Body) {
    let mut random = stream(&format!("synth/{name}"));
    let build = Build::draw(&mut random);
    let mut pose = Poses::any(poses, &mut random);
    let outfit = Outfit::draw(&mut random, &build);
    pose.spread_arms(outfit.breadth());
    let posed = |pose: &Pose| {
        let figure = Figure::new(build.clone(), pose);
        let body = Body::new(&figure, &outfit);
        (figure, body)
    };
    let sunk = |(figure, body): &(Figure, Body)| {
        [0, 1].map(|side| {
            let (hand, fore) = (&figure.hands[side], &figure.forearms[side]);
            let points = [fore.point(0.75), hand.start, hand.point(0.5), hand.end];
            points.iter().any(|p| body.trunk_distance(*p) < 0.014 * build.stature)
        })
    };
    let (figure, body) = pose.free_hands(posed, sunk);
    (figure, outfit, body)
}
