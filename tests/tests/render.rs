//! `snapsnap render` as a user types it.

use std::path::Path;
use std::process::Command;

use burn::tensor::{Device, Tensor};
use glam::{DVec2, DVec3, Vec3};
use snapsnap_splat::{Camera, Gaussians, Orbit, RenderOptions, render, scene, sh};
use snapsnap_tests::ply::{Format, cloud, ply_bytes};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{Numbers, assert_says, ended_with, sample, succeed, values};

/// `render` in this folder on the CPU.
fn run(place: &Workplace, line: &str) -> Command {
    place.run(&format!("render --device cpu {line}"))
}

fn picture(path: &Path) -> image::RgbImage {
    image::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).into_rgb8()
}

#[test]
fn an_orbit_gives_pictures_cameras_and_raw_tensors() {
    let place = Workplace::empty();
    place.write("in.ply", ply_bytes(&cloud(3000, 2), Format::Little, "", b""));
    let orbit = "in.ply --orbit 3 --size 80x64 --background 0.2,0.4,1 -o out --raw raw -v";
    assert_says(&succeed(&mut run(&place, orbit)), &["3 views of 3000 Gaussians", "visible"]);

    // The library, asked directly.
    let device = Device::flex();
    let views = Camera::orbit(3, 80, 64);
    let loaded = scene::read(&place.path("in.ply"), &device).expect("read");
    let background = Some(Tensor::<1>::from_floats([0.2, 0.4, 1.0], &device));
    let options = RenderOptions { depth: true, background, ..RenderOptions::inria() };
    let raw = Numbers::read(&place.path("raw"));
    assert_eq!(raw.f32("color").0, [3, 64, 80, 3]);
    assert_eq!(raw.f32("alpha").0, [3, 64, 80]);
    assert_eq!(raw.f32("depth").0, [3, 64, 80]);
    for (i, camera) in views.iter().enumerate() {
        let harmonics = loaded.harmonics.as_ref().expect("degree 2");
        let colors = sh::colors(harmonics, &loaded.gaussians.means, camera).expect("colours");
        let gaussians = Gaussians { colors, ..loaded.gaussians.clone() };
        let rendered = render(&gaussians, std::slice::from_ref(camera), &options).expect("rendered");
        let color = values(rendered.color);
        assert!(raw.f32("color").1[i * color.len()..][..color.len()] == color);
        let depth = values(rendered.depth.expect("asked for"));
        assert!(raw.f32("depth").1[i * depth.len()..][..depth.len()] == depth);
        assert!(depth.iter().any(|d| *d > 1.0));
        let picture = picture(&place.path(&format!("out/{i:03}.png")));
        assert_eq!(picture.dimensions(), (80, 64));
        let bytes: Vec<u8> = color.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        assert!(picture.as_raw() == &bytes);
        assert_eq!(picture.get_pixel(0, 0).0, [51, 102, 255]);
    }

    // The cameras it wrote give the same pictures, and fit another size of the same shape.
    let again = "in.ply --cameras out/cameras.json";
    succeed(&mut run(&place, &format!("{again} --background 0.2,0.4,1 -o again")));
    assert!(place.read("out/002.png") == place.read("again/002.png"));
    succeed(&mut run(&place, &format!("{again} --size 40x32 -o small")));
    assert_eq!(picture(&place.path("small/000.png")).dimensions(), (40, 32));
    // With --raw and without -o, only the raw file is written.
    succeed(&mut run(&place, "in.ply --orbit 1 --size 8x8 --raw only"));
    assert!(!place.path("renders").exists());
    succeed(&mut run(&place, "in.ply --orbit 1 --size 8x8"));
    assert!(place.path("renders/000.png").exists());
    succeed(&mut run(&place, "in.ply --orbit 1 --size 9 --background white -o white"));
    let white = picture(&place.path("white/000.png"));
    assert_eq!((white.dimensions(), white.get_pixel(0, 0).0), ((9, 9), [255; 3]));
}

#[test]
fn presets_change_what_is_seen() {
    let place = Workplace::empty();
    place.write("in.ply", ply_bytes(&cloud(500, 0), Format::Little, "", b""));
    let alpha = |options: &str| {
        succeed(&mut run(&place, &format!("in.ply --orbit 1 --size 48x48 --quiet --raw raw {options}")));
        Numbers::read(&place.path("raw")).f32("alpha").1
    };
    let plain = alpha("");
    assert!(plain != alpha("--preset gsplat"));
    assert!(plain != alpha("--antialiased"));
    assert!(plain == alpha("--preset inria"));
}

/// A folder holds the pictures of its cameras and no others.
#[test]
fn pictures_of_older_cameras_go() {
    let place = Workplace::empty();
    place.write("in.ply", ply_bytes(&cloud(20, 0), Format::Little, "", b""));
    for (count, last) in [(5, "004.png"), (2, "001.png")] {
        succeed(&mut run(&place, &format!("in.ply --orbit {count} --size 8x8 --quiet -o views")));
        assert!(place.path("views").join(last).exists());
    }
    assert!(!place.path("views/002.png").exists() && !place.path("views/004.png").exists());
}

#[test]
fn unsuitable_files_and_arguments_are_refused_by_name() {
    let place = Workplace::empty();
    let rows = cloud(20, 1);
    let good = ply_bytes(&rows, Format::Little, "", b"");
    place.write("good.ply", &good);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let header_end = text(&good).find("end_header").expect("header");
    let case = |bytes: &[u8], expected: &[&str]| {
        place.write("bad.ply", bytes);
        let message = place.refusal(&mut run(&place, "bad.ply --orbit 1 --size 8x8"));
        for part in expected.iter().chain(&["bad.ply"]) {
            assert!(message.contains(part), "{part}: {message}");
        }
    };
    case(b"", &["not a PLY"]);
    case(b"solid cube", &["not a PLY"]);
    case(b"\x89PNG\r\n\x1a\n", &["not a PLY"]);
    case(&good[..30], &["end_header"]);
    case(&good[..good.len() - 1], &["vertex 19 of 20: `rot_3` is missing; the file may be cut off"]);
    case(&good[..header_end + 11], &["vertex 0 of 20: `x` is missing"]);
    let header = |from: &str, to: &str| {
        let mut bytes = text(&good[..header_end]).replace(from, to).into_bytes();
        bytes.extend(&good[header_end..]);
        bytes
    };
    case(&header("vertex 20", "vertex 1000000000000"), &["of 1000000000000: `x` is missing"]);
    case(&header("vertex 20", "vertex 99999999999999999999999"), &["header line 4", "not a whole number"]);
    case(&header("vertex 20", "vertex -1"), &["not a whole number"]);
    case(&header("vertex 20", "points 20"), &["no element `vertex`"]);
    case(&header("float opacity", "float transparency"), &["no property `opacity`"]);
    case(&header("float f_rest_8", "float g_rest_8"), &["8 properties `f_rest_*`"]);
    case(&header("float f_rest_8", "float f_rest_9"), &["no property `f_rest_8`"]);
    case(&header("float x", "quad x"), &["header line 5", "no such type"]);
    case(&header("float x", "list uchar float x"), &["list, `x`"]);
    case(&header("binary_little_endian", "binary_middle_endian"), &["binary_middle_endian"]);
    case(&header("format binary_little_endian 1.0\n", ""), &["no format"]);
    case(&header("comment test", "format ascii 1.0"), &["a second format"]);
    case(&header("float f_rest_8", "float x"), &["a second property"]);
    case(&header("element vertex 20", "element vertex 0\nelement vertex 20"), &["a second element"]);
    case(
        &header("comment test", &format!("comment {}", "x".repeat(2 << 20))),
        &["longer than 1048576 bytes"],
    );
    case(&header("comment test", &"\u{1b}[31mx".repeat(900)), &["not understood", "\\u{1b}[31mx"]);
    case(&header("comment test", "nonsense"), &["header line 3", "not understood"]);
    case(&header("comment test", "property float x"), &["no element before it"]);
    // A skipped element that claims far more rows than the file has.
    let skipped = "element vertex 20";
    let lists = "element face 4000000000\nproperty list uchar int i\nelement vertex 20";
    case(&header(skipped, lists), &["of 4000000000: `i` is missing"]);
    case(
        &header(skipped, "element junk 9000000000000000000\nproperty double a\nelement vertex 20"),
        &["of 9000000000000000000: `a` is missing"],
    );
    let ascii = text(&ply_bytes(&rows, Format::Ascii, "", b""));
    case(ascii.replace("vertex 20", "vertex 21").as_bytes(), &["vertex 20 of 21: `x`"]);
    case(ascii.replace("vertex 20", "vertex 1000000000").as_bytes(), &["vertex 20 of 1000000000"]);
    let last = ascii.trim_end().rfind(' ').expect("numbers");
    case(&ascii.as_bytes()[..last], &["vertex 19 of 20: `rot_3` is missing"]);
    case(format!("{} 1 2\n", &ascii[..last]).as_bytes(), &["vertex 19 of 20: `rot_3` is not the last value"]);
    case(format!("{} zero\n", &ascii[..last]).as_bytes(), &["vertex 19 of 20: `rot_3` is `zero`"]);

    place.write("folder", b"");
    place.write("wide.json", br#"[{"width":8,"height":4,"fx":9,"fy":9,"cx":4,"cy":2,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]},{"width":4,"height":4,"fx":9,"fy":9,"cx":4,"cy":2,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]}]"#);
    for (line, expected) in [
        ("missing.ply --orbit 1", "missing.ply"),
        ("good.ply", "--cameras"),
        ("good.ply --orbit 1 --cameras wide.json", "cannot be used with"),
        ("good.ply --orbit 0", "--orbit 0"),
        ("good.ply --cameras missing.json", "missing.json"),
        ("good.ply --cameras good.ply", "good.ply"),
        ("good.ply --cameras wide.json --size 8x8", "another shape"),
        ("good.ply --cameras wide.json --raw r", "one size"),
        ("good.ply --orbit 1 --size 8x", "WIDTHxHEIGHT"),
        ("good.ply --orbit 1 --size 0x8", "WIDTHxHEIGHT"),
        ("good.ply --orbit 1 --size 8x99999", "32768"),
        ("good.ply --orbit 1 --size 32768x32768", "megapixels"),
        ("good.ply --orbit 1 --background 1,1", "three numbers"),
        ("good.ply --orbit 1 --background 1,1,nan", "three numbers"),
        ("good.ply --orbit 1 --raw no/raw", "no/raw"),
        ("good.ply --orbit 1 -o folder", "is no folder"),
        ("good.ply --orbit 1 -o folder/views", "folder/views: cannot write"),
    ] {
        let message = place.refusal(&mut run(&place, line));
        assert!(message.contains(expected), "{line}: {message}");
    }
}

/// A pipe gets the tensors and nothing else.
#[cfg(target_os = "linux")]
#[test]
fn raw_tensors_go_into_a_pipe() {
    let place = Workplace::empty();
    place.write("a.ply", ply_bytes(&cloud(20, 0), Format::Little, "", b""));
    let orbit = "a.ply --orbit 2 --size 24x16 -v --raw";
    succeed(run(&place, orbit).arg("file"));
    let output = run(&place, orbit).arg("/dev/stdout").output().expect("started");
    assert!(output.status.success());
    assert!(output.stdout == place.read("file"));
    assert!(String::from_utf8_lossy(&output.stderr).contains("2 views of 20 Gaussians"));
}

/// Values that are not finite in a file are counted and left out.
#[test]
fn poisoned_files_still_render() {
    let place = Workplace::empty();
    let mut rows = cloud(40, 0);
    for (i, value) in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY].into_iter().enumerate() {
        rows[i][0].1 = value;
        rows[i + 3][9].1 = value;
        rows[i + 6][10].1 = value;
    }
    place.write("in.ply", ply_bytes(&rows, Format::Little, "", b""));
    let said = ended_with(0, &mut run(&place, "in.ply --orbit 1 --size 64x64 --raw raw"));
    // Opacity ±∞ is 1 and 0, scale −∞ is 0: these values are valid.
    assert!(said.contains("in.ply: 6 Gaussians were left out"), "{said}");
    assert!(Numbers::read(&place.path("raw")).f32("color").1.iter().all(|c| c.is_finite()));
}

#[test]
fn views_that_show_nothing_are_said_aloud() {
    let place = Workplace::empty();
    let mut rows = cloud(10, 0);
    rows.iter_mut().for_each(|row| row[0].1 = 1e6);
    place.write("in.ply", ply_bytes(&rows, Format::Little, "", b""));
    let message = ended_with(0, &mut run(&place, "in.ply --orbit 2 --size 8x8"));
    assert!(message.contains("2 of 2 views show no Gaussian"), "{message}");
    // A file without Gaussians is a picture of the background.
    let mut empty = ply_bytes(&rows, Format::Little, "", b"");
    let header = String::from_utf8_lossy(&empty).find("end_header").expect("header") + 11;
    empty.truncate(header);
    let empty = String::from_utf8(empty).expect("header").replace("vertex 10", "vertex 0");
    place.write("empty.ply", empty.as_bytes());
    succeed(&mut run(&place, "empty.ply --orbit 1 --size 8x8 --background 1,0,0 -o empty"));
    assert!(picture(&place.path("empty/000.png")).pixels().all(|p| p.0 == [255, 0, 0]));
}

/// The head of the sample person is closed.
#[test]
fn a_head_is_closed_from_above() {
    let place = Workplace::empty();
    succeed(&mut sample::reconstruct(place.folder(), &sample::paths()));
    let gaussians = scene::read(&place.path("human.ply"), &Device::flex()).expect("Gaussians").gaussians;

    let means: Vec<DVec3> = values(gaussians.means.clone())
        .as_chunks::<3>()
        .0
        .iter()
        .map(|p| Vec3::from_array(*p).as_dvec3())
        .collect();
    let top = means.iter().fold(0.0, |top: f64, p| top.max(p.y));
    let head: Vec<&DVec3> = means.iter().filter(|p| p.y > top - 0.15).collect();
    let middle = head.iter().copied().sum::<DVec3>() / head.len() as f64;
    // From a metre above, a pixel of the middle shows 4 mm.
    let centre = DVec3::new(middle.x, top, middle.z);
    let camera = Orbit { pitch_degrees: 90.0, radius: 1.0, centre, ..Orbit::default() }.camera(300);
    let options = RenderOptions { depth: true, ..RenderOptions::inria() };
    let seen = render(&gaussians, &[camera], &options).expect("a picture");
    let (alpha, depth) = (values(seen.alpha), values(seen.depth.expect("depth")));
    let [column, row] = camera.principal_point.to_array().map(|at| at as usize);
    // A disc of 10 cm: hair ends a few centimetres lower there.
    for (y, x) in (0..26).flat_map(|y| (0..26).map(move |x| (y, x))) {
        if (x as f64 - 13.0).hypot(y as f64 - 13.0) < 12.5 {
            let i = (row + y - 13) * 300 + column + x - 13;
            assert!(alpha[i] > 0.9, "{x} {y}: alpha {}", alpha[i]);
            let below = depth[i] / alpha[i] - 1.0;
            assert!(below < 0.08, "{x} {y}: {below} m below the top");
        }
    }
}

/// From four times as near, the sample person is opaque.
#[test]
fn nothing_shines_through_a_person_from_near() {
    const SIDE: usize = 512;
    const NEARER: f64 = 4.0;
    /// Pixels at the outline that are not judged.
    const RIM: usize = 6;
    let place = Workplace::empty();
    succeed(&mut sample::reconstruct(place.folder(), &sample::paths()));
    let gaussians = scene::read(&place.path("human.ply"), &Device::flex()).expect("Gaussians").gaussians;
    for yaw in [0.0, 90.0, 180.0, 270.0] {
        let camera = Camera::orbit_at_yaw_degrees(yaw, SIDE as u32);
        let alpha = |camera: Camera| {
            values(render(&gaussians, &[camera], &RenderOptions::inria()).expect("a picture").alpha)
        };
        let far = alpha(camera);
        let is_inside = |x: usize, y: usize| {
            let around = |at: usize| at.saturating_sub(RIM)..(at + RIM + 1).min(SIDE);
            around(y).all(|row| around(x).all(|column| far[row * SIDE + column] > 0.9))
        };
        // The chest is a little above the middle of the picture.
        let aim = camera.principal_point - DVec2::new(0.0, 0.12 * SIDE as f64);
        let middle = DVec2::splat(0.5 * SIDE as f64);
        let principal_point = middle + NEARER * (camera.principal_point - aim);
        let near = alpha(Camera { focal: NEARER * camera.focal, principal_point, ..camera });
        let (mut judged, mut clear) = (0, 0);
        for (i, alpha) in near.iter().enumerate() {
            let at = DVec2::new((i % SIDE) as f64 + 0.5, (i / SIDE) as f64 + 0.5);
            let there = aim + (at - middle) / NEARER;
            if is_inside(there.x as usize, there.y as usize) {
                judged += 1;
                clear += usize::from(*alpha < 0.98);
            }
        }
        assert!(judged > SIDE * SIDE / 4, "{yaw}°: {judged} pixels");
        println!("{yaw}°: {clear} of {judged} pixels are not opaque");
        assert!(clear as f64 <= 0.005 * judged as f64, "{yaw}°: {clear} of {judged} pixels are not opaque");
    }
}
