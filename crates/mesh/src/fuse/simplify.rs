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

/// Reduces a closed surface with colours to about `faces` triangles, which stays closed: every edge has two of them. 0 keeps
/// all.
///
/// The library lets edges of thin places fall onto one another. What it tore is left as it was in the next try, so that
/// there may be some triangles more than asked for.
///
/// # Errors
/// The library's, for a surface beyond its limits.
pub fn simplify(mesh: Mesh, faces: usize) -> Result<Mesh, Error> {
    if faces == 0 || mesh.faces.len() <= faces {
        return Ok(mesh);
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

/// Positions at the ends of edges that do not have two triangles which run along them in opposite directions.
fn torn(triangles: &[[u32; 3]]) -> Vec<u32> {
    // How many triangles run along each edge from its smaller end to its larger one, and how many back.
    let mut edges: HashMap<(u32, u32), [u8; 2]> = HashMap::with_capacity(3 * triangles.len() / 2);
    for &[a, b, c] in triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let count = &mut edges.entry((from.min(to), from.max(to))).or_default()[usize::from(from > to)];
            *count = count.saturating_add(1);
        }
    }
    let torn = edges.into_iter().filter(|((a, b), count)| *count != [1, 1] || a == b);
    let mut torn: Vec<u32> = torn.flat_map(|((a, b), _)| [a, b]).collect();
    torn.sort_unstable();
    torn.dedup();
    torn
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

    #[test]
    fn a_hole_is_torn() {
        let closed = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        assert!(torn(&closed).is_empty());
        assert_eq!(torn(&closed[..3]), [0, 2, 3]);
        assert_eq!(torn(&[[0, 1, 2], [0, 1, 2]]), [0, 1, 2]);
    }
}
