//! Views in groups, and second surfaces of side views.

use burn::tensor::{Tensor, TensorData};
use glam::DVec3;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_net::network::View;
use snapsnap_net::painter::Origin;
use snapsnap_splat::Gaussians;
use tempfile::TempDir;

use super::*;
use crate::Jitter;
use crate::dataset::check;
use crate::prepare::DataConfig;
use crate::testing::{made, two_blocks};

/// A data set of one person, in a group of four views whose rig deviates.
fn group(rig: Jitter) -> (TempDir, Arc<Folder>) {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution) = (4, 128);
    (config.views.arrangement, config.jitter.rig) = (Arrangement::Groups, rig);
    made(&config, person(), 1)
}

/// Samples that are placed like a user's photographs.
fn placed() -> SampleConfig {
    SampleConfig {
        placed_share: 1.0,
        upright: true,
        person_height: 700,
        points: true,
        augment: Augment::none(),
        ..SampleConfig::default()
    }
}

fn first_of_stage2(folder: &Arc<Folder>, config: SampleConfig) -> Stage2Item {
    Stage2::new(folder.clone(), TRAIN, config).expect("samples").sample(0).expect("a sample")
}

/// Distances in pixels between the points of the view number `view` of a sample and the centres of their pixels in
/// `camera`. `to_world` transforms the points from the front's frame.
fn distances(
    (points, valid): (&[f32], &[f32]),
    view: usize,
    to_world: &RigidTransform,
    camera: &Camera,
) -> Vec<f64> {
    let side = camera.width as usize;
    let rows = view * side * side..(view + 1) * side * side;
    let pixels =
        (0..side * side).zip(&valid[rows.clone()]).zip(points_of(&points[3 * rows.start..3 * rows.end]));
    let distance = |((pixel, _), point): ((usize, &f32), Vec3)| {
        let (place, _) = camera.project(to_world.apply(point.as_dvec3())).expect("in front");
        (place - DVec2::new((pixel % side) as f64, (pixel / side) as f64) - 0.5).length()
    };
    pixels.filter(|((_, valid), _)| **valid > 0.5).map(distance).collect()
}

/// A side's points lie on its pixels' rays from a camera at a quarter turn of the front camera. The sides' cameras
/// follow from the front camera with any deviation.
#[test]
fn side_cameras_of_groups_follow_from_the_front_camera() {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution) = (8, 64);
    config.views.arrangement = Arrangement::Groups;
    let stray = Jitter { yaw: 4.0, pitch: 3.0, distance: 0.1, ..Jitter::default() };
    (config.jitter.rig, config.jitter.view) = (stray, stray);
    let (_temporary, folder) = made(&config, person(), 1);
    let checked = check(folder.root(), |_, _| {}).expect("checks");
    assert_eq!(checked.problems, Vec::<String>::new());
    let samples = SampleConfig { augment: Augment::none(), ..SampleConfig::default() };
    let stage1 = stage1(&folder, samples.clone());
    let mut fronts = Vec::new();
    for index in 0..8 {
        let item = stage1.sample(index).expect("a sample");
        let first = front_of(&item);
        fronts.push(first);
        let front = folder.person(TRAIN, "0000").camera(first).expect("reads");
        let to_world = front.world_to_camera.inverse();
        let off = [(2, 90.0), (3, 270.0)].map(|(side, degrees)| {
            distances((&item.points, &item.valid), side, &to_world, &front.turned(degrees))
        });
        let off = off.concat();
        let worst = off.iter().copied().fold(0.0, f64::max);
        assert!(off.len() > 100 && worst < 1e-3, "{} points, {worst} px", off.len());
    }
    assert!(fronts.iter().all(|first| [0, 4].contains(first)) && fronts.contains(&0) && fronts.contains(&4));
    let item = first_of_stage2(&folder, samples);
    let apart = item.cameras[2].centre() - item.cameras[0].turned(90.0).centre();
    assert!(apart.length() < 1e-9, "{apart}");
    assert!(Stage1::new(folder, TRAIN, SampleConfig::compat()).is_err());
}

/// People in placed samples have the place and size of people in a user's photographs.
#[test]
fn placed_samples_have_the_height_of_a_users() {
    let (_temporary, folder) =
        group(Jitter { distance: 0.3, look_at: 0.03, pitch: 2.0, ..Jitter::default() });
    let item = first_of_stage2(&folder, placed());
    let first = |placed_share: f32| {
        stage1(&folder, SampleConfig { placed_share, ..placed() }).sample(0).expect("a sample")
    };
    let images = item.photographs.each_ref().map(|photo| &*photo.rgb).concat();
    assert!(first(1.0).images == images && first(1.0).points == item.points);
    // The cameras' distance varies: all samples are placed, or none.
    let always = first(1e-6);
    assert!(always.points == item.points && always.images == images);
    assert!(first(0.0).images != images);
    let side = 128;
    // Over both photographs, the person is `person_height` high.
    let masks = item.photographs.each_ref().map(|photo| &*photo.mask).concat();
    let seen: Vec<usize> = (0..2 * side * side).filter(|i| masks[*i] > 0.5).collect();
    let rows = || seen.iter().map(|i| i / side % side);
    let height = rows().max().expect("a person") + 1 - rows().min().expect("a person");
    assert_eq!(height, (700.0 / 1024.0 * side as f32).round() as usize);
    let scale = item.restoration.expect("people are upright").scale;
    assert!((scale - 1.0).abs() > 0.02, "{scale}");
}

/// The restoration of an upright sample moves the points of all views onto the surface that their cameras saw.
#[test]
fn restored_points_lie_on_the_photographed_person() {
    let (_temporary, folder) = group(Jitter { pitch: 15.0, distance: 0.3, yaw: 30.0, ..Jitter::default() });
    let item = first_of_stage2(&folder, placed());
    let without = first_of_stage2(&folder, SampleConfig { points: false, ..placed() });
    assert!(without.points.is_empty() && item.photographs[1].rgb == without.photographs[1].rgb);
    let scale = |item: &Stage2Item| item.restoration.as_ref().map(|restoration| restoration.scale);
    assert_eq!((scale(&item), item.cameras), (scale(&without), without.cameras));
    let restoration = item.restoration.as_ref().expect("people are upright");
    let to_world = item.cameras[0].world_to_camera.inverse();
    let device = Device::flex();
    for view in 0..4 {
        let stored = folder.person(TRAIN, "0000").depth(view).expect("reads");
        let pixels = view * 128 * 128..(view + 1) * 128 * 128;
        let pixels: Vec<usize> = pixels.filter(|pixel| item.valid[*pixel] > 0.5).collect();
        let points: Vec<f32> =
            pixels.iter().flat_map(|pixel| &item.points[3 * pixel..3 * pixel + 3]).copied().collect();
        let means = Tensor::from_data(TensorData::new(points.clone(), [pixels.len(), 3]), &device);
        let ones = |columns: usize| Tensor::<2>::ones([pixels.len(), columns], &device);
        let opacities = Tensor::ones([pixels.len()], &device);
        let gaussians = Gaussians::new(means, ones(4), ones(3), opacities, ones(3)).expect("fits");
        let origin = Origin { view: Some(View::ALL[view]), pixel: 0 };
        let restored = restoration.person(gaussians, &vec![origin; pixels.len()]);
        let restored = restored.means.into_data().try_to_vec::<f32>().expect("f32");
        let off = |points: &[f32]| {
            let depth = |point: &[f32]| {
                let point = to_world.apply(Vec3::from_slice(point).as_dvec3());
                let (place, depth) = stored.camera.project(point).expect("in front");
                (f64::from(stored.depth[place.y as usize * 128 + place.x as usize]) - depth).abs()
            };
            points.chunks_exact(3).filter(|point| depth(point) > 1e-4).count()
        };
        let scaled: Vec<f32> = points.iter().map(|value| restoration.scale as f32 * value).collect();
        // Some points lie on the edge between two pixels.
        let (wrong, before, all) = (off(&restored), off(&scaled), pixels.len());
        assert!(all > 300 && wrong * 20 < all, "view {view}: {wrong} of {all} points");
        assert!(before * 2 > all, "view {view}: {before} of {all} points");
    }
}

/// Rectified points lie on the nominal cameras' rays through their pixels. Points of the photographs keep their
/// distance in front of the body's axis. Points that nominal cameras see do not move.
#[test]
fn rectified_points_keep_their_distance_from_the_axis() {
    for (is_nominal, placed_share) in [(true, 0.0), (false, 0.0), (false, 1.0)] {
        let rig = Jitter { pitch: 15.0, distance: 0.5, yaw: 30.0, ..Jitter::default() };
        let (_temporary, folder) = group(if is_nominal { Jitter::default() } else { rig });
        let item = |upright: bool, placed_share: f32| {
            let samples = SampleConfig { upright, placed_share, ..placed() };
            stage1(&folder, samples).sample(0).expect("a sample")
        };
        let (upright, leaning) = (item(true, placed_share), item(false, 0.0));
        let both = (0..4 * 128 * 128).filter(|pixel| upright.valid[*pixel] * leaning.valid[*pixel] > 0.5);
        let apart = both.flat_map(|pixel| 3 * pixel..3 * pixel + 3);
        let apart = apart.map(|i| (upright.points[i] - leaning.points[i]).abs()).fold(0.0, f32::max);
        if is_nominal {
            assert!(upright.valid == leaning.valid && apart < 1e-4, "{apart} m");
        } else {
            assert!(apart > 0.05, "{apart} m");
        }
        let around = Camera::orbit_at_yaw_degrees(0.0, 128).world_to_camera.inverse();
        for (view, degrees) in [(0, 0.0), (1, 180.0), (2, 90.0), (3, 270.0)] {
            let camera = Camera::orbit_at_yaw_degrees(degrees, 128);
            let off = distances((&upright.points, &upright.valid), view, &around, &camera);
            let seen = off.len();
            // At edges, a side's pixel may have its neighbour's point. A third of so few pixels are at an edge.
            let (near, edges) = if view < 2 { (1e-3, 0) } else { (1.0, seen / 10) };
            let apart = off.iter().filter(|off| **off > near).count();
            assert!(seen > 300 && apart <= edges, "{placed_share}, view {view}: {apart} of {seen} points");
        }
        // The person's depth, and no lean: the middle of the body is above the feet.
        let pixels = (0..2 * 128 * 128).filter(|pixel| upright.valid[*pixel] > 0.5);
        let points = pixels.map(|pixel| Vec3::from_slice(&upright.points[3 * pixel..3 * pixel + 3]));
        let points: Vec<DVec3> = points.map(|point| around.apply(point.as_dvec3())).collect();
        let slice = |low: f64, high: f64| {
            let z = || points.iter().filter(|p| (low..high).contains(&p.y)).map(|p| p.z);
            0.5 * (z().fold(f64::MAX, f64::min) + z().fold(f64::MIN, f64::max))
        };
        let lean = slice(1.2, 1.4) - slice(0.3, 0.5);
        assert!(lean.abs() < 0.05, "{placed_share}: {lean} m");
    }
}

/// A block with a slab beside its right side, as an arm hangs beside a flank. The slab is smaller than the block.
fn armed() -> Mesh {
    let (middle, half) = BLOCK;
    let beside = Vec3::new(1.5 * half.x, 0.0, 0.0);
    let share = Vec3::new(0.1, 0.6, 0.4);
    two_blocks(|p| middle + beside + share * (p - middle))
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
    let placed = sample(SampleConfig { second_depth: true, front_within_degrees: 0.0, ..placed() });
    assert_ne!(placed.points[first.len()..], *behind);
    for (map, degrees) in [(0, 90.0), (1, 270.0)] {
        let camera = Camera::orbit_at_yaw_degrees(degrees, side as u32);
        let off = distances((&placed.points, &placed.valid), 4 + map, &to_world, &camera);
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
