//! Reduction of a surface to fewer triangles.

use glam::Vec3;
use meshoptimizer_rs::{
    Attributes, Error, Limits, Positions, SimplifyOptions, SimplifySettings, VertexFlags, Workspace,
    simplify_with_attributes,
};

use super::manifold::{Manifold, manifold};
use crate::mesh::Mesh;

/// Largest accepted error, as a share of the surface's size.
const ERROR: f32 = 0.02;
/// Error of a change over the whole range of a colour, as a share of the surface's size.
const COLOR: f32 = 0.02;
/// Width in edges of the rings around a neck that are kept.
const RINGS: usize = 2;
/// Most tries before the surface is returned as it is.
const TRIES: usize = 40;

/// Reduces a closed surface of one piece with vertex colours to about `faces` triangles; 0 keeps all. The result is
/// closed and one piece, too.
///
/// The library lets edges of thin parts coincide, which [`manifold`] repairs. If pieces come off, the next try keeps
/// the necks at which they came off. The result may therefore have more triangles than `faces`.
///
/// # Errors
/// The library's error for a surface beyond its limits.
pub fn simplify(mut mesh: Mesh, faces: usize) -> Result<Mesh, Error> {
    if faces == 0 || mesh.faces.len() <= faces {
        return Ok(mesh);
    }
    // Pieces come off in the last steps. Tries on a surface that is already reduced take less time.
    if mesh.faces.len() > 10 * faces {
        mesh = simplify(mesh, 5 * faces)?;
    }
    let triangles: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.positions).collect();
    let mut kept = vec![false; mesh.positions.len()];
    for _ in 0..TRIES {
        // A kept position counts as two triangles. At least half of `faces` are left to the rest.
        let wanted = faces.max(faces / 2 + 2 * kept.iter().filter(|kept| **kept).count());
        let reduced = reduce(&mesh, &triangles, &kept, wanted.min(triangles.len()))?;
        let Some(reduced) = manifold(&mesh.positions, reduced) else { break };
        // A thin body may vanish.
        if reduced.triangles.is_empty() {
            break;
        }
        let Some(necks) = necks(&triangles, mesh.positions.len(), &reduced) else {
            mesh.colors = reduced.sources.iter().map(|row| mesh.colors[*row as usize]).collect();
            mesh.positions = reduced.places;
            return Ok(compact(&mesh, &reduced.triangles));
        };
        kept.iter_mut().zip(necks).for_each(|(kept, neck)| *kept |= neck);
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
        // The library's own limit is a gigabyte.
        &mut Workspace::new(Limits { max_bytes: usize::MAX, max_work: u64::MAX }),
    )?;
    Ok(reduced.indices.as_chunks::<3>().0.to_vec())
}

/// For each position whether it is at a neck or in the rings around a neck. At a neck, the reduction took the surface
/// of `triangles` apart. `None` if the reduced surface is one piece.
fn necks(triangles: &[[u32; 3]], positions: usize, reduced: &Manifold) -> Option<Vec<bool>> {
    let (piece, count) = reduced.pieces();
    if count <= 1 {
        return None;
    }
    // Removed positions belong to the piece of the nearest remaining position. Necks are where pieces meet.
    let mut owner = vec![usize::MAX; positions];
    let mut neck = vec![false; positions];
    for (triangle, piece) in reduced.triangles.iter().zip(piece) {
        for row in triangle.map(|row| reduced.sources[row as usize] as usize) {
            neck[row] |= owner[row] != usize::MAX && owner[row] != piece;
            owner[row] = piece;
        }
    }
    loop {
        let before = owner.clone();
        for triangle in triangles.iter().map(|t| t.map(|row| row as usize)) {
            let is_known = |row: &usize| before[*row] != usize::MAX;
            if let Some(known) = triangle.iter().find(|row| is_known(row)) {
                triangle.iter().filter(|row| !is_known(row)).for_each(|row| owner[*row] = before[*known]);
            }
        }
        if owner == before {
            break;
        }
    }
    for triangle in triangles.iter().map(|t| t.map(|row| row as usize)) {
        if triangle.iter().any(|row| owner[*row] != owner[triangle[0]]) {
            triangle.iter().for_each(|row| neck[*row] = true);
        }
    }
    for _ in 0..RINGS {
        let touched = triangles.iter().filter(|t| t.iter().any(|row| neck[*row as usize]));
        let touched: Vec<u32> = touched.flatten().copied().collect();
        touched.into_iter().for_each(|row| neck[row as usize] = true);
    }
    Some(neck)
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
    use crate::fuse::grid::tests::{grid, is_closed, volume};

    /// The surface in a grid of n³ corners with a distance of 1.
    fn surface(n: usize, value: impl Fn(Vec3) -> f32) -> Mesh {
        let steps = 0.5 * (n - 1) as f32;
        let mut grid = grid(n, |p| value((steps * (p + 1.0)).round()));
        grid.keep_one_body();
        let (positions, triangles) = grid.surface();
        let colors = vec![Vec3::ONE; positions.len()];
        Mesh::colored(positions, colors, triangles)
    }

    fn triangles(mesh: &Mesh) -> Vec<[u32; 3]> {
        mesh.faces.iter().map(|face| face.positions).collect()
    }

    /// Reduces a surface and checks that it is closed and one piece.
    fn reduced(mesh: &Mesh, faces: usize) -> Mesh {
        let reduced = simplify(mesh.clone(), faces).expect("reduced");
        let found = triangles(&reduced);
        assert!(!found.is_empty() && is_closed(&found), "{faces} of {}", mesh.faces.len());
        let again = manifold(&reduced.positions, found).expect("closed");
        assert_eq!(again.pieces().1, 1, "{faces} of {}", mesh.faces.len());
        reduced
    }

    /// Reduces a surface and checks that it keeps its volume, too, and has no folds.
    fn check(mesh: &Mesh, faces: usize, most: usize, within: f64) {
        let reduced = reduced(mesh, faces);
        reduced.check().expect("drawable");
        let found = triangles(&reduced);
        assert!(found.len() <= most && found.len() > faces / 2, "{} instead of {faces}", found.len());
        let again = manifold(&reduced.positions, found.clone()).expect("closed");
        assert!(again.places == reduced.positions && again.triangles.len() == found.len());
        let (all, found) = (volume(&mesh.positions, &triangles(mesh)), volume(&reduced.positions, &found));
        assert!((found / all - 1.0).abs() < within, "{found} instead of {all}");
    }

    /// Thin fins on a plate, whose sides coincide after a reduction.
    #[test]
    fn thin_places_stay_closed() {
        let box_of = |p: Vec3, half: Vec3| ((p - 24.0).abs() - half).max_element();
        let mesh = surface(48, |p| {
            let fin = ((p.x * 0.9).sin().abs() - 0.3).max(box_of(p, Vec3::splat(18.0)));
            fin.min((p.y - 10.0).abs() - 3.0).max(box_of(p, Vec3::new(20.0, 24.0, 20.0)))
        });
        for share in [8, 30] {
            check(&mesh, mesh.faces.len() / share, mesh.faces.len() / share, 0.03);
        }
        assert_eq!(simplify(mesh.clone(), 0).expect("the same").faces.len(), mesh.faces.len());
    }

    /// Noise of several densities has tunnels, necks and specks.
    #[test]
    fn noise_stays_one_closed_piece() {
        for seed in 0..100_usize {
            let n = 5 + seed % 5;
            let mesh = surface(n, |p| {
                let mixed = (p.dot(Vec3::new(12.9898, 78.233, 37.719)) + seed as f32).sin() * 43758.547;
                mixed.fract().abs() - 0.3 - 0.05 * (seed % 9) as f32
            });
            let all = mesh.faces.len();
            for faces in [3, all / 10, all / 3] {
                reduced(&mesh, faces);
            }
        }
    }

    /// The two sides of a flat body coincide after a reduction.
    #[test]
    fn a_flat_body_does_not_vanish() {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, 1e-3 * Vec3::Z];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let off = manifold(&positions, vec![[0, 2, 1], [0, 1, 2]]).expect("closed");
        assert!(off.triangles.is_empty());
        let mesh = Mesh::colored(positions, vec![Vec3::ONE; 4], triangles);
        for faces in 1..4 {
            assert_eq!(simplify(mesh.clone(), faces).expect("the same").faces.len(), 4);
        }
    }

    /// Beads on threads at a plate; a reduction without kept necks separates them.
    #[test]
    fn beads_on_threads_stay_in_one_piece() {
        let mesh = surface(96, |p| {
            let (x, z) = ((p.x / 24.0).round(), (p.z / 24.0).round());
            let thick = 0.7 + 0.2 * x + 3.0 * (p.y * (0.15 + 0.06 * z)).sin().max(0.0);
            let thread = (p.x - 24.0 * x).hypot(p.z - 24.0 * z) - thick;
            thread.min(p.y - 12.0).max((p - 48.0).abs().max_element() - 42.0)
        });
        let triangles = triangles(&mesh);
        let off = reduce(&mesh, &triangles, &vec![false; mesh.positions.len()], triangles.len() / 100);
        let off = manifold(&mesh.positions, off.expect("reduced")).expect("closed");
        assert!(off.pieces().1 > 1);
        // Necks are kept; beads are three cubes thick, and the library may be off by two.
        check(&mesh, triangles.len() / 100, triangles.len() / 25, 0.05);
    }
}
