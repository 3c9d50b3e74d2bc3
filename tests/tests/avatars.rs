//! Rigged characters: `prepare avatars`, skinned meshes as scans, and damaged skins.

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use serde_json::{Value, json};
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::avatars::{Avatars, Character};
use snapsnap_tests::character::{CLOTH, SKIN, character};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{assert_says, refused, shared_folder, succeed};

/// Settings of small and few views.
const SMALL: &str = "--set views.count=4 --set views.resolution=64";

/// A folder of characters, one file each.
fn folder(people: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("temporary folder");
    for person in 0..people {
        write(folder.path(), &format!("person{person}_suit.glb"), &character(1.0, |_| {}));
    }
    folder
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, bytes).expect("write");
    path
}

#[test]
fn skinned_meshes_stand_where_their_joints_put_them() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let plain = import::read(&write(folder.path(), "metres.glb", &character(1.0, |_| {}))).expect("reads");
    let large = import::read(&write(folder.path(), "large.glb", &character(100.0, |_| {}))).expect("reads");
    let (low, high) = plain.bounds();
    assert!((low - Vec3::new(-0.94, -0.02, -0.04)).length() < 1e-5, "{low}");
    assert!((high - Vec3::new(0.94, 1.84, 0.22)).length() < 1e-5, "{high}");
    for (a, b) in plain.positions.iter().zip(&large.positions) {
        assert!((*a - *b).length() < 1e-5, "{a} {b}");
    }
    // An arm that a joint turns by a quarter around z points upwards.
    let raised = character(1.0, |json| {
        json["nodes"][6]["rotation"] = json!([0.0, 0.0, 0.5_f32.sqrt(), 0.5_f32.sqrt()]);
    });
    let (_, high) = import::read(&write(folder.path(), "raised.glb", &raised)).expect("reads").bounds();
    assert!((high.y - (1.45 + 0.7 + 0.04)).abs() < 1e-4, "{high}");
}

/// Asserts that the mesh is valid, stands on the floor and has a person's height.
fn assert_stands(mesh: &Mesh, name: &str) {
    assert_eq!(mesh.check(), Ok(()), "{name}");
    let (low, high) = mesh.bounds();
    assert!(low.y == 0.0 && (1.5..2.1).contains(&high.y), "{name}: {low} to {high}");
}

#[test]
fn characters_take_poses_and_follow_their_names() {
    let folder = folder(1);
    let avatars = Avatars::open(folder.path(), |_| true).expect("opens");
    let person = |name: &str| avatars.person(name, None).expect("made");
    let mut widths = Vec::new();
    for index in 0..30 {
        let Character { mesh, has_animations } = person(&format!("test/{index}"));
        assert!(!has_animations);
        assert_stands(&mesh, &index.to_string());
        let (low, high) = mesh.bounds();
        widths.push(high.x - low.x);
    }
    widths.sort_by(f32::total_cmp);
    // From hanging arms to raised ones.
    assert!(widths[0] < 0.75 && widths[29] > 1.4, "{widths:?}");
    assert_eq!(person("a").mesh.positions, person("a").mesh.positions);
    assert_ne!(person("a").mesh.positions, person("b").mesh.positions);
    // The same on every machine.
    let mean = person("a").mesh.positions.iter().map(|p| p.as_dvec3()).sum::<glam::DVec3>() / 128.0;
    let expected = glam::DVec3::new(-0.028_705, 0.930_100, 0.065_703);
    assert!((mean - expected).length() < 1e-5, "{mean:.6}");
}

#[test]
fn cloth_changes_its_colour_and_skin_does_not() {
    let folder = folder(1);
    let avatars = Avatars::open(folder.path(), |_| true).expect("opens");
    let mut cloth = Vec::new();
    for index in 0..8 {
        let mesh = avatars.person(&format!("test/{index}"), None).expect("made").mesh;
        let texture = mesh.materials[0].texture.as_ref().expect("a texture");
        let colors: Vec<[u8; 3]> = texture.pixels().map(|pixel| pixel.0).collect();
        assert_eq!(colors.iter().filter(|color| **color == SKIN).count(), 4 * 64, "person {index}");
        let other = colors.into_iter().find(|color| *color != SKIN).expect("cloth");
        cloth.push(other);
    }
    let farthest = cloth.iter().flat_map(|color| (0..3).map(|i| color[i].abs_diff(CLOTH[i]))).max();
    cloth.sort_unstable();
    cloth.dedup();
    assert!(cloth.len() > 6 && farthest > Some(80), "{cloth:?}");
}

/// A character that faces another way comes out as the same person.
#[test]
fn characters_face_forwards() {
    let turned = folder(0);
    let half_a_turn = |json: &mut Value| {
        json["nodes"]
            .as_array_mut()
            .expect("nodes")
            .push(json!({ "rotation": [0.0, 1.0, 0.0, 0.0], "children": [0] }));
        json["scenes"][0]["nodes"] = json!([20, 21]);
    };
    write(turned.path(), "person0_suit.glb", &character(1.0, half_a_turn));
    let plain = folder(1);
    let of =
        |folder: &Path| Avatars::open(folder, |_| true).expect("opens").person("a", None).expect("made").mesh;
    for (a, b) in of(plain.path()).positions.iter().zip(&of(turned.path()).positions) {
        assert!((*a - *b).length() < 1e-4, "{a} {b}");
    }
}

#[test]
fn characters_become_a_data_set_whose_splits_share_no_person() {
    let (people, place) = (folder(18), Workplace::empty());
    let prepare = |people: &Path, line: &str| {
        let mut command = place.run(&format!("prepare avatars {line} {SMALL}"));
        command.arg(people);
        command
    };
    for split in ["train", "val", "test"] {
        succeed(&mut prepare(people.path(), &format!("--subjects 2 --split {split} -o people")));
    }
    assert_says(&succeed(&mut place.run("prepare check people")), &["6 subjects, 24 views: no fault"]);
    // Files of 18 people: two for test, two for val.
    let of = |part: fn(usize) -> bool| Avatars::open(people.path(), part).is_ok();
    assert!(of(|person| person == 0) && of(|person| person == 17) && !of(|person| person == 18));
    // Too few people.
    let error = refused(&mut prepare(folder(1).path(), "--subjects 1 -o few"));
    assert!(error.contains("people are too few to share among the splits"), "{error}");
}

#[test]
fn what_is_wrong_with_a_character_is_named() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let error = |bytes: &[u8]| {
        let path = write(folder.path(), "person_suit.glb", bytes);
        let error =
            Avatars::open(folder.path(), |_| true).expect("opens").person("a", None).err().expect("refused");
        assert!(error.to_string().starts_with(&path.display().to_string()), "{error}");
        error.to_string()
    };
    let changed = |change: &dyn Fn(&mut Value)| error(&character(1.0, |json| change(json)));
    type Change<'a> = &'a dyn Fn(&mut Value);
    let cases: [(&str, Change); 9] = [
        ("has no joint `LeftForeArm`", &|json| json["nodes"][7]["name"] = json!("Ellbogen")),
        ("has no joint `Hips`", &|json| json["nodes"][0]["name"] = json!("")),
        ("has no skin", &|json| {
            json.as_object_mut().expect("an object").remove("skins");
            json["nodes"][20].as_object_mut().expect("an object").remove("skin");
        }),
        ("0 weights for 128 positions", &|json| {
            let attributes = &mut json["meshes"][0]["primitives"][0]["attributes"];
            attributes.as_object_mut().expect("an object").remove("WEIGHTS_0");
        }),
        ("refers to joint 3 of a skin of 3", &|json| json["skins"][0]["joints"] = json!([0, 1, 2])),
        ("joint 0 of skin 0 is not in the scene", &|json| json["scenes"][0]["nodes"] = json!([20])),
        ("promises 20000 entries", &|json| json["accessors"][4]["count"] = json!(20_000)),
        ("m high, expected 0.5 to 3", &|json| json["nodes"][0]["scale"] = json!([100.0, 100.0, 100.0])),
        ("position 0 of a skin has the weights", &|json| json["accessors"][2]["componentType"] = json!(5121)),
    ];
    for (expected, change) in cases {
        let error = changed(change);
        assert!(error.contains(expected), "{expected}: {error}");
    }
}

/// Real characters, if they are beside the checkout.
#[test]
fn real_characters_stand_upright() {
    let Some(folder) = shared_folder("avatars") else { return };
    let avatars = Avatars::open(&folder, |_| true).expect("opens");
    for index in 0..12 {
        assert_stands(
            &avatars.person(&format!("real/{index}"), None).expect("made").mesh,
            &index.to_string(),
        );
    }
}
