//! Comparisons.

use std::fs;
use std::path::Path;
use std::process::Command;

use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::Value;
use snapsnap_tests::{assert_says, data, ended_with, refused, snapsnap, succeed};

fn compare(a: &Path, b: &Path) -> Command {
    let mut command = snapsnap();
    command.arg("compare").arg(a).arg(b);
    command
}

fn json(command: &mut Command) -> Value {
    serde_json::from_str(&succeed(command.arg("--json"))).expect("JSON")
}

/// The reference's pair of pictures that are cut out of the sheet of people, compared around a disc.
#[test]
fn a_mask_has_the_figures_of_scikit_image_and_a_margin() {
    let temporary = tempfile::tempdir().expect("a folder");
    let sheet = image::open(data("metrics/people.png")).expect("the sheet").into_rgb8();
    let [a, b, mask] = ["a.png", "b.png", "mask.png"].map(|name| temporary.path().join(name));
    for (path, x) in [(&a, 11), (&b, 10)] {
        image::imageops::crop_imm(&sheet, x, 40, 160, 256).to_image().save(path).expect("writes");
    }
    let disc = |x: u32, y: u32| (x as i32 - 53).pow(2) + (y as i32 - 128).pow(2) < 40 * 40;
    GrayImage::from_fn(160, 256, |x, y| Luma([if disc(x, y) { 255 } else { 0 }]))
        .save(&mask)
        .expect("writes");
    let text = fs::read_to_string(data("metrics/expected.json")).expect("the reference");
    let expected: Value = serde_json::from_str(&text).expect("JSON");
    let expected = &expected["pictures"]["people, shifted"]["mask"];
    let found = json(compare(&a, &b).arg("--mask").arg(&mask));
    for (i, key) in ["psnr", "ssim"].into_iter().enumerate() {
        let (got, expected) = (found[key].as_f64(), expected[i].as_f64());
        assert!((got.expect(key) - expected.expect(key)).abs() < 2e-6, "{key}: {got:?}");
    }
    assert_eq!(found["pixels"], expected[2]);
    assert!(found["lpips"].is_null());
    // The mask without a margin.
    let found = json(compare(&a, &b).args(["--window", "mask", "--margin", "0", "--mask"]).arg(&mask));
    let inside = (0..256).flat_map(|y| (0..160).map(move |x| (x, y))).filter(|(x, y)| disc(*x, *y)).count();
    assert_eq!(found["pixels"].as_u64(), Some(inside as u64));
}

#[test]
fn a_picture_is_infinitely_like_itself_and_that_is_printed() {
    let sheet = data("metrics/people.png");
    assert_says(&succeed(&mut compare(&sheet, &sheet)), &["inf dB", "1.000000"]);
    let found = json(&mut compare(&sheet, &sheet));
    assert_eq!(
        (&found["psnr"], &found["ssim"], &found["ssim_gaussian"]),
        (&"inf".into(), &1.0.into(), &1.0.into())
    );
}

#[test]
fn folders_are_compared_by_name_and_what_is_left_out_is_named() {
    let temporary = tempfile::tempdir().expect("a folder");
    let [a, b] = ["a", "b"].map(|name| temporary.path().join(name));
    for folder in [&a, &b] {
        fs::create_dir(folder).expect("a folder");
    }
    let flat = |side: u32, value: u8| RgbImage::from_pixel(side, side, Rgb([value; 3]));
    for name in ["1.png", "2.png"] {
        flat(16, 100).save(a.join(name)).expect("writes");
        flat(16, 110).save(b.join(name)).expect("writes");
    }
    let found = json(&mut compare(&a, &b));
    assert_eq!(
        (found["pictures"].as_array().map(Vec::len), &found["pictures"][1]["name"]),
        (Some(2), &"2.png".into())
    );
    let expected = -20.0 * (10.0_f64 / 255.0).log10();
    assert!((found["mean"]["psnr"].as_f64().expect("a number") - expected).abs() < 1e-5, "{found}");
    // A missing picture, one of another size, a truncated one.
    flat(16, 1).save(b.join("3.png")).expect("writes");
    flat(16, 1).save(a.join("4.png")).expect("writes");
    flat(17, 1).save(b.join("4.png")).expect("writes");
    let bytes = fs::read(a.join("1.png")).expect("a picture");
    fs::write(a.join("5.png"), &bytes[..40]).expect("writes");
    fs::write(b.join("5.png"), &bytes).expect("writes");
    let said = ended_with(1, &mut compare(&a, &b));
    for part in ["3.png: is not in", "4.png", "16×16 and 17×17", "5.png", "2 pictures compared, 3 left out"]
    {
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let temporary = tempfile::tempdir().expect("a folder");
    let path = |name: &str| temporary.path().join(name);
    RgbImage::new(20, 10).save(path("black.png")).expect("writes");
    RgbImage::new(10, 20).save(path("other.png")).expect("writes");
    fs::write(path("text.png"), "no picture").expect("writes");
    let said = |a: &str, b: &str, arguments: &[&str]| refused(compare(&path(a), &path(b)).args(arguments));
    assert!(said("black.png", "other.png", &[]).contains("20×10 and 10×20"));
    assert!(said("black.png", "black.png", &["--window", "paper"]).contains("black throughout"));
    assert!(said("black.png", "text.png", &[]).contains("text.png"));
    assert!(said("black.png", "nowhere.png", &[]).contains("nowhere.png"));
    assert!(said("black.png", "black.png", &["--window", "mask"]).contains("--mask"));
    let mask = path("other.png").display().to_string();
    assert!(
        said("black.png", "black.png", &["--window", "all", "--mask", &mask]).contains("--window mask alone")
    );
    assert!(said("black.png", "black.png", &["--mask", &mask]).contains("10×20"), "a mask is a window");
    assert!(said("black.png", "black.png", &["--window", "mask", "--mask", &mask]).contains("10×20"));
    let mask = path("black.png").display().to_string();
    assert!(said("black.png", "black.png", &["--window", "mask", "--mask", &mask]).contains("mask is empty"));
    assert!(refused(&mut compare(temporary.path(), &path("black.png"))).contains("is no folder"));
}
