//! Hands that a pose has put into the body.

use glam::Vec3;
use kiddo::SquaredEuclidean;

use super::ORDER;
use super::net::{Net, coordinates, tree};
use crate::synth::part::Kind;

/// Every so many vertices of a hand are tried.
const STEP: usize = 4;
/// Further from the nearest skin than this, metres, a place is not inside it.
const REACH: f32 = 0.07;

/// Which hand of `body`, left or right, comes nearer to trunk or legs than `gap` metres, or lies in them.
pub fn sunk(body: &Net, gap: f32) -> [bool; 2] {
    let normals = body.normals();
    let owner = |row: &usize| ORDER[body.vertices[*row].part()];
    let rows = 0..body.vertices.len();
    let solid: Vec<usize> =
        rows.clone().filter(|row| matches!(owner(row).0, Kind::Trunk | Kind::Leg)).collect();
    if solid.is_empty() {
        return [false; 2];
    }
    let tree = tree(solid.iter().map(|row| body.vertices[*row].posed));
    [0, 1].map(|side| {
        let hand = rows.clone().filter(|row| owner(row) == (Kind::Hand, side)).step_by(STEP);
        let hand: Vec<Vec3> = hand.map(|row| body.vertices[row].posed).collect();
        let places = coordinates(hand.iter().copied());
        let found = tree.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
        hand.iter().zip(&found).any(|(p, found)| {
            let nearest = solid[found.item as usize];
            let out = (*p - body.vertices[nearest].posed).dot(normals[nearest]);
            found.distance < REACH * REACH && out < gap
        })
    })
}
