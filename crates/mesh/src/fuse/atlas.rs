//! Texture atlas of a surface. Charts, pieces that face one direction, are projected and packed side by side.

use std::collections::{HashSet, VecDeque};

use glam::{IVec2, Vec2, Vec3};

use super::manifold::across;
use crate::mesh::Mesh;

/// Share of the texture that charts fill in the first try.
const FILLED: f32 = 0.75;
/// Factor by which texels grow from one try to the next.
const COARSER: f32 = 1.06;
/// Padding around each chart in texels. It gets the chart's colours, so that filters do not reach other charts.
const PADDING: i32 = 3;
/// Least cosine between the normal of a chart's face and the chart's axis.
const FLATTEST: f32 = 0.4;
/// Largest number of tries to pack the charts.
const TRIES: usize = 200;
/// Largest number of successive tries that have too many charts and do not reduce their number.
const IN_VAIN: usize = 10;

/// A texel of the surface.
pub struct Texel {
    /// Index into the texture, row by row.
    pub at: u32,
    /// Position, metres from the body's centre.
    pub place: Vec3,
    /// Unit normal, outwards.
    pub normal: Vec3,
    /// Interpolated between the face's corners.
    pub color: Vec3,
}

/// Layout of a mesh's faces on a square texture.
pub struct Atlas {
    /// Texture coordinates of each face's corners, (0, 0) at the lower left.
    pub texcoords: Vec<[Vec2; 3]>,
    /// Texels of the faces.
    pub texels: Vec<Texel>,
}

/// Faces whose projections along an axis do not overlap.
struct Chart {
    axis: usize,
    faces: Vec<usize>,
    /// First and last texel of the chart before packing.
    low: IVec2,
    high: IVec2,
}

/// Lays the faces of `mesh` on a texture of `side`² pixels.
///
/// # Errors
/// If the charts do not fit, or the surface is not closed.
pub fn atlas(mesh: &Mesh, side: usize) -> Result<Atlas, String> {
    let axes: Vec<usize> = (0..mesh.faces.len()).map(|face| axis(mesh, face)).collect();
    let triangles: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.positions).collect();
    let across = across(&mesh.positions, &triangles).ok_or("the surface is not closed")?;
    let area = |face: usize| {
        let [a, b, c] = flat(mesh, face, axes[face], 1.0);
        0.5 * (b - a).perp_dot(c - a).abs()
    };
    let area: f32 = (0..axes.len()).map(area).sum();
    let mut texel = (area / (FILLED * (side * side) as f32)).sqrt();
    let (mut fewest, mut vain) = (usize::MAX, 0);
    for _ in 0..TRIES {
        let charts = charts(mesh, &axes, &across, texel);
        if let Some(places) = pack(&charts, side as i32) {
            return Ok(lay(mesh, &charts, &places, side, texel));
        }
        // Coarser texels make charts smaller, down to one texel and its padding, and at first also fewer.
        let has_room = charts.len() * (1 + 2 * PADDING as usize).pow(2) <= side * side;
        vain = if has_room || charts.len() < fewest { 0 } else { vain + 1 };
        fewest = fewest.min(charts.len());
        if vain == IN_VAIN {
            break;
        }
        texel *= COARSER;
    }
    Err(format!("a texture of {side}² pixels has no room for the pieces of the surface"))
}

fn corners(mesh: &Mesh, face: usize) -> [Vec3; 3] {
    mesh.faces[face].positions.map(|row| mesh.positions[row as usize])
}

/// Normal of a face with twice the face's area as its length.
fn normal(mesh: &Mesh, face: usize) -> Vec3 {
    let [a, b, c] = corners(mesh, face);
    (b - a).cross(c - a)
}

/// The axis nearest to a face's normal: 0 to 2 are x, y and z, 3 to 5 their opposites.
fn axis(mesh: &Mesh, face: usize) -> usize {
    let normal = normal(mesh, face);
    let along = (0..3).max_by(|i, j| normal[*i].abs().total_cmp(&normal[*j].abs())).expect("three");
    if normal[along] < 0.0 { along + 3 } else { along }
}

/// Cosine between a face's normal and an axis.
fn cosine(mesh: &Mesh, face: usize, axis: usize) -> f32 {
    let along = normal(mesh, face).normalize_or_zero()[axis % 3];
    if axis < 3 { along } else { -along }
}

/// Corners of a face, projected along an axis, in texels.
fn flat(mesh: &Mesh, face: usize, axis: usize, texel: f32) -> [Vec2; 3] {
    let (right, up) = [(2, 1), (0, 2), (0, 1)][axis % 3];
    corners(mesh, face).map(|p| Vec2::new(p[right], p[up]) / texel)
}

fn charts(mesh: &Mesh, axes: &[usize], across: &[usize], texel: f32) -> Vec<Chart> {
    let mut taken = vec![false; axes.len()];
    let mut charts = Vec::new();
    for seed in 0..axes.len() {
        if taken[seed] {
            continue;
        }
        let mut chart = Chart { axis: axes[seed], faces: Vec::new(), low: IVec2::MAX, high: IVec2::MIN };
        let mut covered = HashSet::new();
        let mut waiting = VecDeque::from([seed]);
        while let Some(face) = waiting.pop_front() {
            if taken[face] {
                continue;
            }
            let triangle = flat(mesh, face, chart.axis, texel);
            let mut texels = Vec::new();
            inside(triangle, |at, _| texels.push(at));
            // A face that overlaps this chart in the projection goes into another chart.
            if texels.iter().any(|at| covered.contains(at)) {
                continue;
            }
            covered.extend(texels);
            taken[face] = true;
            chart.faces.push(face);
            for corner in triangle {
                chart.low = chart.low.min(corner.floor().as_ivec2());
                chart.high = chart.high.max(corner.floor().as_ivec2());
            }
            let next = across[3 * face..3 * face + 3].iter().map(|side| side / 3);
            waiting.extend(next.filter(|next| !taken[*next] && cosine(mesh, *next, chart.axis) > FLATTEST));
        }
        charts.push(chart);
    }
    charts
}

/// Calls `each` with the texels whose centres lie in a triangle and with their barycentric weights.
fn inside(triangle: [Vec2; 3], mut each: impl FnMut(IVec2, Vec3)) {
    let [a, b, c] = triangle;
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 {
        return;
    }
    let (low, high) = (a.min(b).min(c).floor().as_ivec2(), a.max(b).max(c).ceil().as_ivec2());
    for y in low.y..=high.y {
        for x in low.x..=high.x {
            let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let weights =
                Vec3::new((b - p).perp_dot(c - p), (c - p).perp_dot(a - p), (a - p).perp_dot(b - p)) / area;
            if weights.min_element() > 0.0 {
                each(IVec2::new(x, y), weights);
            }
        }
    }
}

/// Shelf packing, the highest charts first. Returns the position of each chart's first texel, `None` without room.
fn pack(charts: &[Chart], side: i32) -> Option<Vec<IVec2>> {
    let size = |chart: &Chart| chart.high - chart.low + 1 + 2 * PADDING;
    let mut order: Vec<usize> = (0..charts.len()).collect();
    order.sort_by_key(|i| (-size(&charts[*i]).y, -size(&charts[*i]).x));
    let mut places = vec![IVec2::ZERO; charts.len()];
    let (mut at, mut shelf) = (IVec2::ZERO, 0);
    for i in order {
        let size = size(&charts[i]);
        if at.x + size.x > side {
            (at, shelf) = (IVec2::new(0, at.y + shelf), 0);
        }
        shelf = shelf.max(size.y);
        if size.x > side || at.y + shelf > side {
            return None;
        }
        places[i] = at + PADDING;
        at.x += size.x;
    }
    Some(places)
}

fn lay(mesh: &Mesh, charts: &[Chart], places: &[IVec2], side: usize, texel: f32) -> Atlas {
    let normals = mesh.normals();
    let mut texcoords = vec![[Vec2::ZERO; 3]; mesh.faces.len()];
    let mut texels = Vec::new();
    for (chart, place) in charts.iter().zip(places) {
        let moved = (*place - chart.low).as_vec2();
        for &face in &chart.faces {
            let triangle = flat(mesh, face, chart.axis, texel).map(|corner| corner + moved);
            texcoords[face] = triangle.map(|p| Vec2::new(p.x, side as f32 - p.y) / side as f32);
            let rows = mesh.faces[face].positions;
            let of = |all: &[Vec3], w: Vec3| {
                w.x * all[rows[0] as usize] + w.y * all[rows[1] as usize] + w.z * all[rows[2] as usize]
            };
            inside(triangle, |at, weights| {
                texels.push(Texel {
                    at: at.y as u32 * side as u32 + at.x as u32,
                    place: of(&mesh.positions, weights),
                    normal: of(&normals, weights).normalize_or_zero(),
                    color: of(&mesh.colors, weights),
                });
            });
        }
    }
    Atlas { texcoords, texels }
}

/// Dilates the colours into empty texels by [`PADDING`].
pub fn spread(texture: &mut [Option<[u8; 3]>], side: usize) {
    for _ in 0..PADDING {
        // Collected first, so that colours spread by one texel per round.
        let mut found = Vec::new();
        for row in (0..texture.len()).filter(|row| texture[*row].is_none()) {
            let (x, y) = (row % side, row / side);
            let columns = x.saturating_sub(1)..(x + 2).min(side);
            let around = (y.saturating_sub(1)..(y + 2).min(side))
                .flat_map(|y| columns.clone().map(move |x| y * side + x))
                .filter_map(|row| texture[row]);
            let (sum, count) = around.fold(([0_u16; 3], 0), |(sum, n), color| {
                ([0, 1, 2].map(|c| sum[c] + u16::from(color[c])), n + 1)
            });
            if count > 0 {
                found.push((row, sum.map(|c| ((c + count / 2) / count) as u8)));
            }
        }
        found.into_iter().for_each(|(row, color)| texture[row] = Some(color));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuse::grid::tests::grid;

    /// Two balls on a stick, a body that covers a part of itself along every axis.
    fn dumbbell() -> Mesh {
        let (positions, faces) = grid(40, |p| {
            let ball = |x: f32| (p - Vec3::new(x, 0.0, 0.0)).length() - 0.35;
            let stick = Vec2::new(p.y, p.z).length().max(p.x.abs() - 0.5) - 0.12;
            ball(-0.5).min(ball(0.5)).min(stick)
        })
        .surface();
        let colors = vec![Vec3::ONE; positions.len()];
        Mesh::colored(positions, colors, faces)
    }

    #[test]
    fn no_texel_belongs_to_two_places_and_every_face_has_its_own_part() {
        let mesh = dumbbell();
        let side = 256;
        let atlas = atlas(&mesh, side).expect("room");
        let mut places: Vec<u32> = atlas.texels.iter().map(|texel| texel.at).collect();
        let count = places.len();
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), count);
        assert!(4 * count > side * side, "{count} of {}", side * side);
        for texcoord in atlas.texcoords.as_flattened() {
            assert!(texcoord.min_element() > 0.0 && texcoord.max_element() < 1.0, "{texcoord}");
        }
        for texel in &atlas.texels {
            assert!((texel.normal.length() - 1.0).abs() < 1e-4 && texel.place.is_finite());
        }
    }

    #[test]
    fn a_texture_without_room_is_refused() {
        assert!(atlas(&dumbbell(), 8).is_err());
    }

    #[test]
    fn colours_spread_as_far_as_filters_reach() {
        let mut texture = vec![None; 81];
        texture[40] = Some([255, 7, 0]);
        spread(&mut texture, 9);
        let reached = texture.iter().filter(|color| **color == Some([255, 7, 0])).count();
        assert_eq!(reached, (2 * PADDING as usize + 1).pow(2));
    }
}
