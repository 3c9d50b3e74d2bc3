//! Views in groups.

use super::*;
use crate::Jitter;
use crate::dataset::check;
use crate::prepare::{DataConfig, Subject};

/// Of each side a pixel's point lies on the pixel's ray from a camera that stands a quarter turn from the front's own, as the
/// front's frame has it: what the sides see follows from the front, however its camera strayed.
#[test]
fn sides_of_groups_are_seen_from_where_the_front_says() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution) = (8, 64);
    config.views.arrangement = Arrangement::Groups;
    let stray = Jitter { yaw: 4.0, pitch: 3.0, distance: 0.1, ..Jitter::default() };
    (config.jitter.rig, config.jitter.view) = (stray, stray);
    let folder = Folder::create(temporary.path(), config.description("a test")).expect("makes the folder");
    let subject = Subject::plain(Split::Train, "0000");
    config.add(&folder, &subject, person()).expect("adds a subject");
    let checked = check(folder.root(), |_, _| {}).expect("checks");
    assert_eq!(checked.problems, Vec::<String>::new());
    let folder = Arc::new(Folder::open(folder.root()).expect("opens"));
    let samples = SampleConfig { repeat: 8, augment: Augment::none(), ..SampleConfig::default() };
    let stage1 = Stage1::new(folder.clone(), TRAIN, samples.clone()).expect("samples");
    let mut fronts = Vec::new();
    for index in 0..8 {
        let item = stage1.sample(index).expect("a sample");
        let first: usize = item.name.rsplit(' ').next().and_then(|n| n.parse().ok()).expect("a view");
        fronts.push(first);
        let front = folder.camera(TRAIN, "0000", first).expect("reads");
        let to_world = front.world_to_camera.inverse();
        let (mut seen, mut worst) = (0, 0.0_f64);
        for (side, degrees) in [(2, 90.0), (3, 270.0)] {
            let camera = front.turned(degrees);
            for pixel in (0..64 * 64).filter(|pixel| item.valid[side * 64 * 64 + pixel] > 0.5) {
                let at = 3 * (side * 64 * 64 + pixel);
                let point = Vec3::from_slice(&item.points[at..at + 3]).as_dvec3();
                let (place, _) = camera.project(to_world.apply(point)).expect("in front");
                let centre = DVec2::new((pixel % 64) as f64, (pixel / 64) as f64) + 0.5;
                worst = worst.max((place - centre).length());
                seen += 1;
            }
        }
        assert!(seen > 100 && worst < 1e-3, "{seen} points, {worst} px");
    }
    assert!(fronts.iter().all(|first| [0, 4].contains(first)) && fronts.contains(&0) && fronts.contains(&4));
    let stage2 = Stage2::new(folder.clone(), TRAIN, SampleConfig { supervision: 2, ..samples.clone() });
    let item = stage2.expect("samples").sample(0).expect("a sample");
    let apart = item.cameras[2].centre() - item.cameras[0].turned(90.0).centre();
    assert!(apart.length() < 1e-9, "{apart}");
    assert!(Stage1::new(folder, TRAIN, SampleConfig::compat()).is_err());
}
