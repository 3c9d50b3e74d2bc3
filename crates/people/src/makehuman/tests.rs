use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::*;

/// MakeHuman's data beside the checkout. Without them, a message is printed.
fn data() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/makehuman");
    if !folder.is_dir() {
        println!("SKIPPED: {} is not there", folder.display());
        return None;
    }
    Some(folder)
}

fn library() -> Option<Library> {
    data().map(|folder| Library::open(&folder).expect("opens"))
}

#[test]
fn people_stand_upright_and_follow_their_names() {
    let Some(library) = library() else { return };
    let mesh = |name: &str| person(&library, name).expect("made");
    let mut counts = HashSet::new();
    for index in 0..8 {
        let mesh = mesh(&format!("test/{index}"));
        assert_eq!(mesh.check(), Ok(()));
        let (low, high) = mesh.bounds();
        assert!(low.y == 0.0 && (1.0..2.4).contains(&high.y), "person {index}: {low} to {high}");
        // The crown is over the feet.
        let top = mesh.positions.iter().copied().max_by(|a, b| a.y.total_cmp(&b.y)).expect("has positions");
        assert!(top.x.abs() < 0.35 && top.z.abs() < 0.35, "person {index}: crown at {top}");
        assert!((30_000..250_000).contains(&mesh.faces.len()), "{}", mesh.faces.len());
        counts.insert(mesh.faces.len());
    }
    assert!(counts.len() >= 7, "people differ");
    let (one, again) = (mesh("test/1"), mesh("test/1"));
    assert_eq!(one.positions, again.positions);
    assert_eq!(one.faces, again.faces);
    // Recorded numbers, the same on every machine. Only the mean has a tolerance: where two vertices of cloth are equally
    // near, machines may press skin against either.
    let texture = one.materials[0].texture.as_ref().expect("has a texture");
    let light: u64 = texture.as_raw().iter().map(|b| u64::from(*b)).sum();
    assert_eq!((one.positions.len(), one.faces.len(), light), (100_479, 199_159, 316_772_622));
    let mean = one.positions.iter().map(|p| p.as_dvec3()).sum::<glam::DVec3>() / one.positions.len() as f64;
    let expected = glam::DVec3::new(-0.061_584, 0.964_124, 0.058_625);
    assert!((mean - expected).length() < 1e-5, "{mean}");
}

/// Counts vertices of `inner` that lie outside of the cloth over them by more than 1 mm, and all that have cloth over them.
/// That cloth is the nearest in the pose of all within 2 cm in the resting pose.
fn through(inner: &Net, cloth: &Net, inside: impl Fn(&Vertex) -> f32) -> (usize, usize) {
    let normals = cloth.normals();
    let (mut under, mut through) = (0, 0);
    for vertex in inner.vertices.iter().filter(|v| inside(v) > 0.01) {
        let over = |i: &usize| (cloth.vertices[*i].rest - vertex.rest).length_squared() < 0.02 * 0.02;
        let distance = |i: &usize| (cloth.vertices[*i].posed - vertex.posed).length_squared();
        let nearest =
            (0..cloth.vertices.len()).filter(over).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let Some(nearest) = nearest else { continue };
        under += 1;
        let out = (vertex.posed - cloth.vertices[nearest].posed).dot(normals[nearest]);
        through += usize::from(out > 0.001);
    }
    (through, under)
}

/// Skin under a garment, more than 1 cm from its edge, lies on its inner side; so do trousers under a top. No skin is
/// missing, since one can look into sleeves.
#[test]
fn nothing_comes_through_cloth() {
    let Some(library) = library() else { return };
    let mut found = [(0, 0); 2];
    for index in 0..10 {
        let person = Person::of(&library, &format!("test/cloth/{index}")).expect("made");
        let whole = person.group("body").subdivide();
        let garments = [person.bottom(), person.top(), person.shoes()];
        let skin = person.pressed_skin(person.skin(), &garments).net;
        assert_eq!(skin.faces.len(), whole.faces.len());
        let [bottom, top, shoes] = garments.map(|piece| piece.net);
        type Inside<'a> = &'a dyn Fn(&Vertex) -> f32;
        let layers: [(&Net, &Net, Inside, usize); 4] = [
            (&skin, &top, &|v| person.in_top(v), 0),
            (&skin, &bottom, &|v| person.in_bottom(v), 0),
            (&skin, &shoes, &|v| person.in_shoes(v), 0),
            (&bottom, &top, &|v| person.in_top(v).min(person.in_bottom(v)), 1),
        ];
        for (inner, cloth, inside, kind) in layers {
            let (out, all) = through(inner, cloth, inside);
            found[kind] = (found[kind].0 + out, found[kind].1 + all);
        }
    }
    for ((out, all), what) in found.into_iter().zip(["skin", "trousers under tops"]) {
        println!("{what}: {out} of {all} vertices under cloth come through");
        assert!(all > 1000 && out * 200 < all, "{what}: {out} of {all}");
    }
}

/// No pose leaves a hand in the trunk.
#[test]
fn hands_do_not_sink_into_the_body() {
    let Some(library) = library() else { return };
    for index in 0..30 {
        let person = Person::of(&library, &format!("test/hands/{index}")).expect("made");
        assert_eq!(rig::sunk_hands(&person.group("body"), 0.005), [false; 2], "person {index}");
    }
}

#[test]
fn missing_and_damaged_files_are_named() {
    let Some(folder) = data() else { return };
    let copy = tempfile::tempdir().expect("temporary folder");
    let message = || Library::open(copy.path()).map(drop).expect_err("broken").to_string();
    assert!(message().contains("neither it nor its folder `data` has 3dobjs/base.obj"));
    for kind in ["3dobjs", "rigs"] {
        fs::create_dir_all(copy.path().join(kind)).expect("make");
    }
    for name in ["3dobjs/base.obj", "rigs/default.mhskel", "rigs/default_weights.mhw"] {
        let bytes = fs::read(folder.join("data").join(name)).expect("read");
        fs::write(copy.path().join(name), bytes).expect("write");
    }
    let library = Library::open(copy.path()).expect("complete");
    let error = person(&library, "a").map(drop).expect_err("no targets").to_string();
    assert!(error.contains("targets") && error.contains("cannot read"), "{error}");
    let damage = |name: &str, text: &str| {
        let path = copy.path().join(name);
        let whole = fs::read_to_string(&path).expect("read");
        fs::write(&path, text).expect("write");
        let message = message();
        fs::write(&path, whole).expect("write");
        message
    };
    assert!(damage("3dobjs/base.obj", "v 0 0 nan\n").contains("line 1, `v 0 0 nan`: not understood"));
    assert!(damage("3dobjs/base.obj", "v 0 0 0\nf 1 2 3\n").contains("line 2"));
    assert!(damage("rigs/default.mhskel", "{").contains("default.mhskel"));
    let weights = damage("rigs/default_weights.mhw", r#"{"weights":{"none":[[0,1]]}}"#);
    assert!(weights.contains("bone `none` is not in the rig"), "{weights}");
}
