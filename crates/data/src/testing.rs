//! Small data sets for tests.

use std::sync::{Arc, OnceLock};

use glam::Vec3;
use tempfile::TempDir;

use crate::dataset::{Folder, Layout, Split};
use crate::prepare::{DataConfig, ViewsConfig};
use crate::scan::{Collection, normalise};
use snapsnap_mesh::mesh::{Face, Material, Mesh};
use snapsnap_people::{Detail, synth};

/// One synthetic person in front of the cameras.
pub fn person() -> &'static Mesh {
    static PERSON: OnceLock<Mesh> = OnceLock::new();
    PERSON.get_or_init(|| {
        let mut mesh = synth::person("train/1/25", None, Detail::Fine);
        normalise(&mut mesh, Collection::Other, None).expect("has height");
        mesh
    })
}

/// An inclined rectangle, visible from both sides.
pub fn rectangle() -> Mesh {
    let (right, up) = (Vec3::new(0.8, 0.0, 0.25), Vec3::new(0.1, 0.9, 0.2));
    let centre = Vec3::new(0.0, 0.9, 0.05);
    let corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)];
    let positions = corners.map(|(a, b)| centre + a * right + b * up).to_vec();
    mesh(positions, [[0, 1, 2, 3]], Vec3::new(0.9, 0.5, 0.2))
}

/// Centre and half size of [`block`]. All of its views differ.
pub const BLOCK: (Vec3, Vec3) = (Vec3::new(0.06, 0.9, 0.03), Vec3::new(0.3, 0.8, 0.17));

/// An axis-aligned block.
pub fn block() -> Mesh {
    let (middle, half) = BLOCK;
    let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 2.0 - 1.0;
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let positions = (0..8).map(|i| middle + half * corner(i)).collect();
    mesh(positions, sides, Vec3::new(0.3, 0.6, 0.8))
}

/// A block, and another one that `change` moves and scales.
pub fn two_blocks(change: impl Fn(Vec3) -> Vec3) -> Mesh {
    let (mut mesh, other) = (block(), block());
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(other.positions.into_iter().map(change));
    mesh.faces
        .extend(other.faces.iter().map(|f| Face { positions: f.positions.map(|row| row + first), ..*f }));
    mesh
}

/// A mesh of one colour, made of quadrilaterals.
fn mesh<const N: usize>(positions: Vec<Vec3>, faces: [[u32; 4]; N], color: Vec3) -> Mesh {
    let faces = faces.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]);
    Mesh {
        positions,
        faces: faces.map(|positions| Face { positions, texcoords: None, material: 0 }).collect(),
        materials: vec![Material { color, ..Material::default() }],
        ..Mesh::default()
    }
}

/// Distance of a point from the surface of [`block`].
pub fn off_block(p: Vec3) -> f32 {
    let (middle, half) = BLOCK;
    let out = (p - middle).abs() - half;
    (out.max(Vec3::ZERO).length() + out.max_element().min(0.0)).abs()
}

/// A data set like [`made`], with the default config and these values of `views`.
pub fn data_set(
    mesh: &Mesh,
    layout: Layout,
    resolution: u32,
    views: usize,
    high_resolution: bool,
    subjects: usize,
) -> (TempDir, Arc<Folder>) {
    let views = ViewsConfig { layout, resolution, count: views, high_resolution, ..ViewsConfig::default() };
    made(&DataConfig { views, ..DataConfig::default() }, mesh, subjects)
}

/// A data set of this config, with `subjects` copies of `mesh` in the split train.
pub fn made(config: &DataConfig, mesh: &Mesh, subjects: usize) -> (TempDir, Arc<Folder>) {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let root = temporary.path().join(format!("people_{}_{}", config.views.resolution, config.views.count));
    let people = (0..subjects).map(|subject| (Split::Train, format!("{subject:04}"), mesh));
    let folder = config.make(&root, "a test", people).expect("makes the folder");
    (temporary, folder)
}
