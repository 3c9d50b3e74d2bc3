//! Files of Gaussians: reading, writing and conversion.

use std::fs;
use std::path::Path;

use burn::tensor::Device;
use glam::{DMat3, DVec3};
use serde_json::{Value, json};
use snapsnap_splat::scene::{self, Stored};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};
use snapsnap_tests::character::glb;
use snapsnap_tests::ply::{Format, cloud, ply_bytes};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{Numbers, assert_says, data, ended_with, refused, relative_error, succeed, values};

/// A PLY of `n` Gaussians with spherical harmonics of degree 1.
fn ply(n: usize, bad: Option<usize>) -> Vec<u8> {
    let mut rows = cloud(n, 1);
    bad.into_iter().for_each(|bad| rows[bad][0].1 = f64::NAN);
    ply_bytes(&rows, Format::Ascii, "", b"")
}

/// An SPZ keeps the rotation, not the quaternion's length and sign.
fn check_rotations(before: Vec<f32>, after: Vec<f32>) {
    for (p, q) in before.as_chunks::<4>().0.iter().zip(after.as_chunks::<4>().0) {
        let dot = |p: &[f32; 4], q: &[f32; 4]| p.iter().zip(q).map(|(p, q)| p * q).sum::<f32>();
        let cosine = dot(p, q) / (dot(p, p) * dot(q, q)).sqrt();
        assert!(cosine.abs() > 0.999_99, "{p:?} became {q:?}");
    }
}

/// All formats, properties in another order, extra properties and elements: the same tensors.
#[test]
fn every_layout_of_one_cloud_is_the_same_cloud() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let device = Device::flex();
    for degree in 0..=3 {
        let rows = cloud(50, degree);
        let read = |name: &str, bytes: &[u8]| {
            let path = temporary.path().join(name);
            fs::write(&path, bytes).expect("written");
            let loaded = scene::read(&path, &device).unwrap_or_else(|e| panic!("{name}: {e}"));
            let g = loaded.gaussians;
            let mut all = vec![
                values(g.means),
                values(g.rotations),
                values(g.scales),
                values(g.colors),
                values(g.opacities),
            ];
            assert_eq!(loaded.harmonics.is_some(), degree > 0);
            all.extend(loaded.harmonics.map(values));
            all
        };
        let expected = read("little.ply", &ply_bytes(&rows, Format::Little, "", b""));
        for format in [Format::Ascii, Format::Big, Format::Double] {
            let name = format!("{format:?}.ply");
            assert!(read(&name, &ply_bytes(&rows, format, "", b"")) == expected, "{name}, degree {degree}");
        }
        let mut other = rows.clone();
        for row in &mut other {
            row.retain(|(name, _)| !name.starts_with('n'));
            row.reverse();
            row.insert(3, ("weight".into(), 17.0));
        }
        assert!(read("other.ply", &ply_bytes(&other, Format::Big, "", b"")) == expected, "degree {degree}");
        // A list ahead of the vertices: two faces, of 3 and 1 corners.
        let faces = "element face 2\nproperty list uchar int vertex_indices\n";
        let mut prefix = vec![3];
        prefix.extend([7_i32, 8, 9].iter().flat_map(|v| v.to_be_bytes()));
        prefix.push(1);
        prefix.extend(5_i32.to_be_bytes());
        assert!(read("faces.ply", &ply_bytes(&rows, Format::Big, faces, &prefix)) == expected);
        let lines = b"3 7 8 9\n1 5\n";
        assert!(read("lines.ply", &ply_bytes(&rows, Format::Ascii, faces, lines)) == expected);

        // The numbers of one Gaussian.
        let row = |name: &str| rows[7].iter().find(|(n, _)| n == name).expect(name).1 as f32;
        assert_eq!(expected[0][21..24], ["x", "y", "z"].map(row));
        assert_eq!(expected[1][28..32], ["rot_0", "rot_1", "rot_2", "rot_3"].map(row));
        assert_eq!(expected[2][21..24], ["scale_0", "scale_1", "scale_2"].map(|n| row(n).exp()));
        assert_eq!(expected[4][7], 1.0 / (1.0 + (-row("opacity")).exp()));
        if degree > 0 {
            let k = (degree + 1) * (degree + 1);
            // Coefficient 2 of green: the second of green's block.
            assert_eq!(expected[5][(7 * k + 2) * 3 + 1], row(&format!("f_rest_{}", k - 1 + 1)));
            assert_eq!(expected[5][7 * k * 3 + 2], row("f_dc_2"));
        }
    }
}

#[test]
fn what_is_written_is_read_again() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let [first, second] = ["in.ply", "out.ply"].map(|name| temporary.path().join(name));
    fs::write(&first, ply_bytes(&cloud(300, 0), Format::Little, "", b"")).expect("written");
    let device = Device::flex();
    let read = |path: &Path| scene::read(path, &device).expect("read").gaussians;
    scene::write(&read(&first), &second).expect("written");
    let (first, second) = (read(&first), read(&second));
    let close =
        |a: Vec<f32>, b: Vec<f32>| a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= 2e-6 * (1.0 + b.abs()));
    assert_eq!(values(first.means), values(second.means));
    assert_eq!(values(first.rotations), values(second.rotations));
    assert!(close(values(first.scales), values(second.scales)));
    assert!(close(values(first.opacities), values(second.opacities)));
    assert!(close(values(first.colors), values(second.colors)));
}

/// A turned file looks as before from a turned camera, spherical harmonics included, and reads as before.
#[test]
fn a_ply_with_y_down_is_turned_and_turned_back() {
    let place = Workplace::empty();
    place.write("any.ply", ply_bytes(&cloud(200, 3), Format::Little, "", b""));
    for files in ["any.ply up.ply", "up.ply down.ply --y-down", "down.ply again.ply"] {
        succeed(&mut place.run(&format!("convert {files}")));
    }
    assert!(place.read("up.ply") == place.read("again.ply"));
    // As a viewer that does not know the comment.
    let mut raw = place.read("down.ply");
    let at = raw.windows(12).position(|text| text == b"axes: y down").expect("the comment");
    raw[at..at + 12].copy_from_slice(b"no comment..");
    place.write("raw.ply", raw);
    let look = |name: &str, camera: &Camera| {
        let loaded = scene::read(&place.path(name), &Device::flex()).expect("reads");
        let seen = loaded.seen_by(camera).expect("colours");
        values(render(&seen, std::slice::from_ref(camera), &RenderOptions::inria()).expect("renders").color)
    };
    for camera in Camera::orbit(3, 64, 64) {
        let mut turned = camera;
        turned.world_to_camera.rotation *= DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let (up, down) = (look("up.ply", &camera), look("raw.ply", &turned));
        let largest = up.iter().zip(&down).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest < 1e-4 && up.iter().any(|value| *value > 0.1), "{largest}");
    }
    assert!(refused(&mut place.run("convert up.ply down.spz --y-down")).contains("y up by definition"));
}

/// A colour that is no number is not black.
#[test]
fn colours_that_are_not_finite_are_kept() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = temporary.path().join("in.ply");
    let mut rows = cloud(3, 0);
    for (row, value) in rows.iter_mut().zip([f64::NAN, f64::INFINITY, f64::NEG_INFINITY]) {
        row[6].1 = value;
    }
    fs::write(&path, ply_bytes(&rows, Format::Little, "", b"")).expect("written");
    let colors = values(scene::read(&path, &Device::flex()).expect("read").gaussians.colors);
    assert!([0, 3, 6].iter().all(|i| !colors[*i].is_finite()), "{colors:?}");
}

#[test]
fn gaussians_go_into_an_spz_and_back_within_its_steps() {
    let place = Workplace::empty();
    place.write("a.ply", ply(500, None));
    assert_says(&succeed(&mut place.run("convert a.ply a.spz")), &["500 Gaussians of SH degree 1"]);
    succeed(&mut place.run("convert a.spz b.ply"));
    let [small, back] = ["a.spz", "b.ply"].map(|name| place.read(name).len());
    assert!(3 * small < back, "{small} {back}");
    let read = |name: &str| scene::read(&place.path(name), &Device::flex()).expect("read");
    let (before, after) = (read("a.ply"), read("b.ply"));
    let apart =
        |a: Vec<f32>, b: Vec<f32>| a.iter().zip(b).fold(0.0_f32, |most, (a, b)| most.max((a - b).abs()));
    let (a, b) = (before.gaussians, after.gaussians);
    // Half a step: 1/4096 m, 1/255, 1/16 in the logarithm, C₀/0.15/255 of a colour, 16/128 of a coefficient.
    assert!(apart(values(a.means), values(b.means)) <= 0.5001 / 4096.0);
    assert!(apart(values(a.opacities), values(b.opacities)) <= 0.501 / 255.0);
    assert!(apart(values(a.scales.log()), values(b.scales.log())) <= 0.501 / 16.0);
    assert!(apart(values(a.colors), values(b.colors)) <= 0.501 * 0.2821 / 0.15 / 255.0);
    check_rotations(values(a.rotations), values(b.rotations));
    let bands = |loaded: Option<_>| values::<3>(loaded.expect("degree 1"));
    assert!(apart(bands(before.harmonics)[3..].to_vec(), bands(after.harmonics)[3..].to_vec()) < 0.07);
    // A second quantisation changes nothing.
    succeed(&mut place.run("convert b.ply again.spz"));
    let [once, twice] = ["a.spz", "again.spz"].map(|name| read(name).gaussians);
    assert!(values(once.means) == values(twice.means) && values(once.scales) == values(twice.scales));
    assert!(values(once.opacities) == values(twice.opacities) && values(once.colors) == values(twice.colors));
    check_rotations(values(once.rotations), values(twice.rotations));
}

#[test]
fn what_an_spz_holds_badly_is_told() {
    let place = Workplace::empty();
    place.write("a.ply", ply(20, None));
    let gaussians = scene::read(&place.path("a.ply"), &Device::flex()).expect("read").gaussians;
    let moved = Gaussians { means: gaussians.means.clone() + 1e6, ..gaussians };
    scene::write(&moved, &place.path("b.ply")).expect("written");
    assert_says(&succeed(&mut place.run("convert b.ply b.spz")), &["centres are kept in steps of 125.0 mm"]);
    assert!(!succeed(&mut place.run("convert a.ply b.spz")).contains("steps"));
}

#[test]
fn a_ply_becomes_a_ply_of_the_same_numbers_without_what_is_not_finite() {
    let place = Workplace::empty();
    place.write("a.ply", ply(20, Some(7)));
    assert_says(&ended_with(0, &mut place.run("convert a.ply b.PLY")), &["1 Gaussians were left out"]);
    let mut expected = Stored::read(&place.path("a.ply")).expect("read");
    assert_eq!(expected.drop_undrawable(), 1);
    let found = Stored::read(&place.path("b.PLY")).expect("read");
    assert_eq!(format!("{found:?}"), format!("{expected:?}"));
}

/// A GLB has the same Gaussians with activated values and unit quaternions, for any SH degree.
#[test]
fn a_glb_is_the_same_cloud() {
    let place = Workplace::empty();
    for degree in 0..=3 {
        place.write("a.ply", ply_bytes(&cloud(50, degree), Format::Little, "", b""));
        succeed(&mut place.run("convert a.ply b.glb"));
        succeed(&mut place.run("convert b.glb c.ply"));
        let read = |name: &str| scene::read(&place.path(name), &Device::flex()).expect("a file");
        let before = read("a.ply");
        for name in ["b.glb", "c.ply"] {
            let after = read(name);
            let (a, b) = (before.gaussians.clone(), after.gaussians);
            assert!(values(a.means) == values(b.means) && values(a.colors) == values(b.colors), "{name}");
            check_rotations(values(a.rotations), values(b.rotations));
            for (a, b) in [(values(a.scales), values(b.scales)), (values(a.opacities), values(b.opacities))] {
                assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= 2e-6 * a.abs().max(0.1)), "{name}");
            }
            let harmonics = [before.harmonics.clone(), after.harmonics].map(|h| h.map(values));
            assert!(
                harmonics[0] == harmonics[1] && harmonics[0].is_some() == (degree > 0),
                "{name}, degree {degree}"
            );
        }
    }
}

/// The JSON of a GLB, and its buffer.
fn parts(glb: &[u8]) -> (Value, &[u8]) {
    let length = u32::from_le_bytes(glb[12..16].try_into().expect("four bytes")) as usize;
    (serde_json::from_slice(&glb[20..20 + length]).expect("JSON"), &glb[28 + length..])
}

const SPLATS: &str = "/meshes/0/primitives/0/extensions/KHR_gaussian_splatting";

#[test]
fn glbs_without_gaussians_or_with_others_are_refused() {
    let place = Workplace::empty();
    place.write("a.ply", ply(5, None));
    succeed(&mut place.run("convert a.ply a.glb"));
    let sound = place.read("a.glb");
    let (description, buffer) = parts(&sound);
    let primitive = &description["meshes"][0]["primitives"][0];
    assert_eq!(primitive["extensions"]["KHR_gaussian_splatting"]["kernel"], "ellipse");
    let refusal = |bytes: &[u8]| {
        place.write("bad.glb", bytes);
        let message = place.refusal(&mut place.run("convert bad.glb b.ply"));
        assert!(message.contains("bad.glb"), "{message}");
        message
    };
    assert!(refusal(&sound[..sound.len() - 100]).contains("ends after"));
    assert!(refusal(&sound[..30]).contains("ends"));
    assert!(refusal(b"glTF").contains("ends within its header"));
    // A mesh of triangles.
    assert!(refusal(&glb(&json!({ "asset": { "version": "2.0" } }), buffer)).contains("no Gaussians"));
    for (place, value, expected) in [
        ("/meshes/0/primitives/0/extensions", json!({}), "no Gaussians"),
        ("/nodes/0/translation", json!([0.0, 1.0, 0.0]), "moved"),
        ("/accessors/1/componentType", json!(5120), "VEC4 of floats"),
        ("/accessors/2/count", json!(4), "`scale_0`"),
        ("/accessors/0/count", json!(u64::MAX), "outside of the file"),
        ("/bufferViews/0/byteStride", json!(0), "outside of the file"),
        ("/bufferViews/0/byteOffset", json!(u64::MAX), "outside"),
        ("/bufferViews/0/byteLength", json!(4), "outside"),
        ("/buffers/0/uri", json!("other.bin"), "outside of the file"),
        ("/extensionsRequired", json!(["ACME_more"]), "requires ACME_more"),
        ("/meshes/0/primitives/0/mode", json!(4), "no plain points"),
        ("/meshes/0/primitives/0/indices", json!(0), "no plain points"),
        (&format!("{SPLATS}/kernel"), json!("gaussian2d"), "the `kernel` gaussian2d"),
        (&format!("{SPLATS}/colorSpace"), json!("lin_rec709_display"), "`colorSpace`"),
        (&format!("{SPLATS}/projection"), json!("orthographic"), "`projection`"),
        (&format!("{SPLATS}/sortingMethod"), json!("zDepth"), "`sortingMethod`"),
    ] {
        let mut changed = description.clone();
        let (parent, key) = place.rsplit_once('/').expect("a key");
        changed.pointer_mut(parent).expect("is there")[key] = value;
        let message = refusal(&glb(&changed, buffer));
        assert!(message.contains(expected), "{place}: {message}");
    }
}

/// Its reader is tested with files of PlayCanvas' own program (foreign_files.rs).
#[test]
fn a_sog_has_the_clouds_values_in_its_steps() {
    let place = Workplace::empty();
    let n = 300;
    place.write("a.ply", ply_bytes(&cloud(n, 1), Format::Little, "", b""));
    assert_says(&succeed(&mut place.run("convert a.ply a.sog")), &["degree 1 became degree 0"]);
    succeed(&mut place.run("convert a.ply b.sog"));
    assert!(place.read("a.sog") == place.read("b.sog"), "the same bytes again");

    let numbers = |name: &str| {
        let read = scene::read(&place.path(name), &Device::flex()).expect("a file").gaussians;
        let colors = values((read.colors - 0.5) / 0.282_094_8);
        [
            values(read.means),
            values(read.rotations),
            values(read.scales.log()),
            values(read.opacities),
            colors,
        ]
    };
    let [means, rotations, logs, opacities, dc] = numbers("a.ply");
    let [own_means, own_rotations, own_logs, own_opacities, own_dc] = numbers("a.sog");
    assert_eq!(own_opacities.len(), n);
    let mut found = vec![0; n];
    for i in 0..n {
        let apart = |a: &[f32], row: usize, b: &[f32]| {
            (0..3).map(|axis| (a[3 * row + axis] - b[3 * i + axis]).abs()).fold(0.0, f32::max)
        };
        let distance = |row: usize| apart(&means, row, &own_means);
        let row = (0..n).min_by(|a, b| distance(*a).total_cmp(&distance(*b))).expect("rows");
        found[row] += 1;
        assert!(distance(row) < 2e-4, "{i}");
        let [q, own] = [&rotations[4 * row..][..4], &own_rotations[4 * i..][..4]];
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        let cosine = dot(q, own) / (dot(q, q) * dot(own, own)).sqrt();
        assert!(cosine.abs() > 0.9998, "{q:?} {own:?}");
        assert!(apart(&logs, row, &own_logs) < 0.05 && apart(&dc, row, &own_dc) < 0.05);
        assert!((own_opacities[i] - opacities[row]).abs() < 0.51 / 255.0);
    }
    assert!(found.iter().all(|count| *count == 1), "each Gaussian once");

    // One wild colour is cut off aloud, and leaves the others their codes.
    let mut rows = cloud(n, 0);
    rows[3].iter_mut().find(|(name, _)| *name == "f_dc_0").expect("a colour").1 = 1e30;
    place.write("wild.ply", ply_bytes(&rows, Format::Little, "", b""));
    let said = succeed(&mut place.run("convert wild.ply wild.sog"));
    assert!(said.contains("1 scales and colours beyond ±100 were cut off there"), "{said}");
    let [.., mut colors] = numbers("wild.sog");
    colors.sort_unstable_by(f32::total_cmp);
    colors.dedup();
    assert!(colors.len() > 100, "{colors:?}");
}

/// Other programs' opacities of 0 and 1, flat Gaussians, and quaternions of any length but 0.
#[test]
fn every_command_draws_the_same_gaussians() {
    let place = Workplace::empty();
    let write = |name: &str, change: &dyn Fn(usize, &str, f64) -> f64| {
        let mut rows = cloud(40, 0);
        for (i, row) in rows.iter_mut().enumerate() {
            row.iter_mut().for_each(|(property, value)| *value = change(i, property, *value));
        }
        place.write(name, ply_bytes(&rows, Format::Little, "", b""));
    };
    let pixels = |name: &str| {
        succeed(&mut place.run(&format!("render {name} --orbit 1 --size 48 --quiet --raw raw")));
        Numbers::read(&place.path("raw")).f32("color").1
    };
    let sign = |i: usize| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    write("usual.ply", &|i, property, value| match property {
        "opacity" => 13.8 * sign(i),
        "scale_2" => -23.0,
        _ => value,
    });
    write("odd.ply", &|i, property, value| match property {
        "opacity" => f64::INFINITY * sign(i),
        "scale_2" => f64::NEG_INFINITY,
        _ if property.starts_with("rot") => value * [1e-8, 1.0, 1e19][i % 3],
        _ => value,
    });
    let expected = pixels("usual.ply");
    assert!(relative_error(&pixels("odd.ply"), &expected) < 1e-4);
    succeed(&mut place.run("convert odd.ply again.ply"));
    assert!(relative_error(&pixels("again.ply"), &expected) < 1e-4);
    assert_eq!(Stored::read(&place.path("again.ply")).expect("read").len(), 40);
    // Rows of zeros have no rotation.
    write("zeros.ply", &|i, property, value| if i < 3 && property.starts_with("rot") { 0.0 } else { value });
    for command in ["render zeros.ply --orbit 1 --size 8 --raw raw", "convert zeros.ply less.ply"] {
        assert_says(&ended_with(0, &mut place.run(command)), &["zeros.ply: 3 Gaussians were left out"]);
    }
}

#[test]
fn conversions_that_cannot_be_are_refused() {
    let place = Workplace::empty();
    place.write("nothing.ply", ply(1, Some(0)));
    place.write("a.ply", ply(5, None));
    place.write("cut.spz", &fs::read(data("spz/v3_degree0.spz")).expect("read")[..300]);
    let nothing = "nothing.ply: none of its 1 Gaussians can be drawn";
    for (line, expected) in [
        ("convert nothing.ply b.spz", nothing),
        ("view nothing.ply", nothing),
        ("convert a.ply a.splat", "is no .ply, .spz, .glb or .sog"),
        ("convert none.ply b.spz", "none.ply: cannot read"),
        ("convert cut.spz b.ply", "is cut"),
    ] {
        let message = place.refusal(&mut place.run(line));
        assert!(message.contains(expected), "{line}: {message}");
    }
}
