//! Gaussians in files of other programs: what they are there is what is read here.

use std::io::{Cursor, Read, Write};

use burn::tensor::Device;
use snapsnap_splat::Gaussians;
use snapsnap_splat::scene::{self, Loaded};
use snapsnap_tests::ply::{Format, cloud, ply_bytes};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{data, succeed, values};

fn read(path: &std::path::Path) -> Loaded {
    scene::read(path, &Device::flex()).unwrap_or_else(|e| panic!("{e}"))
}

/// Largest difference of two lists of numbers of one length.
fn apart(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Centres, scales, opacities, colours and harmonics.
fn numbers(Loaded { gaussians, harmonics }: Loaded) -> [Vec<f32>; 5] {
    let Gaussians { means, scales, opacities, colors, .. } = gaussians;
    [
        values(means),
        values(scales),
        values(opacities),
        values(colors),
        harmonics.map(values).unwrap_or_default(),
    ]
}

/// `tests/data/foreign`: a cloud as splat-transform 2.7.1 packed it, and the PLY that it made of each packed file.
#[test]
fn packed_files_are_read_as_their_makers_read_them() {
    let cases = [("cloud.compressed.ply", "compressed.ply"), ("cloud.sog", "sog.ply")];
    for (packed, plain) in cases {
        let [packed, plain] = [packed, plain].map(|name| data(&format!("foreign/{name}")));
        let (found, expected) = (read(&packed), read(&plain));
        let [found_q, expected_q] =
            [&found, &expected].map(|loaded| values(loaded.gaussians.rotations.clone()));
        let is_sog = packed.extension().is_some_and(|extension| extension == "sog");
        let (found, mut expected) = (numbers(found), numbers(expected));
        if is_sog {
            // A SOG is turned by 180° about z (crates/splat/src/sog.rs), its own PLY is not.
            expected[0].chunks_exact_mut(3).for_each(|p| (p[0], p[1]) = (-p[0], -p[1]));
            for (at, value) in expected[4].iter_mut().enumerate() {
                *value *= if at / 3 % 16 % 2 == 1 { -1.0 } else { 1.0 };
            }
        }
        for (found, expected) in found.iter().zip(&expected) {
            assert!(apart(found, expected) < 2e-6, "{}", packed.display());
        }
        for (q, expected) in found_q.chunks_exact(4).zip(expected_q.chunks_exact(4)) {
            let [w, x, y, z] = expected.try_into().expect("four");
            let turned = if is_sog { [-z, -y, x, w] } else { [w, x, y, z] };
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
            let cosine = dot(q, &turned) / (dot(q, q) * dot(&turned, &turned)).sqrt();
            assert!(cosine.abs() > 0.999_999, "{}: {q:?}, {turned:?}", packed.display());
        }
    }
}

/// Version 4 packs the bytes of version 3 in another way.
#[test]
fn an_spz_of_version_4_is_that_of_version_3() {
    let [third, fourth] = ["spz/v3_degree3.spz", "spz/v4_degree3.spz"].map(|name| numbers(read(&data(name))));
    assert_eq!(third, fourth);
    assert!(!third[4].is_empty());
    assert_eq!(read(&data("spz/v4_degree1.spz")).gaussians.len(), 8);
}

#[test]
fn points_with_plain_colours_and_splats_are_the_same_cloud() {
    let place = Workplace::empty();
    let rows = cloud(30, 0);
    place.write("own.ply", ply_bytes(&rows, Format::Little, "", b""));
    let own = read(&place.path("own.ply"));
    let mut colored = rows.clone();
    for row in &mut colored {
        for (name, value) in row.iter_mut() {
            let renamed = match name.as_str() {
                "f_dc_0" => "red",
                "f_dc_1" => "green",
                "f_dc_2" => "blue",
                _ => continue,
            };
            (*name, *value) = (renamed.into(), 0.5 + 0.282_094_79 * *value);
        }
    }
    place.write("colored.ply", ply_bytes(&colored, Format::Little, "", b""));
    let colored = read(&place.path("colored.ply"));
    for (a, b) in numbers(colored).iter().zip(&numbers(own.clone())) {
        assert!(apart(a, b) < 1e-5);
    }

    let [means, scales, opacities, colors, _] = numbers(own.clone());
    let rotations = values(own.gaussians.rotations);
    let byte = |value: f32| (255.0 * value).round().clamp(0.0, 255.0) as u8;
    let mut splat = Vec::new();
    for i in 0..rows.len() {
        let floats = [&means[3 * i..3 * i + 3], &scales[3 * i..3 * i + 3]].concat();
        splat.extend(floats.iter().flat_map(|value| value.to_le_bytes()));
        splat.extend(colors[3 * i..3 * i + 3].iter().chain([&opacities[i]]).map(|value| byte(*value)));
        let q = &rotations[4 * i..4 * i + 4];
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        splat.extend(q.iter().map(|v| (128.0 * v / length + 128.0).round().clamp(0.0, 255.0) as u8));
    }
    place.write("own.splat", &splat);
    let found = numbers(read(&place.path("own.splat")));
    assert_eq!(found[0], means);
    assert!(found[1].iter().zip(&scales).all(|(a, b)| (a / b - 1.0).abs() < 1e-5));
    assert!(apart(&found[2], &opacities) < 0.5 / 254.0);
    let shown: Vec<f32> = colors.iter().map(|color| color.clamp(0.0, 1.0)).collect();
    assert!(apart(&found[3], &shown) < 0.5 / 254.0);
    place.write("cut.splat", &splat[..splat.len() - 1]);
    let said = place.refusal(&mut place.run("convert cut.splat out.ply"));
    assert!(said.contains("cut.splat: 959 bytes; a .splat has 32 for each Gaussian"), "{said}");
}

/// A SOG of our own with another `meta.json`.
fn with_meta(sog: &[u8], change: &dyn Fn(&mut serde_json::Value)) -> Vec<u8> {
    let mut archive = zip::ZipArchive::new(Cursor::new(sog)).expect("a ZIP");
    let mut made = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for i in 0..archive.len() {
        let mut file = archive.by_index(i).expect("a file");
        let name = file.name().expect("a name").into_owned();
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).expect("read");
        if name == "meta.json" {
            let mut meta = serde_json::from_slice(&bytes).expect("JSON");
            change(&mut meta);
            bytes = meta.to_string().into_bytes();
        }
        made.start_file(name, zip::write::SimpleFileOptions::default()).expect("begun");
        made.write_all(&bytes).expect("written");
    }
    made.finish().expect("finished").into_inner()
}

#[test]
fn damaged_files_of_others_are_refused_by_name() {
    let place = Workplace::empty();
    let sog = std::fs::read(data("foreign/cloud.sog")).expect("read");
    let refused = |name: &str, bytes: &[u8], expected: &str| {
        place.write(name, bytes);
        let said = place.refusal(&mut place.run(&format!("convert {name} out.ply")));
        assert!(said.contains(name) && said.contains(expected), "{expected}: {said}");
    };
    refused("cut.sog", &sog[..sog.len() / 2], "its ZIP is damaged");
    refused("v1.sog", &with_meta(&sog, &|meta| meta["version"] = 1.into()), "SOG of version 1; 2 is read");
    refused("none.sog", &with_meta(&sog, &|meta| meta["count"] = 0.into()), "`count` is no number");
    refused("many.sog", &with_meta(&sog, &|meta| meta["count"] = 200_000_000.into()), "times as large");
    refused("few.sog", &with_meta(&sog, &|meta| meta["count"] = 2000.into()), "pixels for 2000 Gaussians");
    let book = |meta: &mut serde_json::Value| meta["scales"]["codebook"] = serde_json::json!([1.0]);
    refused("book.sog", &with_meta(&sog, &book), "`scales` lacks its 256 numbers");
    let path = |meta: &mut serde_json::Value| meta["sh0"]["files"][0] = "../../etc/passwd".into();
    refused("path.sog", &with_meta(&sog, &path), "../../etc/passwd");

    let spz = std::fs::read(data("spz/v4_degree3.spz")).expect("read");
    refused("cut.spz", &spz[..spz.len() - 40], "the stream of spherical harmonics is damaged");
    let mut far = spz.clone();
    far[16..20].copy_from_slice(&u32::MAX.to_le_bytes());
    refused("far.spz", &far, "the table of its streams is not in the file");
    let mut many = spz.clone();
    many[8..12].copy_from_slice(&9_000_000_u32.to_le_bytes());
    refused("many.spz", &many, "times as large as the file");

    let packed = std::fs::read(data("foreign/cloud.compressed.ply")).expect("read");
    let text = |from: &str, to: &str| {
        let at = packed.windows(from.len()).position(|w| w == from.as_bytes()).expect("there");
        [&packed[..at], to.as_bytes(), &packed[at + from.len()..]].concat()
    };
    refused("cut.ply", &packed[..packed.len() - 1], "is missing; the file may be cut off");
    refused("chunks.ply", &text("element chunk 1\n", "element chunk 0\n"), "0 chunks for 24 Gaussians");
    // Rows without bytes would be read for ever.
    let endless = text("element sh 24\n", "element sh 99999999999999\nelement other 24\n");
    refused("endless.ply", &endless, "`sh` has no properties");
    refused("name.ply", &text("packed_scale", "packed_scare"), "without `packed_scale`");
}

/// The page has the person and no address of another file.
#[test]
fn a_page_contains_the_person() {
    let place = Workplace::empty();
    place.write("a \"b\" <c>.ply", ply_bytes(&cloud(30, 0), Format::Little, "", b""));
    let mut convert = place.run("convert");
    succeed(convert.args(["a \"b\" <c>.ply", "page.html"]));
    let page = String::from_utf8(place.read("page.html")).expect("text");
    assert!(page.contains("data-name=\"a &quot;b&quot; &lt;c>\""));
    assert!(!page.contains("./viewer.js") && !page.contains("./viewer.css"));
    // Each script ends once.
    assert_eq!((page.matches("<script").count(), page.matches("</script>").count()), (2, 2));
    let said = place.refusal(place.run("convert --y-down").args(["a \"b\" <c>.ply", "b.html"]));
    assert!(said.contains("--y-down is for PLYs"), "{said}");
}
