//! Fewer triangles for the same surface.

use std::collections::HashMap;

use glam::Vec3;
use meshoptimizer_rs::{
    Attributes, Error, Limits, Positions, SimplifyOptions, SimplifySettings, VertexFlags, Workspace,
    simplify_with_attributes,
};

use crate::mesh::Mesh;

/// Largest error that is accepted to come down to the number asked for, as a share of the surface's size.
const ERROR: f32 = 0.02;
/// What the whole range of a colour is worth, as a share of the surface's size.
const COLOR: f32 = 0.02;
/// How far around a torn edge everything is kept, in edges.
const RINGS: usize = 2;
/// Tries before the surface is left as it is.
const TRIES: usize = 40;

/// Reduces a closed surface of one piece with colours to about `faces` triangles, which stays so: every edge has two of them.
/// 0 keeps all.
///
/// The library lets edges of thin places fall onto one another. What it tore, or tore off, is left as it was in the next try, so that
/// there may be some triangles more than asked for.
///
/// # Errors
/// The library's, for a surface beyond its limits.
pub fn simplify(mut mesh: Mesh, faces: usize) -> Result<Mesh, Error> {
    if faces == 0 || mesh.faces.len() <= faces {
        return Ok(mesh);
    }
    // Most is torn on the last steps: tries with what is left after the first are short.
    if mesh.faces.len() > 10 * faces {
        mesh = simplify(mesh, 5 * faces)?;
    }
    let triangles: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.positions).collect();
    let mut kept = vec![false; mesh.positions.len()];
    for _ in 0..TRIES {
        let reduced = reduce(&mesh, &triangles, &kept, faces)?;
        let torn = torn(&reduced);
        if torn.is_empty() {
            return Ok(compact(&mesh, &reduced));
        }
        // Each position that a torn edge ends in, and those around it that the library took away.
        let mut around = vec![false; kept.len()];
        torn.iter().for_each(|row| around[*row as usize] = true);
        for _ in 0..RINGS {
            let touched = triangles.iter().filter(|t| t.iter().any(|row| around[*row as usize]));
            let touched: Vec<u32> = touched.flatten().copied().collect();
            touched.into_iter().for_each(|row| around[row as usize] = true);
        }
        kept.iter_mut().zip(around).for_each(|(kept, around)| *kept |= around);
    }
    Ok(mesh)
}

fn reduce(mesh: &Mesh, triangles: &[[u32; 3]], kept: &[bool], faces: usize) -> Result<Vec<[u32; 3]>, Error> {
    let positions: Vec<[f32; 3]> = mesh.positions.iter().map(|p| p.to_array()).collect();
    let colors: Vec<f32> = mesh.colors.iter().flat_map(|c| c.to_array()).collect();
    let flag = |kept: &bool| if *kept { VertexFlags::LOCK } else { VertexFlags::EMPTY };
    let flags: Vec<VertexFlags> = kept.iter().map(flag).collect();
    let reduced = simplify_with_attributes(
        triangles.as_flattened(),
        Positions::from_packed(&positions),
        Attributes::from_interleaved(&colors, mesh.colors.len(), 3, 3, 0)?,
        &[COLOR; 3],
        Some(&flags),
        SimplifySettings {
            target_index_count: 3 * faces,
            target_error: ERROR,
            options: SimplifyOptions::REGULARIZE_LIGHT,
        },
        // The memory of the surface is ours; the library would stop at a gigabyte.
        &mut Workspace::new(Limits { max_bytes: usize::MAX, max_work: u64::MAX }),
    )?;
    Ok(reduced.indices.as_chunks::<3>().0.to_vec())
}

/// Positions at the ends of edges that do not have two triangles which run along them in opposite directions; where there are
/// none, those of all pieces but the largest.
fn torn(triangles: &[[u32; 3]]) -> Vec<u32> {
    let sides = |&[a, b, c]: &[u32; 3]| [(a, b), (b, c), (c, a)];
    // The triangle that runs along each edge, in each direction.
    let mut along = HashMap::with_capacity(3 * triangles.len());
    let mut torn = Vec::new();
    for (face, triangle) in triangles.iter().enumerate() {
        for (from, to) in sides(triangle) {
            if from == to || along.insert((from, to), face).is_some() {
                torn.extend([from, to]);
            }
        }
    }
    torn.extend(
        along.keys().filter(|&&(from, to)| !along.contains_key(&(to, from))).flat_map(|&(a, b)| [a, b]),
    );
    if torn.is_empty() {
        let across = |face: usize| sides(&triangles[face]).map(|(from, to)| along[&(to, from)]);
        torn = lesser_pieces(triangles.len(), across).flat_map(|face| triangles[face]).collect();
    }
    torn.sort_unstable();
    torn.dedup();
    torn
}

/// The faces that are not in the largest piece. `across` tells a face's neighbours.
fn lesser_pieces(faces: usize, across: impl Fn(usize) -> [usize; 3]) -> impl Iterator<Item = usize> {
    let mut piece = vec![usize::MAX; faces];
    let mut sizes = Vec::new();
    for first in 0..faces {
        if piece[first] != usize::MAX {
            continue;
        }
        piece[first] = sizes.len();
        let (mut waiting, mut size) = (vec![first], 0);
        while let Some(face) = waiting.pop() {
            size += 1;
            for next in across(face) {
                if piece[next] == usize::MAX {
                    piece[next] = sizes.len();
                    waiting.push(next);
                }
            }
        }
        sizes.push(size);
    }
    let largest = (0..sizes.len()).max_by_key(|i| sizes[*i]);
    (0..faces).filter(move |face| Some(piece[*face]) != largest)
}

fn compact(mesh: &Mesh, triangles: &[[u32; 3]]) -> Mesh {
    let mut rows = vec![u32::MAX; mesh.positions.len()];
    let mut kept = Vec::new();
    let mut place = |row: u32| {
        let place = &mut rows[row as usize];
        if *place == u32::MAX {
            *place = kept.len() as u32;
            kept.push(row as usize);
        }
        *place
    };
    let triangles: Vec<[u32; 3]> = triangles.iter().map(|t| t.map(&mut place)).collect();
    let of = |all: &[Vec3]| kept.iter().map(|row| all[*row]).collect();
    Mesh::colored(of(&mesh.positions), of(&mesh.colors), triangles)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A fan of thin fins on a plate: what collapses onto itself where nothing is kept.
    #[test]
    fn thin_places_stay_closed() {
        use crate::fuse::grid::Grid;
        let n = 48;
        let mut grid = Grid {
            origin: Vec3::ZERO,
            cell: 1.0,
            counts: glam::USizeVec3::splat(n),
            values: vec![1.0; n * n * n],
        };
        for row in 0..grid.values.len() {
            let p = grid.place(row);
            let fin =
                ((p.x * 0.9).sin().abs() - 0.3).max((p.y - 24.0).abs() - 18.0).max((p.z - 24.0).abs() - 18.0);
            let plate = (p.y - 10.0).abs() - 3.0;
            grid.values[row] = fin.min(plate).max((p.x - 24.0).abs() - 20.0).max((p.z - 24.0).abs() - 20.0);
        }
        grid.keep_one_body();
        let (positions, triangles) = grid.surface();
        assert!(torn(&triangles).is_empty());
        let (all, colors) = (triangles.len(), vec![Vec3::ONE; positions.len()]);
        let mesh = Mesh::colored(positions, colors, triangles);
        let reduced = simplify(mesh.clone(), all / 8).expect("reduced");
        reduced.check().expect("drawable");
        let triangles: Vec<[u32; 3]> = reduced.faces.iter().map(|face| face.positions).collect();
        assert!(torn(&triangles).is_empty());
        assert!(triangles.len() < all / 4, "{} of {all}", triangles.len());
        assert_eq!(simplify(mesh, 0).expect("the same").faces.len(), all);
    }

    /// Beads on threads that hang from a plate: what is torn through where nothing is kept.
    #[test]
    fn what_hangs_by_a_thread_stays_in_one_piece() {
        use crate::fuse::grid::Grid;
        let n = 96;
        let counts = glam::USizeVec3::splat(n);
        let mut grid = Grid { origin: Vec3::ZERO, cell: 1.0, counts, values: vec![1.0; n * n * n] };
        for row in 0..grid.values.len() {
            let p = grid.place(row);
            let (x, z) = ((p.x / 24.0).round(), (p.z / 24.0).round());
            let thick = 0.7 + 0.2 * x + 3.0 * (p.y * (0.15 + 0.06 * z)).sin().max(0.0);
            let thread = (p.x - 24.0 * x).hypot(p.z - 24.0 * z) - thick;
            grid.values[row] = thread.min(p.y - 12.0).max((p - 48.0).abs().max_element() - 42.0);
        }
        grid.keep_one_body();
        let (positions, triangles) = grid.surface();
        assert!(torn(&triangles).is_empty());
        let (all, colors) = (triangles.len(), vec![Vec3::ONE; positions.len()]);
        let reduced = simplify(Mesh::colored(positions, colors, triangles), all / 100).expect("reduced");
        let reduced: Vec<[u32; 3]> = reduced.faces.iter().map(|face| face.positions).collect();
        assert!(torn(&reduced).is_empty());
        assert!(reduced.len() < all / 10, "{} of {all}", reduced.len());
    }

    #[test]
    fn a_hole_is_torn() {
        let closed = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        assert!(torn(&closed).is_empty());
        assert_eq!(torn(&closed[..3]), [0, 2, 3]);
        assert_eq!(torn(&[[0, 1, 2], [0, 1, 2]]), [0, 1, 2]);
    }

    #[test]
    fn a_second_piece_is_torn_off() {
        let closed = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        // A pyramid beside it, of more triangles; then one that shares a position with it.
        let pyramid = [[4, 5, 8], [5, 6, 8], [6, 7, 8], [7, 4, 8], [6, 5, 4], [7, 6, 4]];
        assert_eq!(torn(&[&closed[..], &pyramid].concat()), [0, 1, 2, 3]);
        let touching = pyramid.map(|face| face.map(|row| if row == 8 { 3 } else { row }));
        assert_eq!(torn(&[&closed[..], &touching].concat()), [0, 1, 2, 3]);
    }
}
