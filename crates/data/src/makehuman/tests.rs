use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::*;

/// MakeHuman's data beside the checkout; `None`, said aloud, where they are not.
fn data() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/makehuman");
    if !folder.is_dir() {
        println!("SKIPPED: {} is not there", folder.display());
        return None;
    }
    Some(folder)
}

#[test]
fn people_stand_upright_and_follow_their_names() {
    let Some(folder) = data() else { return };
    let library = Library::open(&folder).expect("opens");
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
}

/// Skin that is still there under a garment, though a hem's breadth from its edge, lies on its inner side.
#[test]
fn skin_does_not_come_through_cloth() {
    let Some(folder) = data() else { return };
    let library = Library::open(&folder).expect("opens");
    let (mut under, mut through) = (0, 0);
    for index in 0..10 {
        let check = |person: &Person| {
            let skin = person.skin().net;
            type Inside<'a> = &'a dyn Fn(&Vertex) -> f32;
            let garments: [(Net, Inside); 3] = [
                (person.top().net, &|v| person.in_top(v)),
                (person.bottom().net, &|v| person.in_bottom(v)),
                (person.shoes().net, &|v| person.in_shoes(v)),
            ];
            for (cloth, inside) in garments {
                let normals = cloth.normals();
                for vertex in skin.vertices.iter().filter(|v| inside(v) > 0.01) {
                    let distance = |i: &usize| (cloth.vertices[*i].posed - vertex.posed).length_squared();
                    // Sleeves hang beside the trunk, whose cloth has its outside there.
                    let nearest = (0..cloth.vertices.len())
                        .filter(|i| cloth.vertices[*i].part() == vertex.part())
                        .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                        .expect("the garment is there");
                    under += 1;
                    let out = (vertex.posed - cloth.vertices[nearest].posed).dot(normals[nearest]);
                    through += usize::from(out > 0.001);
                }
            }
        };
        with_person(&library, &format!("test/cloth/{index}"), check).expect("made");
    }
    println!("{through} of {under} vertices under cloth come through");
    assert!(under > 1000 && through * 100 < under, "{through} of {under}");
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
        fs::write(copy.path().join(name), fs::read(folder.join("data").join(name)).expect("read"))
            .expect("write");
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
