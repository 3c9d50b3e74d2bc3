use std::sync::Arc;

use super::*;
use crate::prepare::{DataConfig, Subject};
use crate::testing::{block, data_set, made, rectangle, two_blocks};
use glam::Vec3;
use snapsnap_splat::{Camera, camera_file};

const TRAIN: Option<Split> = Some(Split::Train);

fn small(layout: Layout) -> (tempfile::TempDir, Arc<Folder>) {
    made(&config(layout), &rectangle(), 2)
}

fn config(layout: Layout) -> DataConfig {
    let mut config = DataConfig::default();
    (config.views.layout, config.views.count, config.views.resolution) = (layout, 4, 64);
    config.views.high_resolution = true;
    config
}

#[test]
fn what_was_written_is_read_again() {
    for layout in [Layout::Exact, Layout::Authors] {
        let (_temporary, written) = small(layout);
        let folder = Folder::open(written.root()).expect("opens");
        assert_eq!(folder.description(), written.description());
        assert_eq!(folder.splits(), [TRAIN]);
        assert_eq!(folder.subjects(TRAIN).expect("lists"), ["0000", "0001"]);
        let person = folder.person(TRAIN, "0001");
        let view = person.depth(2).expect("reads");
        let expected = Camera::orbit_at_yaw_degrees(180.0, 64);
        let off = (view.camera.world_to_camera.translation - expected.world_to_camera.translation).length();
        assert!(off < 1e-12 && view.camera.focal == expected.focal, "{layout:?}: {:?}", view.camera);
        assert_eq!(view.camera.principal_point, expected.principal_point);
        let middle = 37 * 64 + 32;
        assert!((view.depth[middle] - 2.0).abs() < 0.15, "{}", view.depth[middle]);
        let (_, mask) = person.picture(2, false).expect("reads");
        assert_eq!(mask.as_raw()[middle], 255);
        let (large, _) = person.picture(2, true).expect("reads");
        assert_eq!(large.dimensions(), (128, 128));
        let checked = check(folder.root(), |_, _| {}).expect("checks");
        assert_eq!((checked.subjects, checked.views, checked.problems), (2, 8, Vec::<String>::new()));
    }
}

/// Two views of a block behind a rectangle, from the front and the back.
#[test]
fn second_surfaces_are_stored_and_checked() {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution, config.views.second_depth) = (2, 64, true);
    // A thin slab in front of the block.
    let mesh = two_blocks(|p| p * Vec3::new(0.5, 1.0, 0.2) + 0.4 * Vec3::Z);
    let (_temporary, folder) = made(&config, &mesh, 1);
    let person = folder.person(TRAIN, "0000");
    let of = |view: usize| {
        (person.depths("depth", view).expect("reads"), person.depths("depth2", view).expect("reads"))
    };
    // The slab hides a part of the block from the front, and the block all of the slab from behind.
    let (front, back) = (of(0), of(1));
    let count = |depths: &[f32]| depths.iter().filter(|z| **z > 0.0).count();
    assert!(count(&front.1) > 100 && count(&front.1) < count(&front.0), "{}", count(&front.1));
    assert!(count(&back.1) > 100 && count(&back.1) < count(&back.0), "{}", count(&back.1));
    let middle = 37 * 64 + 32;
    let gap = front.1[middle] - front.0[middle];
    assert!((0.2..0.5).contains(&gap), "{gap}");
    let problems = || check(folder.root(), |_, _| {}).expect("checks").problems;
    assert_eq!(problems(), Vec::<String>::new());
    let path = folder.root().join("train/depth2/0000/0.npz");
    files::write_depth(&path, [64, 64], &vec![0.5; 64 * 64]).expect("writes");
    assert!(problems()[0].contains("4096 pixels have a second surface that is not behind a first one"));
    fs::remove_file(&path).expect("removes");
    assert!(problems()[0].contains("depth2/0000/0.npz"), "{:?}", problems());
    config.views.layout = Layout::Authors;
    use snapsnap_base::config::Schema;
    assert_eq!(config.refusal().expect("a problem").0, "views.second_depth");
}

/// The authors' folders have no description, and their test sets no splits.
#[test]
fn folders_of_the_authors_tools_are_recognised() {
    let (_temporary, written) = small(Layout::Authors);
    let root = written.root();
    fs::remove_file(root.join(DESCRIPTION)).expect("remove");
    let folder = Folder::open(root).expect("opens");
    let Description { layout, views, resolution, high_resolution, pixel_centre, .. } = folder.description();
    assert_eq!((*layout, *views, *resolution, *high_resolution), (Layout::Authors, 4, 64, true));
    assert_eq!(*pixel_centre, 0.0);
    for kind in ["img", "mask", "depth", "parm"] {
        fs::rename(root.join("train").join(kind), root.join(kind)).expect("rename");
    }
    let folder = Folder::open(root).expect("opens");
    assert_eq!(folder.splits(), [None]);
    let person = folder.person(None, "0000");
    assert_eq!(person.depth(0).expect("reads").depth.len(), 64 * 64);

    // Matrices in f32, as some of the authors' tools write them.
    let path = root.join("parm/0000/0_extrinsic.npy");
    let camera = person.camera(0).expect("reads");
    let rotation = camera.world_to_camera.rotation;
    let matrix = ndarray::Array2::from_shape_fn((3, 4), |(r, c)| {
        (if c < 3 { rotation.row(r)[c] } else { camera.world_to_camera.translation[r] }) as f32
    });
    ndarray_npy::write_npy(&path, &matrix).expect("writes");
    let again = person.camera(0).expect("reads");
    assert!((again.world_to_camera.translation - camera.world_to_camera.translation).length() < 1e-6);
}

#[test]
fn a_killed_run_leaves_no_half_subject() {
    let (_temporary, folder) = small(Layout::Exact);
    let root = folder.root();
    folder.tidy();
    assert!(!root.join(".unfinished").exists());
    // The state after a kill between the last move and the end: a lock file alone is no fault.
    fs::create_dir(root.join(".unfinished")).expect("make");
    fs::write(root.join(".unfinished/train-0001.lock"), "").expect("write");
    assert_eq!(check(root, |_, _| {}).expect("checks").problems, [""; 0]);
    // The state after a kill during rendering, and during the move.
    fs::create_dir_all(root.join(".unfinished/train-0002/img")).expect("make");
    fs::create_dir_all(root.join("train/depth/0002")).expect("make");
    fs::write(root.join("train/depth/0002/stale.npz"), "").expect("write");
    assert_eq!(folder.subjects(TRAIN).expect("lists").len(), 2);
    assert!(!folder.has(Split::Train, "0002"));
    let problems = check(root, |_, _| {}).expect("checks").problems;
    assert!(problems.len() == 2 && problems.iter().any(|p| p.contains("was killed")), "{problems:?}");
    let add = || {
        let subject = Subject::plain(Split::Train, "0002");
        config(Layout::Exact).add(&folder, &subject, &rectangle()).expect("adds")
    };
    assert!(add());
    assert!(folder.has(Split::Train, "0002"));
    // A subject of a run in progress is not touched.
    fs::remove_dir_all(root.join("train/img/0002")).expect("remove");
    fs::create_dir_all(root.join(".unfinished")).expect("make");
    let lock = File::create(root.join(".unfinished/train-0002.lock")).expect("create");
    lock.try_lock().expect("free");
    assert!(!add());
    drop(lock);
    assert!(add());
    assert!(folder.has(Split::Train, "0002"));
    folder.tidy();
    assert!(check(root, |_, _| {}).expect("checks").problems.is_empty());
}

/// One fault does not hide another.
#[test]
fn a_check_lists_everything_that_is_wrong() {
    let (_temporary, folder) = small(Layout::Exact);
    let at = |path: &str| folder.root().join("train").join(path);
    fs::remove_file(at("img/0000/0.png")).expect("remove");
    let whole = fs::read(at("img/0000/1.png")).expect("read");
    fs::write(at("img/0000/1.png"), &whole[..whole.len() / 2]).expect("write");
    fs::copy(at("img/0000/2_hr.png"), at("img/0000/2.png")).expect("copy");
    fs::write(at("img/0000/4.png"), &whole).expect("write");
    let empty = image::RgbaImage::new(64, 64);
    empty.save(at("img/0001/0.png")).expect("save");
    let write_depth = |view: usize, change: fn(&mut Vec<f32>)| {
        let mut depth = folder.person(TRAIN, "0001").depths("depth", view).expect("reads");
        change(&mut depth);
        files::write_depth(&at(&format!("depth/0001/{view}.npz")), [64, 64], &depth).expect("writes");
    };
    write_depth(1, |depth| depth[0] = f32::NAN);
    write_depth(2, |depth| depth.fill(0.0));
    fs::write(at("depth/0001/3.npz"), "not a zip").expect("write");
    let cameras = at("cameras/0000.json");
    let text = fs::read_to_string(&cameras).expect("read").replacen("64", "65", 1);
    fs::write(&cameras, text).expect("write");
    // A view without any file.
    fs::remove_file(at("img/0000/3.png")).expect("remove");
    fs::remove_file(at("img/0000/3_hr.png")).expect("remove");
    fs::remove_file(at("depth/0000/3.npz")).expect("remove");
    fs::create_dir(at("depth/0009")).expect("make");

    let problems = check(folder.root(), |_, _| {}).expect("checks").problems;
    let expected = [
        "0009: its subject has no pictures",
        "4.png: belongs to none of the 4 views",
        "0000/0.png: cannot read",
        "0000/1.png: not a readable image",
        "0000/2.png: is 128×128, the data set has views of 64×64",
        "0000/3.png: cannot read",
        "0000/3_hr.png: cannot read",
        "0000/3.npz: cannot read",
        "0000.json: is 65×64",
        "0001/0: its mask is empty",
        "0001/1.npz: holds a depth of NaN",
        "0001/2: ",
        "0001/3.npz: is no depth map",
    ];
    for words in expected {
        assert!(problems.iter().any(|problem| problem.contains(words)), "{words}: {problems:#?}");
    }
    assert_eq!(problems.len(), expected.len(), "{problems:#?}");
    // Too many cameras are one fault, not one per view.
    let text = fs::read_to_string(at("cameras/0001.json")).expect("read");
    let mut all: Vec<serde_json::Value> = serde_json::from_str(&text).expect("a list");
    all.push(all[0].clone());
    fs::write(at("cameras/0001.json"), serde_json::to_string(&all).expect("JSON")).expect("write");
    let problems = check(folder.root(), |_, _| {}).expect("checks").problems;
    let reported =
        problems.iter().filter(|p| p.contains("holds 5 cameras, the data set has 4 views")).count();
    assert_eq!(reported, 1, "{problems:#?}");

    fs::write(folder.root().join(DESCRIPTION), "layout = \"exact\"\nviews = 4\n").expect("write");
    let error = check(folder.root(), |_, _| {}).expect_err("no description").to_string();
    assert!(error.contains(DESCRIPTION) && error.contains("resolution"), "{error}");
}

/// 16 bits of inverse depth cannot store depths below half a metre.
#[test]
fn depths_that_the_authors_layout_cannot_store_are_refused() {
    let mut wall = block();
    // Every camera, 2 m from the middle, stands before a wall 40 cm away.
    wall.positions.iter_mut().for_each(|p| {
        p.x = 1.6 * p.x.signum();
        p.z = 1.6 * p.z.signum();
    });
    let (_temporary, folder) = made(&config(Layout::Authors), &wall, 0);
    let subject = Subject::plain(Split::Train, "0000");
    let refused = config(Layout::Authors).add(&folder, &subject, &wall).expect_err("too near");
    assert!(refused.to_string().contains("within half a metre"), "{refused}");
    assert!(!folder.has(Split::Train, "0000"));
    // 32 bits store them.
    made(&config(Layout::Exact), &wall, 1);
}

/// Each file of the authors' layout is checked, also if other files are faulty.
#[test]
fn a_check_looks_at_every_file_of_the_authors_layout() {
    let (_temporary, folder) = small(Layout::Authors);
    let at = |path: &str| folder.root().join("train").join(path);
    let files = [
        "img/0000/1.jpg",
        "img/0000/1_hr.jpg",
        "mask/0000/1.png",
        "depth/0000/1.png",
        "parm/0000/1_extrinsic.npy",
        "parm/0000/2_intrinsic.npy",
        "mask/0001/3.png",
    ];
    for file in files {
        fs::write(at(file), "nothing").expect("write");
    }
    let problems = check(folder.root(), |_, _| {}).expect("checks").problems;
    for file in files {
        assert!(problems.iter().any(|problem| problem.contains(file)), "{file}: {problems:#?}");
    }
    assert_eq!(problems.len(), files.len(), "{problems:#?}");
}

/// Cameras that are valid, but did not render the views.
#[test]
fn a_check_reports_cameras_that_do_not_fit_their_views() {
    type Change = fn(&mut Camera);
    let changes: [(&str, Change); 4] = [
        ("of a picture four times the size", |camera| {
            camera.focal *= 4.0;
            camera.principal_point *= 4.0;
        }),
        ("displaced by 10 cm", |camera| camera.world_to_camera.translation.x += 0.1),
        ("10 cm nearer", |camera| camera.world_to_camera.translation.z -= 0.1),
        ("of another view", |camera| *camera = Camera::orbit_at_yaw_degrees(45.0, 256)),
    ];
    for layout in [Layout::Exact, Layout::Authors] {
        let (_temporary, folder) = data_set(crate::testing::person(), layout, 256, 8, false, 1);
        assert!(check(folder.root(), |_, _| {}).expect("checks").problems.is_empty());
        let cameras: Vec<Camera> =
            (0..8).map(|view| folder.person(TRAIN, "0000").camera(view).expect("reads")).collect();
        for (name, change) in changes {
            let mut cameras = cameras.clone();
            change(&mut cameras[3]);
            let train = folder.root().join("train");
            match layout {
                Layout::Exact => {
                    camera_file::write(&cameras, &train.join("cameras/0000.json")).expect("writes");
                }
                Layout::Authors => {
                    files::write_camera(&train.join("parm/0000"), 3, &cameras[3]).expect("writes");
                }
            }
            let problems = check(folder.root(), |_, _| {}).expect("checks").problems;
            let fit = |pair: &str| {
                problems.iter().any(|p| p.contains(pair) && p.contains("do not fit one another"))
            };
            assert!(fit("views 1 and 3") && fit("views 3 and 5"), "{layout:?}, {name}: {problems:#?}");
            assert_eq!(problems.len(), 2, "{problems:#?}");
        }
    }
}

/// Names cannot lead out of the data set.
#[test]
fn names_of_subjects_are_checked() {
    let (_temporary, folder) = small(Layout::Exact);
    let config = config(Layout::Exact);
    for name in ["", ".", "..", ".hid", "a/b", "../train"] {
        let subject = Subject::plain(Split::Train, name);
        let error = config.add(&folder, &subject, &rectangle()).expect_err(name).to_string();
        assert!(error.contains("is no name of a subject"), "{name}: {error}");
    }
    let all = folder.subjects(TRAIN).expect("lists");
    assert!(all.iter().all(|subject| folder.has(Split::Train, subject)), "{all:?}");
    // Errors name the subject's source.
    let mut away = rectangle();
    away.positions.iter_mut().for_each(|p| p.x += 50.0);
    let subject = Subject { origin: Path::new("scans/p.obj"), ..Subject::plain(Split::Train, "p") };
    let error = config.add(&folder, &subject, &away).expect_err("is out of view").to_string();
    assert_eq!(error, "scans/p.obj: view 0 sees nothing of p");
}
