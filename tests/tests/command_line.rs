//! The command line as a user types it: real pictures, wrong input, and what is left on disk.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use image::{DynamicImage, GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use snapsnap_tests::{Numbers, fill_weights, refused, root, shared, snapsnap, succeed};

/// A temporary folder with tiny random weights and two pictures.
struct Workplace(tempfile::TempDir);

impl Workplace {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("temporary folder"));
        succeed(
            snapsnap()
                .args(["init-weights", "--seed", "1", "--config"])
                .arg(tiny())
                .arg("-o")
                .arg(place.path("w")),
        );
        for (name, seed) in [("front.png", 1), ("back.png", 2)] {
            person(200, 320, seed, 0).save(place.path(name)).expect("PNG");
        }
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// `reconstruct` with two pictures of this folder; writes `human.ply` there.
    fn reconstruct(&self, front: &str, back: &str) -> Command {
        let mut command = self.reconstruct_anywhere(front, back);
        command.args(["--device", "cpu"]);
        command
    }

    /// As [`Self::reconstruct`], without `--device`.
    fn reconstruct_anywhere(&self, front: &str, back: &str) -> Command {
        let mut command = snapsnap();
        command.current_dir(self.0.path()).args(["reconstruct", front, back, "--weights", "w"]);
        command
    }

    /// The message of a refused command, which may write nothing.
    fn refusal(&self, command: &mut Command) -> String {
        let before = self.files();
        let message = refused(command);
        assert_eq!(self.files(), before, "{message}");
        message
    }

    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).expect("list");
        let mut names: Vec<String> =
            entries.map(|e| e.expect("entry").file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

fn tiny() -> PathBuf {
    root().join("configs/tiny.toml")
}

/// An ellipse of coloured stripes; `background` goes into the colours of fully transparent pixels.
fn person(width: u32, height: u32, seed: u32, background: u8) -> RgbaImage {
    RgbaImage::from_fn(width, height, |x, y| {
        let (u, v) = (x as f32 / width as f32 - 0.5, y as f32 / height as f32 - 0.5);
        if (u / 0.3).powi(2) + (v / 0.45).powi(2) < 1.0 {
            Rgba([(x * 7 + seed * 31) as u8, (y * 5) as u8, ((x + y) * 3) as u8, 255])
        } else {
            let value = background.wrapping_mul((x * 13 + y * 7) as u8);
            Rgba([value, value / 2, !value, 0])
        }
    })
}

/// Properties and rows of a binary PLY.
fn read_ply(path: &Path) -> (Vec<String>, Vec<Vec<f32>>) {
    let bytes = fs::read(path).expect("PLY");
    let end = b"end_header\n";
    let body = bytes.windows(end.len()).position(|w| w == end).expect("a header") + end.len();
    let header = std::str::from_utf8(&bytes[..body]).expect("ASCII");
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex "), "{header}");
    let count: usize =
        header.lines().nth(2).and_then(|l| l.rsplit(' ').next()).expect("count").parse().expect("number");
    let names: Vec<String> =
        header.lines().filter_map(|l| l.strip_prefix("property float ")).map(str::to_owned).collect();
    assert_eq!(bytes.len() - body, count * names.len() * 4);
    let floats: Vec<f32> =
        bytes[body..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    (names.clone(), floats.chunks_exact(names.len()).map(<[f32]>::to_vec).collect())
}

#[test]
fn two_pictures_become_a_finite_ply_with_config_and_plan() {
    let place = Workplace::new();
    let printed = succeed(place.reconstruct("front.png", "back.png").args(["-v", "-o", "human.ply"]));
    for line in
        ["encoder", "decoders", "heads (4)", "regressor (front, back)", "pixels become Gaussians", "total"]
    {
        assert!(printed.contains(line), "{line}: {printed}");
    }
    let (names, rows) = read_ply(&place.path("human.ply"));
    // INRIA's order.
    let expected =
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    assert_eq!(names.join(" "), expected);
    assert!(rows.len() > 1000, "{}", rows.len());
    assert!(rows.iter().flatten().all(|v| v.is_finite()));
    for row in &rows {
        let length: f32 = row[13..17].iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-4, "{row:?}");
    }
    let config = fs::read_to_string(place.path("human.ply.config.toml")).expect("config beside the PLY");
    assert!(config.contains("enc_dim = 64"), "{config}");
}

#[test]
fn turntables_are_animations_sheets_and_folders() {
    let place = Workplace::new();
    for name in ["turn.gif", "turn.png", "turn"] {
        let printed = succeed(place.reconstruct("front.png", "back.png").args(["-v", "--turntable", name]));
        assert!(printed.contains("turntable"), "{printed}");
    }
    let gif = fs::read(place.path("turn.gif")).expect("animation");
    assert!(gif.starts_with(b"GIF89a"));
    let frames = image::codecs::gif::GifDecoder::new(std::io::Cursor::new(gif)).expect("a GIF");
    let frames = image::AnimationDecoder::into_frames(frames).collect_frames().expect("frames");
    assert_eq!(frames.len(), 40);
    assert_eq!(frames[0].buffer().dimensions(), (512, 512));
    assert!(frames[0].buffer().pixels().any(|p| p.0[..3] != [0, 0, 0]), "the blob is seen");
    assert!(frames[0].buffer() != frames[10].buffer(), "it turns");
    let sheet = image::open(place.path("turn.png")).expect("sheet").into_rgb8();
    assert_eq!(sheet.dimensions(), (2048, 1024));
    assert!(place.path("turn/039.png").exists() && place.path("turn/cameras.json").exists());
    // The folder's pictures are what `render` makes of the PLY.
    let cameras = ["render", "human.ply", "--cameras", "turn/cameras.json", "-o", "again", "--device", "cpu"];
    succeed(snapsnap().current_dir(place.0.path()).args(cameras));
    let [a, b] =
        ["turn/007.png", "again/007.png"].map(|p| image::open(place.path(p)).expect("PNG").into_rgb8());
    let far = a.as_raw().iter().zip(b.as_raw()).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(far * 1000 < a.as_raw().len(), "{far} values differ");
}

#[test]
fn unsuitable_turntables_are_refused_before_any_work() {
    let place = Workplace::new();
    fs::write(place.path("file"), "").expect("written");
    for (name, expected) in [
        ("turn.mp4", "is a .gif, a .png or a folder"),
        ("file", "exists and is no folder"),
        ("no/turn.gif", "cannot write"),
        ("front.png", "would be overwritten"),
        ("human.ply", "is a .gif, a .png or a folder"),
    ] {
        let message = place.refusal(place.reconstruct("front.png", "back.png").args(["--turntable", name]));
        assert!(message.contains(expected), "{name}: {message}");
    }
}

#[test]
fn background_pixels_change_nothing() {
    let place = Workplace::new();
    person(200, 320, 1, 17).save(place.path("other.png")).expect("PNG");
    for (front, out) in [("front.png", "a"), ("other.png", "b")] {
        succeed(place.reconstruct(front, "back.png").args(["--dump", out, "-o", "human.ply"]));
        fs::rename(place.path("human.ply"), place.path(&format!("{out}.ply"))).expect("renamed");
    }
    assert!(fs::read(place.path("a.ply")).expect("read") == fs::read(place.path("b.ply")).expect("read"));
    assert!(fs::read(place.path("a")).expect("read") == fs::read(place.path("b")).expect("read"));
}

#[test]
fn masks_from_files_equal_masks_from_alpha() {
    let place = Workplace::new();
    for name in ["front", "back"] {
        let rgba = image::open(place.path(&format!("{name}.png"))).expect("PNG").into_rgba8();
        let mask = GrayImage::from_fn(200, 320, |x, y| Luma([rgba.get_pixel(x, y)[3]]));
        mask.save(place.path(&format!("{name}_mask.png"))).expect("PNG");
        DynamicImage::ImageRgba8(rgba).into_rgb8().save(place.path(&format!("{name}_rgb.png"))).expect("PNG");
    }
    succeed(place.reconstruct("front.png", "back.png").args(["-o", "a.ply"]));
    let masks = ["--masks", "front_mask.png", "back_mask.png", "-o", "b.ply"];
    succeed(place.reconstruct("front_rgb.png", "back_rgb.png").args(masks));
    assert!(fs::read(place.path("a.ply")).expect("read") == fs::read(place.path("b.ply")).expect("read"));
}

#[test]
fn exif_orientation_is_honoured() {
    let place = Workplace::new();
    // A JPEG turned a quarter, whose EXIF tag (6: turn right by 90°) says so, is the upright picture.
    let upright = DynamicImage::ImageRgba8(person(200, 320, 1, 0)).into_rgb8();
    let turned = image::imageops::rotate270(&upright);
    let mask = |name: &str, turned: bool| {
        let rgba = person(200, 320, 1, 0);
        let mask = GrayImage::from_fn(200, 320, |x, y| Luma([rgba.get_pixel(x, y)[3]]));
        let mask = if turned { image::imageops::rotate270(&mask) } else { mask };
        mask.save(place.path(name)).expect("PNG");
    };
    mask("upright.png", false);
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100).encode_image(&turned).expect("JPEG");
    // APP1 segment: "Exif", little-endian TIFF with one entry, tag 0x0112 (orientation) = 6.
    let exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let tagged = [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat();
    fs::write(place.path("tagged.jpg"), tagged).expect("written");
    let masks = ["--masks", "upright.png", "upright.png", "-v", "-o", "human.ply"];
    let printed = succeed(place.reconstruct("tagged.jpg", "tagged.jpg").args(masks));
    assert!(printed.contains("front: 200×320"), "{printed}");
    // Without the tag the mask does not fit the picture.
    fs::write(place.path("plain.jpg"), jpeg).expect("written");
    let message = refused(place.reconstruct("plain.jpg", "plain.jpg").args(masks));
    assert!(message.contains("the mask is 200×320") && message.contains("320×200"), "{message}");
}

#[test]
fn unsuitable_pictures_are_refused_by_name() {
    let place = Workplace::new();
    let case = |front: &str, wanted: &[&str]| {
        let message = place.refusal(place.reconstruct(front, "back.png").args(["--cutout", "none"]));
        for text in wanted.iter().chain(&[front]) {
            assert!(message.contains(text), "{front}: {message}");
        }
    };
    case("missing.png", &["cannot read"]);
    fs::write(place.path("text.png"), "no picture").expect("written");
    case("text.png", &["not a readable image"]);
    let good = fs::read(place.path("front.png")).expect("read");
    fs::write(place.path("cut.png"), &good[..good.len() / 2]).expect("written");
    case("cut.png", &["not a readable image"]);
    RgbImage::from_pixel(100, 100, Rgb([1, 2, 3])).save(place.path("rgb.png")).expect("PNG");
    case("rgb.png", &["no alpha channel", "--masks"]);
    let message = place.refusal(&mut place.reconstruct("rgb.png", "back.png"));
    assert!(message.contains("rgb.png: no person was found") && message.contains("--masks"), "{message}");
    RgbaImage::from_fn(100, 100, |x, y| Rgba([x as u8, y as u8, 0, 255]))
        .save(place.path("solid.png"))
        .expect("PNG");
    case("solid.png", &["opaque everywhere"]);
    RgbaImage::from_fn(100, 100, |x, y| Rgba([x as u8, y as u8, 0, 0]))
        .save(place.path("clear.png"))
        .expect("PNG");
    case("clear.png", &["mask is empty"]);
    person(63, 200, 1, 0).save(place.path("small.png")).expect("PNG");
    case("small.png", &["at least 64 pixels"]);
    let flat = RgbaImage::from_fn(100, 100, |x, _| Rgba([9, 9, 9, if x > 50 { 255 } else { 0 }]));
    flat.save(place.path("flat.png")).expect("PNG");
    case("flat.png", &["single colour"]);
    fs::create_dir(place.path("folder")).expect("folder");
    case("folder", &[]);

    GrayImage::new(199, 320).save(place.path("narrow.png")).expect("PNG");
    let masks = ["--masks", "narrow.png", "narrow.png"];
    let message = place.refusal(place.reconstruct("front.png", "back.png").args(masks));
    assert!(
        message.contains("narrow.png") && message.contains("199×320") && message.contains("200×320"),
        "{message}"
    );
    let message = place.refusal(place.reconstruct("front.png", "back.png").arg("--as-is"));
    assert!(message.contains("200×320") && message.contains("128×128"), "{message}");
}

#[test]
fn unsuitable_configs_weights_devices_and_outputs_are_refused_by_name() {
    let place = Workplace::new();
    let case = |arguments: &[&str], wanted: &[&str]| {
        let message = place.refusal(place.reconstruct_anywhere("front.png", "back.png").args(arguments));
        for text in wanted {
            assert!(message.contains(text), "{arguments:?}: {message}");
        }
    };
    case(&["--set", "network.nothing=1"], &["nothing"]);
    case(&["--set", "network.fusion=sum"], &["fusion", "concat"]);
    case(&["--set", "mode.compat=true", "--set", "mode.crop=true"], &["mode.crop", "mode.compat"]);
    case(&["--set", "network.enc_dim=128"], &["`network.enc_dim`", "64", "128"]);
    fs::write(place.path("bad.toml"), "[network]\nenc_dim = \"many\"\n").expect("written");
    case(&["--config", "bad.toml"], &["bad.toml", "enc_dim", "line 2"]);
    case(&["--config", "missing.toml"], &["missing.toml"]);
    case(&["--device", "tpu"], &["tpu", "cpu", "ndarray"]);
    case(&["--device", "cuda:0"], &["cuda", "--features cuda"]);
    case(&["--device", "wgpu:99"], &["wgpu:99"]);
    case(&["-o", "no/such/folder/human.ply"], &["no/such/folder/human.ply", "cannot write"]);
    case(&["-o", "human.obj"], &["human.obj", "is no .ply, .spz, .glb or .sog"]);
    case(&["--dump", "no/such/folder/dump"], &["no/such/folder/dump"]);

    // Without --weights it is the default ones that do not fit.
    let mut command = snapsnap();
    let arguments = ["reconstruct", "front.png", "back.png", "--set", "network.enc_dim=64"];
    let message = refused(command.current_dir(place.path("")).args(arguments));
    assert!(message.contains("the default weights") && message.contains("not 64"), "{message}");
    // A NaN in the last tensor.
    let mut weights = fs::read(place.path("w")).expect("read");
    let at = weights.len() - 4;
    weights[at..].copy_from_slice(&f32::NAN.to_le_bytes());
    fs::write(place.path("w"), weights).expect("written");
    case(&["--device", "cpu"], &["not finite", "gs_conv.bias"]);
    assert_eq!(
        refused(snapsnap().arg("reconstruct")).lines().next().map(|l| l.starts_with("error")),
        Some(true)
    );
}

#[test]
fn no_input_and_no_other_output_is_ever_overwritten() {
    let place = Workplace::new();
    fs::create_dir(place.path("model")).expect("folder");
    fs::copy(place.path("w"), place.path("model/weights.safetensors")).expect("copied");
    let refuse = |arguments: &[&str]| {
        let mut command = snapsnap();
        let common = ["reconstruct", "front.png", "back.png", "--device", "cpu"];
        place.refusal(command.current_dir(place.path("")).args(common).args(arguments))
    };
    for arguments in [
        ["--weights", "w", "-o", "front.png"],
        ["--weights", "w", "-o", "w"],
        ["--weights", "model", "-o", "model/weights.safetensors"],
        ["--weights", "model", "--dump", "model/weights.safetensors"],
    ] {
        assert!(refuse(&arguments).contains("is an input"), "{arguments:?}");
    }
    for dump in ["h.ply", "h.ply.config.toml"] {
        assert!(refuse(&["--weights", "w", "-o", "h.ply", "--dump", dump]).contains("two outputs"), "{dump}");
    }
    fs::copy(tiny(), place.path("c.toml")).expect("copied");
    let mut command = snapsnap();
    let arguments = ["init-weights", "--config", "c.toml", "-o", "c.toml"];
    assert!(place.refusal(command.current_dir(place.path("")).args(arguments)).contains("is an input"));

    // The config that a run wrote repeats the run in place.
    succeed(place.reconstruct("front.png", "back.png").args(["-o", "human.ply"]));
    let first = fs::read(place.path("human.ply")).expect("read");
    let again = ["-o", "human.ply", "--config", "human.ply.config.toml"];
    succeed(place.reconstruct("front.png", "back.png").args(again));
    assert!(first == fs::read(place.path("human.ply")).expect("read"));
}

#[test]
fn weights_that_give_nothing_are_an_error_and_write_nothing() {
    let place = Workplace::new();
    let mut init = snapsnap();
    init.current_dir(place.path("")).args(["init-weights", "-o", "w", "--config"]);
    succeed(init.arg(tiny()));
    fill_weights(&place.path("w"), 1e30);
    let message = place.refusal(&mut place.reconstruct("front.png", "back.png"));
    assert!(message.contains("no Gaussian came out") && message.contains("not finite"), "{message}");
}

#[test]
fn a_closed_or_full_output_stream_never_panics() {
    let place = Workplace::new();
    let full = || fs::File::options().write(true).open("/dev/full");
    if full().is_err() {
        println!("SKIPPED: no /dev/full on this system");
        return;
    }
    let status = place
        .reconstruct("front.png", "back.png")
        .args(["-v", "-o", "human.ply"])
        .stdout(full().expect("opened"))
        .stderr(full().expect("opened"))
        .status()
        .expect("the program starts");
    assert!(status.success(), "{status}");
    assert!(place.path("human.ply").exists());
}

#[test]
fn an_interrupted_or_refused_import_leaves_the_old_file() {
    let place = Workplace::new();
    fs::write(place.path("old"), "precious").expect("written");
    let mut command = snapsnap();
    command.current_dir(place.path("")).args(["import-weights", "w", "-o", "old"]);
    // The tiny weights do not fit the published size.
    assert!(refused(&mut command).contains("the config asks for"));
    assert_eq!(fs::read_to_string(place.path("old")).expect("read"), "precious");
}

#[test]
fn weights_can_be_a_folder_and_seeds_give_the_same_bytes() {
    let place = Workplace::new();
    fs::create_dir(place.path("model")).expect("folder");
    let file = place.path("model/weights.safetensors");
    succeed(snapsnap().args(["init-weights", "--seed", "1", "--config"]).arg(tiny()).arg("-o").arg(&file));
    assert!(fs::read(&file).expect("read") == fs::read(place.path("w")).expect("read"));
    succeed(place.reconstruct("front.png", "back.png").args(["-o", "a.ply"]));
    let mut command = snapsnap();
    let arguments =
        ["reconstruct", "front.png", "back.png", "--weights", "model", "--device", "cpu", "-o", "b.ply"];
    succeed(command.current_dir(place.path("")).args(arguments));
    assert!(fs::read(place.path("a.ply")).expect("read") == fs::read(place.path("b.ply")).expect("read"));
}

#[test]
fn sample_photographs_stand_where_training_subjects_stand() {
    let samples = shared("samples/0000");
    if !samples.exists() {
        println!("SKIPPED: no sample photographs {}", samples.display());
        return;
    }
    let place = Workplace::new();
    let (front, back) = (samples.join("front.png"), samples.join("back.png"));
    let text = |p: &Path| p.display().to_string();
    succeed(place.reconstruct(&text(&front), &text(&back)).args(["--dump", "dump", "-o", "human.ply"]));
    let (shape, valid) = Numbers::read(&place.path("dump")).u8("valid");
    assert_eq!(shape, [4, 128, 128]);
    for view in valid.chunks_exact(128 * 128).take(2) {
        let rows: Vec<usize> = (0..128).filter(|y| view[y * 128..(y + 1) * 128].contains(&1)).collect();
        // Rows 124 to 863 of 1024 are 15.5 to 107.8 of 128 (docs/method.md, "Cameras").
        let (first, last) = (rows[0], rows[rows.len() - 1]);
        assert!((15..=17).contains(&first) && (106..=108).contains(&last), "rows {first} to {last}");
    }
}
