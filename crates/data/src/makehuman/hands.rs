//! Hands that a pose has put into the body.

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::files::Library;
use super::net::{Net, PARTS, Vertex};
use super::{ORDER, part_of};
use crate::synth::body::Kind;

/// Every so many vertices of a hand are tried.
const STEP: usize = 4;
/// Further from the nearest skin than this, metres, a place is not inside it.
const REACH: f32 = 0.07;

/// Which hand, left or right, comes nearer to trunk or legs than `gap` metres, or lies in them.
pub fn sunk(library: &Library, posed: &[Vec3], gap: f32) -> [bool; 2] {
    let kinds: Vec<usize> = library.bones.iter().map(|bone| part_of(&bone.name)).collect();
    let vertex = |row: u32| {
        let mut parts = [0.0; PARTS];
        for (bone, share) in &library.weights[row as usize] {
            parts[kinds[*bone as usize]] += share;
        }
        Vertex { rest: Vec3::ZERO, posed: posed[row as usize], parts }
    };
    let body = Net::of(vertex, library.groups.get("body").map_or(&[][..], Vec::as_slice));
    let normals = body.normals();
    let is = |row: &usize, kinds: &[Kind]| kinds.contains(&ORDER[body.vertices[*row].part()].0);
    let solid: Vec<usize> =
        (0..body.vertices.len()).filter(|row| is(row, &[Kind::Trunk, Kind::Leg])).collect();
    let points: Vec<[f32; 3]> = solid.iter().map(|row| body.vertices[*row].posed.to_array()).collect();
    if points.is_empty() {
        return [false; 2];
    }
    let tree: ImmutableKdTree<f32, 3> =
        ImmutableKdTree::new_from_slice(&points).expect("fewer points than u32 can number");
    [0, 1].map(|side| {
        let hand =
            (0..body.vertices.len()).filter(|row| ORDER[body.vertices[*row].part()] == (Kind::Hand, side));
        let hand: Vec<Vec3> = hand.step_by(STEP).map(|row| body.vertices[row].posed).collect();
        let places: Vec<[f32; 3]> = hand.iter().map(|p| p.to_array()).collect();
        let found = tree.query_batch(&places).nearest_one::<SquaredEuclidean<f32>>().execute();
        hand.iter().zip(&found).any(|(p, found)| {
            let nearest = solid[found.item as usize];
            let out = (*p - body.vertices[nearest].posed).dot(normals[nearest]);
            found.distance < REACH * REACH && out < gap
        })
    })
}
