//! `snapsnap render` as a user types it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use burn::tensor::{Device, Tensor};
use glam::{DVec3, Vec3};
use snapsnap_splat::{Camera, Gaussians, Orbit, RenderOptions, cameras, render, scene, sh};
use snapsnap_tests::ply::{Format, cloud, ply_bytes};
use snapsnap_tests::{Numbers, refused, root, snapsnap, succeed, values};

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("temporary folder"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, bytes).expect("written");
        path
    }

    /// `render` in this folder on the CPU.
    fn render(&self, arguments: &[&str]) -> Command {
        let mut command = snapsnap();
        command.current_dir(self.0.path()).args(["render", "--device", "cpu"]).args(arguments);
        command
    }

    fn files(&self) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(self.0.path())
            .expect("list")
            .map(|e| e.expect("entry").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

fn picture(path: &Path) -> image::RgbImage {
    image::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).into_rgb8()
}

#[test]
fn an_orbit_gives_pictures_cameras_and_raw_tensors() {
    let place = Place::new();
    let path = place.file("in.ply", &ply_bytes(&cloud(3000, 2), Format::Little, "", b""));
    let orbit = [
        "in.ply",
        "--orbit",
        "3",
        "--size",
        "80x64",
        "--background",
        "0.2,0.4,1",
        "-o",
        "out",
        "--raw",
        "raw",
    ];
    let printed = succeed(place.render(&orbit).arg("-v"));
    assert!(printed.contains("3 views of 3000 Gaussians") && printed.contains("visible"), "{printed}");

    // The library, asked directly.
    let device = Device::flex();
    let views = Camera::orbit(3, 80, 64);
    let loaded = scene::read(&path, &device).expect("read");
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
    succeed(&mut place.render(&[
        "in.ply",
        "--cameras",
        "out/cameras.json",
        "--background",
        "0.2,0.4,1",
        "-o",
        "again",
    ]));
    assert_eq!(
        fs::read(place.path("out/002.png")).expect("old"),
        fs::read(place.path("again/002.png")).expect("new")
    );
    succeed(&mut place.render(&[
        "in.ply",
        "--cameras",
        "out/cameras.json",
        "--size",
        "40x32",
        "-o",
        "small",
    ]));
    assert_eq!(picture(&place.path("small/000.png")).dimensions(), (40, 32));
    // With --raw and without -o, only the raw file is written.
    succeed(&mut place.render(&["in.ply", "--orbit", "1", "--size", "8x8", "--raw", "only"]));
    assert!(!place.files().contains(&"renders".to_owned()));
    succeed(&mut place.render(&["in.ply", "--orbit", "1", "--size", "8x8"]));
    assert!(place.path("renders/000.png").exists());
}

#[test]
fn presets_change_what_is_seen() {
    let place = Place::new();
    place.file("in.ply", &ply_bytes(&cloud(500, 0), Format::Little, "", b""));
    let render = |more: &[&str], out: &str| {
        succeed(
            place.render(&["in.ply", "--orbit", "1", "--size", "48x48", "--quiet", "--raw", out]).args(more),
        );
        Numbers::read(&place.path(out)).f32("alpha").1
    };
    let plain = render(&[], "a");
    assert!(plain != render(&["--preset", "gsplat"], "b"));
    assert!(plain != render(&["--antialiased"], "c"));
    assert!(plain == render(&["--preset", "inria"], "d"));
}

#[test]
fn unsuitable_files_and_arguments_are_refused_by_name() {
    let place = Place::new();
    let rows = cloud(20, 1);
    let good = ply_bytes(&rows, Format::Little, "", b"");
    place.file("good.ply", &good);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let header_end = text(&good).find("end_header").expect("header");
    let case = |bytes: &[u8], expected: &[&str]| {
        place.file("bad.ply", bytes);
        let before = place.files();
        let message = refused(&mut place.render(&["bad.ply", "--orbit", "1", "--size", "8x8"]));
        for part in expected.iter().chain(&["bad.ply"]) {
            assert!(message.contains(part), "{part}: {message}");
        }
        assert_eq!(place.files(), before);
    };
    case(b"", &["not a PLY"]);
    case(b"solid cube", &["not a PLY"]);
    case(b"\x89PNG\r\n\x1a\n", &["not a PLY"]);
    case(&good[..30], &["end_header"]);
    case(&good[..good.len() - 1], &["20 vertices", "ends too early"]);
    case(&good[..header_end + 11], &["ends too early"]);
    let header = |from: &str, to: &str| {
        let mut bytes = text(&good[..header_end]).replace(from, to).into_bytes();
        bytes.extend(&good[header_end..]);
        bytes
    };
    case(&header("vertex 20", "vertex 1000000000000"), &["1000000000000 vertices"]);
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
    case(&header(skipped, lists), &["element `face`"]);
    case(
        &header(skipped, "element junk 9000000000000000000\nproperty double a\nelement vertex 20"),
        &["element `junk`"],
    );
    let ascii = text(&ply_bytes(&rows, Format::Ascii, "", b""));
    case(ascii.replace("vertex 20", "vertex 21").as_bytes(), &["21 vertices", "20 are there"]);
    case(ascii.replace("vertex 20", "vertex 1000000000").as_bytes(), &["1000000000 vertices"]);
    let last = ascii.trim_end().rfind(' ').expect("numbers");
    case(&ascii.as_bytes()[..last], &["vertex 19", "values, expected 26"]);
    case(format!("{} zero\n", &ascii[..last]).as_bytes(), &["vertex 19: `rot_3` is `zero`"]);

    place.file("folder", b"");
    place.file("wide.json", br#"[{"width":8,"height":4,"fx":9,"fy":9,"cx":4,"cy":2,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]},{"width":4,"height":4,"fx":9,"fy":9,"cx":4,"cy":2,"world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]}]"#);
    let before = place.files();
    let long = ["--orbit", "1", "--size"];
    for (arguments, expected) in [
        (vec!["missing.ply", "--orbit", "1"], "missing.ply"),
        (vec!["good.ply"], "--cameras"),
        (vec!["good.ply", "--orbit", "1", "--cameras", "wide.json"], "cannot be used with"),
        (vec!["good.ply", "--orbit", "0"], "--orbit 0"),
        (vec!["good.ply", "--cameras", "missing.json"], "missing.json"),
        (vec!["good.ply", "--cameras", "good.ply"], "good.ply"),
        (vec!["good.ply", "--cameras", "wide.json", "--size", "8x8"], "another shape"),
        (vec!["good.ply", "--cameras", "wide.json", "--raw", "r"], "one size"),
        ([&["good.ply"], &long[..], &["8"]].concat(), "WIDTHxHEIGHT"),
        ([&["good.ply"], &long[..], &["0x8"]].concat(), "WIDTHxHEIGHT"),
        ([&["good.ply"], &long[..], &["8x99999"]].concat(), "32768"),
        ([&["good.ply"], &long[..], &["32768x32768"]].concat(), "megapixels"),
        (vec!["good.ply", "--orbit", "1", "--background", "1,1"], "three numbers"),
        (vec!["good.ply", "--orbit", "1", "--background", "1,1,nan"], "three numbers"),
        (vec!["good.ply", "--orbit", "1", "--raw", "good.ply"], "would be overwritten"),
        (vec!["good.ply", "--orbit", "1", "--raw", "no/raw"], "no/raw"),
        (vec!["good.ply", "--orbit", "1", "-o", "folder"], "is no folder"),
    ] {
        let message = refused(&mut place.render(&arguments));
        assert!(message.contains(expected), "{arguments:?}: {message}");
        assert_eq!(place.files(), before, "{arguments:?}");
    }
}

/// Pictures and cameras go into a folder: nothing that the command reads, and no other output, may be among them.
#[test]
fn no_input_and_no_other_output_is_overwritten() {
    let place = Place::new();
    let bytes = ply_bytes(&cloud(20, 0), Format::Little, "", b"");
    let orbit = ["--orbit", "2", "--size", "8x8"];
    fs::create_dir(place.path("d")).expect("folder");
    for name in ["d/000.png", "d/001.png", "d/cameras.json"] {
        place.file(name, &bytes);
        let message = refused(place.render(&[name]).args(orbit).args(["-o", "d"]));
        assert!(message.contains("would be overwritten"), "{name}: {message}");
        assert!(fs::read(place.path(name)).expect("still there") == bytes);
        fs::remove_file(place.path(name)).expect("removed");
    }
    place.file("a.ply", &bytes);
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(place.path("a.ply"), place.path("d/001.png")).expect("link");
        let message = refused(place.render(&["a.ply"]).args(orbit).args(["-o", "d"]));
        assert!(message.contains("would be overwritten"), "{message}");
        assert!(fs::read(place.path("a.ply")).expect("still there") == bytes);
        fs::remove_file(place.path("d/001.png")).expect("removed");
    }
    for raw in ["d/000.png", "./d/../d/001.png", "d/cameras.json", "new/000.png"] {
        let folder = if raw.starts_with("new") { "new" } else { "d" };
        let message = refused(place.render(&["a.ply"]).args(orbit).args(["-o", folder, "--raw", raw]));
        assert!(message.contains("two outputs"), "{raw}: {message}");
    }
    // A picture's place taken by a folder is seen before anything is rendered.
    fs::create_dir(place.path("d/001.png")).expect("folder");
    assert!(refused(place.render(&["a.ply"]).args(orbit).args(["-o", "d"])).contains("001.png"));
    assert!(!place.path("d/000.png").exists());
    fs::remove_dir(place.path("d/001.png")).expect("removed");
    // The cameras that are read stay as they are, pictures of an earlier run are replaced.
    succeed(place.render(&["a.ply"]).args(orbit).args(["-o", "d"]));
    let cameras = fs::read(place.path("d/cameras.json")).expect("cameras");
    succeed(&mut place.render(&["a.ply", "--cameras", "d/cameras.json", "-o", "d"]));
    assert!(fs::read(place.path("d/cameras.json")).expect("cameras") == cameras);
    // The existing cameras.json would not describe pictures of another size.
    let mut command = place.render(&["a.ply", "--cameras", "d/cameras.json", "-o", "d"]);
    let picture = fs::read(place.path("d/000.png")).expect("a picture");
    let message = refused(command.args(["--size", "32x32"]));
    assert!(message.contains("d/cameras.json") && message.contains("another folder"), "{message}");
    assert!(fs::read(place.path("d/000.png")).expect("a picture") == picture);
}

/// A pipe gets the tensors and nothing else.
#[cfg(target_os = "linux")]
#[test]
fn raw_tensors_go_into_a_pipe() {
    let place = Place::new();
    place.file("a.ply", &ply_bytes(&cloud(20, 0), Format::Little, "", b""));
    let orbit = ["a.ply", "--orbit", "2", "--size", "24x16", "-v", "--raw"];
    succeed(place.render(&orbit).arg("file"));
    let output = place.render(&orbit).arg("/dev/stdout").output().expect("started");
    assert!(output.status.success());
    assert!(output.stdout == fs::read(place.path("file")).expect("read"));
    assert!(String::from_utf8_lossy(&output.stderr).contains("2 views of 20 Gaussians"));
}

/// Values that are not finite in a file are counted and left out.
#[test]
fn poisoned_files_still_render() {
    let place = Place::new();
    let mut rows = cloud(40, 0);
    for (i, value) in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY].into_iter().enumerate() {
        rows[i][0].1 = value;
        rows[i + 3][9].1 = value;
        rows[i + 6][10].1 = value;
    }
    place.file("in.ply", &ply_bytes(&rows, Format::Little, "", b""));
    let printed =
        succeed(&mut place.render(&["in.ply", "--orbit", "1", "--size", "64x64", "--raw", "raw", "-v"]));
    // Opacity ±∞ is 1 and 0, scale −∞ is 0: these values are valid.
    assert!(
        printed.lines().any(|l| l.contains("not finite or huge") && l.trim_end().ends_with(" 6.0")),
        "{printed}"
    );
    assert!(Numbers::read(&place.path("raw")).f32("color").1.iter().all(|c| c.is_finite()));
}

#[test]
fn views_that_show_nothing_are_said_aloud() {
    let place = Place::new();
    let mut rows = cloud(10, 0);
    rows.iter_mut().for_each(|row| row[0].1 = 1e6);
    place.file("in.ply", &ply_bytes(&rows, Format::Little, "", b""));
    let output = place.render(&["in.ply", "--orbit", "2", "--size", "8x8"]).output().expect("started");
    assert!(output.status.success());
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("2 of 2 views show no Gaussian"), "{message}");
    // A file without Gaussians is a picture of the background.
    let mut empty = ply_bytes(&rows, Format::Little, "", b"");
    let header = String::from_utf8_lossy(&empty).find("end_header").expect("header") + 11;
    empty.truncate(header);
    let empty = String::from_utf8(empty).expect("header").replace("vertex 10", "vertex 0");
    place.file("empty.ply", empty.as_bytes());
    succeed(&mut place.render(&[
        "empty.ply",
        "--orbit",
        "1",
        "--size",
        "8x8",
        "--background",
        "1,0,0",
        "-o",
        "empty",
    ]));
    assert!(picture(&place.path("empty/000.png")).pixels().all(|p| p.0 == [255, 0, 0]));
}

/// A written `cameras.json` has the documented keys.
#[test]
fn cameras_files_are_the_fixtures_format() {
    let place = Place::new();
    cameras::write(&Camera::orbit(2, 30, 20), &place.path("c.json")).expect("written");
    let text = fs::read_to_string(place.path("c.json")).expect("read");
    for key in ["width", "height", "fx", "fy", "cx", "cy", "world_to_camera"] {
        assert!(text.contains(&format!("\"{key}\"")), "{key}: {text}");
    }
}

/// The head of the sample person is closed.
#[test]
fn a_head_is_closed_from_above() {
    let place = Place::new();
    let pictures = ["front.png", "back.png"].map(|name| root().join("assets/sample").join(name));
    let mut command = snapsnap();
    command.current_dir(place.0.path()).arg("reconstruct").args(pictures);
    succeed(command.args(["-o", "human.ply", "--device", "cpu"]));
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
