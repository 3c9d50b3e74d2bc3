//! Second surfaces of side views.

use burn::tensor::TensorData;

use super::*;
use crate::prepare::DataConfig;
use crate::testing::made;
use snapsnap_mesh::mesh::{Face, Mesh};
use std::sync::Arc;
use tempfile::TempDir;

/// A block with a slab beside its right side, as an arm hangs beside a flank. The slab is smaller than the block.
fn armed() -> Mesh {
    let (mut mesh, arm) = (block(), block());
    let first = mesh.positions.len() as u32;
    let (middle, half) = BLOCK;
    let beside = Vec3::new(1.5 * half.x, 0.0, 0.0);
    let share = Vec3::new(0.1, 0.6, 0.4);
    mesh.positions.extend(arm.positions.iter().map(|p| middle + beside + share * (*p - middle)));
    mesh.faces.extend(arm.faces.iter().map(|f| Face { positions: f.positions.map(|row| row + first), ..*f }));
    mesh
}

/// A data set of one person, the armed block, in four views with second depths.
fn data_of_armed(resolution: u32) -> (TempDir, Arc<Folder>) {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution, config.views.second_depth) = (4, resolution, true);
    made(&config, &armed(), 1)
}

#[test]
fn samples_carry_the_flank_behind_an_arm() {
    let side = 128;
    let (_temporary, folder) = data_of_armed(side as u32);
    let samples = SampleConfig {
        second_depth: true,
        front_within_degrees: 0.0,
        augment: Augment::none(),
        ..SampleConfig::default()
    };
    let sample = |config: SampleConfig, index: usize| stage1(&folder, config).sample(index).expect("reads");
    let plain = sample(samples.clone(), 0);
    let to_world = Camera::orbit_at_yaw_degrees(0.0, side as u32).world_to_camera.inverse();
    let (middle, half) = BLOCK;
    // The right camera sees the block's flank behind the arm, the left one the arm's inner side behind the block.
    for (map, flank) in [(0, middle.x + half.x), (1, middle.x + 1.4 * half.x)] {
        let second = there(&plain.second_points, &plain.second_valid, map, side);
        let seen = there(&plain.points, &plain.valid, 2 + map, side).len();
        assert!((200..seen).contains(&second.len()), "{} of {seen}", second.len());
        let off = |p: &Vec3| (to_world.apply(p.as_dvec3()).x as f32 - flank).abs();
        let worst = second.iter().map(off).fold(0.0, f32::max);
        assert!(worst < 1e-5, "map {map}: {worst} m");
    }
    let without = sample(SampleConfig { second_depth: false, ..samples.clone() }, 0);
    assert_eq!((&without.points, &without.images), (&plain.points, &plain.images));
    assert!(without.second_points.is_empty() && without.second_valid.is_empty());

    // A mirrored sample has the left's second surface, mirrored, on the right.
    let flip = SampleConfig { augment: Augment { flip: true, ..Augment::none() }, ..samples };
    let flipped = (0..16).map(|index| sample(flip.clone(), index)).find(|item| item.points != plain.points);
    let flipped = flipped.expect("one of sixteen is mirrored");
    for (map, other) in [(0, 1), (1, 0)] {
        for row in 0..side {
            for column in 0..side {
                let at = (map * side + row) * side + column;
                let from = (other * side + row) * side + side - 1 - column;
                assert_eq!(flipped.second_valid[at], plain.second_valid[from]);
                let [x, y, z] = [0, 1, 2].map(|axis| plain.second_points[3 * from + axis]);
                assert_eq!(flipped.second_points[3 * at..3 * at + 3], [-x, y, z]);
            }
        }
    }

    // The second surfaces of placed samples lie on the rays of the nominal cameras.
    let placed =
        sample(SampleConfig { second_depth: true, front_within_degrees: 0.0, ..groups::placed() }, 0);
    assert_ne!(placed.second_points, plain.second_points);
    for (map, degrees) in [(0, 90.0), (1, 270.0)] {
        let camera = Camera::orbit_at_yaw_degrees(degrees, side as u32);
        let points = (&placed.second_points[..], &placed.second_valid[..]);
        let off = groups::distances(points, map, &to_world, &camera);
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        assert!(off.len() > 200 && mean < 0.5, "map {map}: {} points, {mean} px", off.len());
    }
}

/// Samples without sides have the same photographs and the same points of front and back as samples with sides.
#[test]
fn samples_without_sides_are_those_with_sides_without_them() {
    let side = 64;
    let (_temporary, folder) = data_of_armed(side);
    let area = (side * side) as usize;
    for (placed_share, upright) in [(0.0, false), (1.0, true)] {
        let augment = Augment { flip: true, ..Augment::default() };
        let with =
            SampleConfig { second_depth: true, placed_share, upright, augment, ..SampleConfig::default() };
        let without = stage1(&folder, SampleConfig { sides: false, ..with.clone() });
        let with = stage1(&folder, with);
        for index in 0..8 {
            let [with, without] = [&with, &without].map(|samples| samples.sample(index).expect("reads"));
            assert_eq!((&without.images, &without.masks), (&with.images, &with.masks));
            assert_eq!(without.points, with.points[..6 * area]);
            assert_eq!(without.valid, with.valid[..2 * area]);
            assert!(without.second_points.is_empty() && without.truth(2).is_none());
            let batch = Stage1Batcher.batch(vec![without], &Device::flex());
            assert_eq!(batch.points.dims(), [1, 2, side as usize, side as usize, 3]);
        }
    }
}

/// Second surfaces follow the four views in batches, sample by sample.
#[test]
fn batches_have_second_surfaces_after_the_views() {
    let (_temporary, folder) = data_of_armed(64);
    let samples = SampleConfig { second_depth: true, ..SampleConfig::default() };
    let mut items: Vec<_> =
        (0..8).map(|i| stage1(&folder, samples.clone()).sample(i).expect("reads")).collect();
    items.dedup_by(|a, b| a.second_points == b.second_points);
    items.truncate(2);
    let batch = Stage1Batcher.batch(items.clone(), &Device::flex());
    assert_eq!((batch.points.dims(), batch.valid.dims()), ([2, 6, 64, 64, 3], [2, 6, 64, 64]));
    let values = |data: TensorData| data.try_into_vec::<f32>().expect("f32");
    for (sample, item) in items.iter().enumerate() {
        for view in 0..6 {
            let at = [sample..sample + 1, view..view + 1];
            let points = values(batch.points.clone().slice(at.clone()).into_data());
            let valid = values(batch.valid.clone().slice(at).into_data());
            assert!(item.truth(view) == Some((&points, &valid)), "sample {sample}, view {view}");
        }
    }
}

#[test]
fn second_surfaces_need_data_that_has_them() {
    let (_temporary, folder) = data_set(&block(), Layout::Exact, 16, 4, false, 1);
    let samples = SampleConfig { second_depth: true, ..SampleConfig::default() };
    let error = Stage1::new(folder, TRAIN, samples).expect_err("has none").to_string();
    assert!(error.contains("has no second surfaces, which `network.second_layer` needs"), "{error}");
}
