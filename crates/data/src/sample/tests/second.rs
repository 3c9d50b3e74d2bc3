//! Second surfaces of side views.

use burn::tensor::TensorData;

use super::*;
use crate::prepare::DataConfig;
use crate::testing::{made, two_blocks};
use snapsnap_mesh::mesh::Mesh;
use std::sync::Arc;
use tempfile::TempDir;

/// A block with a slab beside its right side, as an arm hangs beside a flank. The slab is smaller than the block.
fn armed() -> Mesh {
    let (middle, half) = BLOCK;
    let beside = Vec3::new(1.5 * half.x, 0.0, 0.0);
    let share = Vec3::new(0.1, 0.6, 0.4);
    two_blocks(|p| middle + beside + share * (p - middle))
}

/// A data set of one person, the armed block, in four views with second depths.
pub fn data_of_armed(resolution: u32) -> (TempDir, Arc<Folder>) {
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
    let sample = |config: SampleConfig| stage1(&folder, config).sample(0).expect("reads");
    let plain = sample(samples.clone());
    let to_world = Camera::orbit_at_yaw_degrees(0.0, side as u32).world_to_camera.inverse();
    let (middle, half) = BLOCK;
    // The right camera sees the block's flank behind the arm, the left one the arm's inner side behind the block.
    for (map, flank) in [(0, middle.x + half.x), (1, middle.x + 1.4 * half.x)] {
        let second = there(&plain.points, &plain.valid, 4 + map, side);
        let seen = there(&plain.points, &plain.valid, 2 + map, side).len();
        assert!((200..seen).contains(&second.len()), "{} of {seen}", second.len());
        let off = |p: &Vec3| (to_world.apply(p.as_dvec3()).x as f32 - flank).abs();
        let worst = second.iter().map(off).fold(0.0, f32::max);
        assert!(worst < 1e-5, "map {map}: {worst} m");
    }
    let without = sample(SampleConfig { second_depth: false, ..samples });
    let (first, behind) = plain.points.split_at(without.points.len());
    assert_eq!((without.valid.len(), without.truth(3).is_some()), (4 * side * side, true));
    assert_eq!((&without.points[..], &without.images), (first, &plain.images));

    // The second surfaces of placed samples lie on the rays of the nominal cameras.
    let placed = sample(SampleConfig { second_depth: true, front_within_degrees: 0.0, ..groups::placed() });
    assert_ne!(placed.points[first.len()..], *behind);
    for (map, degrees) in [(0, 90.0), (1, 270.0)] {
        let camera = Camera::orbit_at_yaw_degrees(degrees, side as u32);
        let off = groups::distances((&placed.points, &placed.valid), 4 + map, &to_world, &camera);
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
        let with = SampleConfig { second_depth: true, placed_share, upright, ..SampleConfig::default() };
        let without = stage1(&folder, SampleConfig { sides: false, ..with.clone() });
        let with = stage1(&folder, with);
        for index in 0..8 {
            let [with, without] = [&with, &without].map(|samples| samples.sample(index).expect("reads"));
            assert_eq!((&without.images, &without.masks), (&with.images, &with.masks));
            assert_eq!(without.points, with.points[..6 * area]);
            assert_eq!(without.valid, with.valid[..2 * area]);
            assert!(without.truth(2).is_none());
            let batch = Stage1Batch::new(vec![without], &Device::flex());
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
    items.dedup_by(|a, b| a.points == b.points);
    items.truncate(2);
    let batch = Stage1Batch::new(items.clone(), &Device::flex());
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
