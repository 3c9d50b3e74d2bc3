use std::collections::HashMap;

use glam::Vec3;
use snapsnap_mesh::mesh::pieces;

use super::*;

/// Every edge belongs to two triangles with opposite directions, or to two such pairs where the surface touches
/// itself. All triangles are connected: no holes, no floating parts.
#[test]
fn people_are_closed_and_of_one_piece() {
    for index in 0..6 {
        let mesh = person(&format!("test/{index}"), None, Detail::Fine);
        assert_eq!(mesh.check(), Ok(()));
        assert!(mesh.texcoords.iter().all(|t| (0.0..=1.0).contains(&t.x) && (0.0..=1.0).contains(&t.y)));
        let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
        for face in &mesh.faces {
            let [a, b, c] = face.positions;
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *edges.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
            }
        }
        let open = edges.values().filter(|balance| **balance != 0).count();
        assert_eq!(open, 0, "person {index}: {open} of {} edges are open", edges.len());
        let pieces = pieces(mesh.positions.len(), mesh.faces.iter().map(|face| &face.positions[..]));
        assert!(pieces.iter().all(|piece| *piece == 0), "person {index}");
        // Normals point outwards, and the surface has the volume of a person.
        let corners = mesh.faces.iter().map(|f| f.positions.map(|row| mesh.positions[row as usize]));
        let volume: f32 = corners.map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum();
        let (low, high) = mesh.bounds();
        assert!((0.03..0.4).contains(&volume), "person {index}: {volume} m³");
        assert!(low.y == 0.0 && (1.4..2.2).contains(&high.y), "person {index}: {low} to {high}");
    }
}

/// No pose leaves a hand in the trunk or in a skirt, and hips that fill a skirt show its cloth.
#[test]
fn hands_and_hips_stay_where_they_belong() {
    let (mut skirts, mut filled) = (0, 0);
    for index in 0..60 {
        let (figure, _, body) = dressed(&format!("test/hands/{index}"), None);
        for hand in &figure.hands {
            for share in [0.0, 0.5, 1.0] {
                let depth = body.trunk_distance(hand.point(share));
                assert!(depth > 0.01, "person {index}: {depth} m");
            }
        }
        let Some(drape) = body.parts.iter().find_map(|part| part.drape) else { continue };
        skirts += 1;
        // Outwards from the middle of the hips to the surface.
        for step in 0..24 {
            let (sin, cos) = libm::sincosf(step as f32 * std::f32::consts::PI / 12.0);
            let mut p = Vec3::new(0.0, figure.pelvis.start.y - 0.02, 0.0);
            while body.distance(p, 0.02).0 < 0.0 {
                p += 0.002 * Vec3::new(sin, 0.0, cos);
            }
            let kind = body.parts[body.owner(p, CELL)].kind;
            assert!(p.y < drape.bottom || !matches!(kind, part::Kind::Trunk | part::Kind::Leg), "{kind:?}");
            filled += usize::from(kind == part::Kind::Skirt);
        }
    }
    assert!(skirts > 10 && filled > 10 * skirts, "{skirts} {filled}");
}

/// Coarse people are the fine ones with a quarter of the triangles and texels.
#[test]
fn coarse_people_stand_as_fine_people_do() {
    let [fine, coarse] = [Detail::Fine, Detail::Coarse].map(|detail| person("test/0", None, detail));
    let ((low, high), (coarse_low, coarse_high)) = (fine.bounds(), coarse.bounds());
    assert!((low - coarse_low).abs().max((high - coarse_high).abs()).max_element() < CELL);
    let texels = |mesh: &Mesh| mesh.materials[0].texture.as_ref().expect("has a texture").pixels().len();
    for (fine, coarse) in [(fine.faces.len(), coarse.faces.len()), (texels(&fine), texels(&coarse))] {
        let ratio = fine as f64 / coarse as f64;
        assert!((2.5..5.0).contains(&ratio), "{fine} and {coarse}");
    }
    assert_eq!(Detail::of_pictures(256), Detail::Coarse);
    assert_eq!(Detail::of_pictures(257), Detail::Fine);
}

/// Recorded numbers of a person, the same on every machine.
#[test]
fn a_name_decides_everything() {
    let mesh = person("train/1/0", None, Detail::Fine);
    let other = person("val/1/0", None, Detail::Fine);
    assert_ne!(mesh.positions.len(), other.positions.len());
    let sum = mesh.positions.iter().map(|p| p.as_dvec3()).sum::<glam::DVec3>();
    let texture = mesh.materials[0].texture.as_ref().expect("has a texture");
    let light: u64 = texture.as_raw().iter().map(|b| u64::from(*b)).sum();
    let found =
        (mesh.positions.len(), mesh.faces.len(), light, sum.to_array().map(|v| (v * 1e6).round() as i64));
    assert_eq!(found, (135_820, 271_676, 410_036_455, [1_046_803_328, 129_283_791_533, 5_873_047_485]));
}
