//! The command line as a user types it: real pictures, wrong input, and what is left on disk.

use std::fs;
use std::path::Path;

use image::{DynamicImage, GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use snapsnap_tests::workplace::{Workplace, person};
use snapsnap_tests::{Numbers, assert_says, fill_weights, refused, root, set_tensor, shared_folder, succeed};

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
    let place = Workplace::with_weights();
    let printed = succeed(&mut place.reconstruct("front.png back.png -v -o human.ply"));
    assert_says(
        &printed,
        &["encoder", "decoders", "heads (4)", "regressor (front, back)", "pixels become Gaussians", "total"],
    );
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
    let place = Workplace::with_weights();
    for name in ["turn.gif", "turn.png", "turn"] {
        // The height of the random weights' blob.
        let line = format!("front.png back.png --height 0.16 -v --turntable {name}");
        assert_says(&succeed(&mut place.reconstruct(&line)), &["turntable"]);
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
    succeed(&mut place.run("render human.ply --cameras turn/cameras.json -o again --device cpu"));
    let [a, b] =
        ["turn/007.png", "again/007.png"].map(|p| image::open(place.path(p)).expect("PNG").into_rgb8());
    let far = a.as_raw().iter().zip(b.as_raw()).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(far * 1000 < a.as_raw().len(), "{far} values differ");
}

#[test]
fn unsuitable_turntables_are_refused_before_any_work() {
    let place = Workplace::with_weights();
    place.write("file", "");
    for (name, expected) in [
        ("turn.mp4", "is a .gif, a .png or a folder"),
        ("file", "exists and is no folder"),
        ("no/turn.gif", "cannot write"),
        ("file/turn", "cannot write"),
        ("human.ply", "is a .gif, a .png or a folder"),
    ] {
        let line = format!("front.png back.png --turntable {name}");
        let message = place.refusal(&mut place.reconstruct(&line));
        assert!(message.contains(expected), "{name}: {message}");
    }
}

#[test]
fn background_pixels_change_nothing() {
    let place = Workplace::with_weights();
    person(200, 320, 1, 17).save(place.path("other.png")).expect("PNG");
    for (front, out) in [("front.png", "a"), ("other.png", "b")] {
        succeed(&mut place.reconstruct(&format!("{front} back.png --dump {out} -o {out}.ply")));
    }
    assert!(place.read("a.ply") == place.read("b.ply"));
    assert!(place.read("a") == place.read("b"));
}

#[test]
fn masks_from_files_equal_masks_from_alpha() {
    let place = Workplace::with_weights();
    for name in ["front", "back"] {
        let rgba = image::open(place.path(&format!("{name}.png"))).expect("PNG").into_rgba8();
        let mask = GrayImage::from_fn(200, 320, |x, y| Luma([rgba.get_pixel(x, y)[3]]));
        mask.save(place.path(&format!("{name}_mask.png"))).expect("PNG");
        DynamicImage::ImageRgba8(rgba).into_rgb8().save(place.path(&format!("{name}_rgb.png"))).expect("PNG");
    }
    succeed(&mut place.reconstruct("front.png back.png -o a.ply"));
    let masks = "--masks front_mask.png back_mask.png";
    succeed(&mut place.reconstruct(&format!("front_rgb.png back_rgb.png {masks} -o b.ply")));
    assert!(place.read("a.ply") == place.read("b.ply"));
}

#[test]
fn exif_orientation_is_honoured() {
    let place = Workplace::with_weights();
    // A JPEG turned a quarter, whose EXIF tag (6: turn right by 90°) says so, is the upright picture.
    let upright = person(200, 320, 1, 0);
    let mask = GrayImage::from_fn(200, 320, |x, y| Luma([upright.get_pixel(x, y)[3]]));
    mask.save(place.path("upright.png")).expect("PNG");
    let turned = image::imageops::rotate270(&DynamicImage::ImageRgba8(upright).into_rgb8());
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100).encode_image(&turned).expect("JPEG");
    // APP1 segment: "Exif", little-endian TIFF with one entry, tag 0x0112 (orientation) = 6.
    let exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let tagged = [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat();
    place.write("tagged.jpg", tagged);
    let masks = "--masks upright.png upright.png -v";
    let printed = succeed(&mut place.reconstruct(&format!("tagged.jpg tagged.jpg {masks}")));
    assert!(printed.contains("front: 200×320"), "{printed}");
    // Without the tag the mask does not fit the picture.
    place.write("plain.jpg", jpeg);
    let message = refused(&mut place.reconstruct(&format!("plain.jpg plain.jpg {masks}")));
    assert!(message.contains("the mask is 200×320") && message.contains("320×200"), "{message}");
}

#[test]
fn unsuitable_pictures_are_refused_by_name() {
    let place = Workplace::with_weights();
    let case = |front: &str, wanted: &[&str]| {
        let line = format!("{front} back.png --cutout none");
        let message = place.refusal(&mut place.reconstruct(&line));
        for text in wanted.iter().chain(&[front]) {
            assert!(message.contains(text), "{front}: {message}");
        }
    };
    case("missing.png", &["cannot read"]);
    place.write("text.png", "no picture");
    case("text.png", &["not a readable image"]);
    let good = place.read("front.png");
    place.write("cut.png", &good[..good.len() / 2]);
    case("cut.png", &["not a readable image"]);
    RgbImage::from_pixel(100, 100, Rgb([1, 2, 3])).save(place.path("rgb.png")).expect("PNG");
    case("rgb.png", &["no alpha channel", "--masks"]);
    let message = place.refusal(&mut place.reconstruct("rgb.png back.png"));
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
    let with_options = |options: &str, wanted: [&str; 2]| {
        let message = place.refusal(&mut place.reconstruct(&format!("front.png back.png {options}")));
        assert!(wanted.iter().all(|text| message.contains(text)), "{options}: {message}");
    };
    with_options("--masks narrow.png narrow.png", ["narrow.png", "the mask is 199×320"]);
    with_options("--as-is", ["200×320", "128×128"]);
}

#[test]
fn unsuitable_configs_weights_devices_and_outputs_are_refused_by_name() {
    let place = Workplace::with_weights();
    let case = |options: &str, wanted: &[&str]| {
        let line = format!("reconstruct front.png back.png --weights w {options}");
        let message = place.refusal(&mut place.run(&line));
        for text in wanted {
            assert!(message.contains(text), "{options}: {message}");
        }
    };
    case("--set network.nothing=1", &["nothing"]);
    case("--set network.fusion=sum", &["fusion", "concat"]);
    case("--set mode.compat=true --set mode.crop=true", &["mode.crop", "mode.compat"]);
    case("--set network.enc_dim=128", &["`network.enc_dim`", "64", "128"]);
    place.write("bad.toml", "[network]\nenc_dim = \"many\"\n");
    case("--config bad.toml", &["bad.toml", "enc_dim", "line 2"]);
    case("--config missing.toml", &["missing.toml"]);
    case("--device tpu", &["tpu", "cpu", "ndarray"]);
    case("--device cuda:0", &["cuda", "--features cuda"]);
    case("--device wgpu:99", &["wgpu:99"]);
    case("-o no/such/folder/human.ply", &["no/such/folder/human.ply", "cannot write"]);
    case("-o human.obj", &["human.obj", "is no .ply, .spz, .glb or .sog"]);
    case("--dump no/such/folder/dump", &["no/such/folder/dump"]);

    // Without --weights it is the default ones that do not fit.
    let message = refused(&mut place.run("reconstruct front.png back.png --set network.enc_dim=64"));
    assert!(message.contains("the default weights") && message.contains("not 64"), "{message}");
    set_tensor(&place.path("w"), "gs_conv.bias", &[f32::NAN]);
    case("--device cpu", &["not finite", "gs_conv.bias"]);
    assert!(refused(&mut place.run("reconstruct")).starts_with("error"));
}

#[test]
fn weights_that_give_nothing_are_an_error_and_write_nothing() {
    let place = Workplace::with_weights();
    fill_weights(&place.path("w"), 1e30);
    let message = place.refusal(&mut place.reconstruct("front.png back.png"));
    assert!(message.contains("no Gaussian came out") && message.contains("not finite"), "{message}");
}

#[test]
fn a_closed_or_full_output_stream_never_panics() {
    let place = Workplace::with_weights();
    let full = || fs::File::options().write(true).open("/dev/full");
    if full().is_err() {
        println!("SKIPPED: no /dev/full on this system");
        return;
    }
    let mut command = place.reconstruct("front.png back.png -v");
    command.stdout(full().expect("opened")).stderr(full().expect("opened"));
    let status = command.status().expect("the program starts");
    assert!(status.success(), "{status}");
    assert!(place.path("human.ply").exists());
}

#[test]
fn weights_can_be_a_folder_and_seeds_give_the_same_bytes() {
    let place = Workplace::with_weights();
    fs::create_dir(place.path("model")).expect("folder");
    let config = root().join("configs/tiny.toml");
    succeed(place.run("init-weights --seed 1 -o model/weights.safetensors --config").arg(config));
    assert!(place.read("model/weights.safetensors") == place.read("w"));
    succeed(&mut place.reconstruct("front.png back.png -o a.ply"));
    succeed(&mut place.run("reconstruct front.png back.png --weights model --device cpu -o b.ply"));
    assert!(place.read("a.ply") == place.read("b.ply"));
}

#[test]
fn sample_photographs_stand_where_training_subjects_stand() {
    let Some(samples) = shared_folder("samples/0000") else { return };
    let place = Workplace::with_weights();
    let pair = ["front.png", "back.png"].map(|name| samples.join(name));
    succeed(place.reconstruct("--dump dump").args(pair));
    let (shape, valid) = Numbers::read(&place.path("dump")).u8("valid");
    assert_eq!(shape, [4, 128, 128]);
    for view in valid.chunks_exact(128 * 128).take(2) {
        let rows: Vec<usize> = (0..128).filter(|y| view[y * 128..(y + 1) * 128].contains(&1)).collect();
        // Rows 124 to 863 of 1024 are 15.5 to 107.8 of 128 (docs/method.md, "Cameras").
        let (first, last) = (rows[0], rows[rows.len() - 1]);
        assert!((15..=17).contains(&first) && (106..=108).contains(&last), "rows {first} to {last}");
    }
}
