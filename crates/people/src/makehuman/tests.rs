use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::patch::{PARTS, Patch, Vertex};
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
    let mesh = |name: &str| person(&library, name, None, Detail::Fine).expect("made");
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
    let one = mesh("test/1");
    // Recorded numbers, the same on every machine. Only the mean has a tolerance: where two vertices of cloth are
    // equally near, machines may press skin against either.
    let texture = one.materials[0].texture.as_ref().expect("has a texture");
    let light: u64 = texture.as_raw().iter().map(|b| u64::from(*b)).sum();
    assert_eq!((one.positions.len(), one.faces.len(), light), (104_572, 202_844, 292_054_541));
    let mean = one.positions.iter().map(|p| p.as_dvec3()).sum::<glam::DVec3>() / one.positions.len() as f64;
    let expected = glam::DVec3::new(0.005_400, 0.914_797, 0.056_439);
    assert!((mean - expected).length() < 1e-5, "{mean}");
}

/// Counts the vertices of `inner` that lie more than 1 mm outside of the cloth over them, and all vertices with cloth
/// over them. The cloth over a vertex is the nearest in the pose within 2 cm in the resting pose.
fn through(inner: &Patch, cloth: &Patch, inside: impl Fn(&Vertex) -> f32) -> (usize, usize) {
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
    for detail in [Detail::Fine, Detail::Coarse] {
        let mut found = [(0, 0); 2];
        let people = (0..).map(|index| {
            Person::of(&library, &format!("test/cloth/{index}"), None, None, detail).expect("made")
        });
        for person in
            people.filter(|person| person.worn.suit.is_none() && person.worn.shoes.is_none()).take(10)
        {
            let whole = person.group("body").subdivided(detail.steps(1));
            let [bottom, top] = person.layers();
            let garments = [bottom, top, person.shoes()];
            let skin = person.pressed_skin(person.skin(), &garments).patch;
            assert_eq!(skin.faces.len(), whole.faces.len());
            let [bottom, top, shoes] = garments.map(|piece| piece.patch);
            type Inside<'a> = &'a dyn Fn(&Vertex) -> f32;
            let layers: [(&Patch, &Patch, Inside, usize); 4] = [
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
            println!("{detail:?}, {what}: {out} of {all} vertices under cloth come through");
            assert!(all > 1000 && out * 200 < all, "{detail:?}, {what}: {out} of {all}");
        }
    }
}

/// Skin that a suit leaves in place does not come through it, in any pose, and most of a clothed body is left out.
#[test]
fn suits_cover_what_is_below_them() {
    let Some(library) = library() else { return };
    let (mut out, mut all, mut suits) = (0, 0, HashSet::new());
    let people = (0..).map(|index| {
        Person::of(&library, &format!("test/suit/{index}"), None, None, Detail::Fine).expect("made")
    });
    for person in people.filter(|person| person.worn.suit.is_some()).take(12) {
        let suit = person.worn.suit.as_ref().expect("is worn");
        suits.insert(std::sync::Arc::as_ptr(suit));
        let (skin, whole) = (person.skin().patch, person.group("body").subdivide());
        // Arms, waist or calves may be bare.
        let (left, there) = (skin.faces.len(), whole.faces.len());
        assert!(4 * left < 3 * there, "{left} of {there}");
        let suit = person.fit(suit).patch;
        let hidden = |v: &Vertex| if v.parts[0] + v.parts[2] + v.parts[3] > 0.9 { 1.0 } else { 0.0 };
        let (through, under) = through(&skin, &suit, hidden);
        (out, all) = (out + through, all + under);
        // The suit lies on the body, not far from it and not inside.
        let tree = crate::skeleton::tree(whole.vertices.iter().map(|v| v.posed));
        let places = crate::skeleton::coordinates(suit.vertices.iter().map(|v| v.posed));
        let found = tree.query_batch(&places).nearest_one::<kiddo::SquaredEuclidean<f32>>().execute();
        let far = found.iter().map(|found| found.distance.sqrt()).fold(0.0, f32::max);
        assert!(far < 0.2, "{far} m from the body");
    }
    assert!(suits.len() > 4, "{} suits", suits.len());
    println!("{out} of {all} vertices of skin near suits lie outside of them");
    assert!(all > 100 && out * 5 < all, "{out} of {all}");
}

#[test]
fn damaged_proxies_are_named() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let (clothes, mesh) = (folder.path().join("a.mhclo"), folder.path().join("a.obj"));
    let sound = "obj_file a.obj\nx_scale 0 1 1.0\nverts 0\n0 1 2 0.5 0.25 0.25 0 0 0.1\n1\n2\n\ndelete_verts\n0 - 2 4\n";
    let faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n";
    let read = |text: &str, obj: &str| {
        fs::write(&clothes, text).expect("write");
        fs::write(&mesh, obj).expect("write");
        proxy::Proxy::read(&clothes, 5).map_err(|e| e.to_string())
    };
    let proxy = read(sound, faces).expect("reads");
    assert_eq!(proxy.hides, [true, true, true, false, true]);
    let at = |p: Vec3| Vertex { rest: p, posed: p, parts: [0.0; PARTS] };
    let body = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::ONE].map(at);
    let fitted = proxy.fit(&body, |_, p| p + Vec3::Y);
    // Offsets are in decimetres and not scaled along z. The scale along x is 1 m of 0.1 m.
    let first = fitted.patch.vertices[0];
    assert!((first.rest - Vec3::new(0.25, 0.25, 0.01)).length() < 1e-6, "{}", first.rest);
    assert_eq!(first.posed, first.rest + Vec3::Y);
    assert_eq!(fitted.subdivide().texcoords[0][2], glam::Vec2::splat(1.0 / 3.0));
    for (text, obj, expected) in [
        (sound.replace("1 2 0.5", "9 2 0.5"), faces.to_owned(), "line 4"),
        (sound.replace("0.25", "nan"), faces.into(), "line 4"),
        (sound.replace("0.1\n", "\n"), faces.into(), "line 4"),
        (sound.replace("1.0", "0"), faces.into(), "line 2"),
        (sound.replace("- 2", "- 7"), faces.into(), "line 9"),
        (sound.replace("obj_file a.obj", ""), faces.into(), "names no `obj_file`"),
        (sound.replace("a.obj", "../b.obj"), faces.into(), "b.obj: cannot read"),
        (sound.into(), faces.replace("3/3", "4/3"), "a.obj: line 7"),
        (sound.into(), faces.replace("3/3", "3/4"), "a.obj: line 7"),
        (sound.into(), format!("v 0 0 0\n{faces}"), "has 4 vertices and 1 faces for 3 bindings"),
    ] {
        let error = read(&text, &obj).expect_err(expected);
        assert!(error.contains(expected), "{expected}: {error}");
    }
}

/// No pose leaves a hand in the trunk.
#[test]
fn hands_do_not_sink_into_the_body() {
    let Some(library) = library() else { return };
    for index in 0..30 {
        let person =
            Person::of(&library, &format!("test/hands/{index}"), None, None, Detail::Fine).expect("made");
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
    let error = person(&library, "a", None, Detail::Fine).map(drop).expect_err("no targets").to_string();
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
