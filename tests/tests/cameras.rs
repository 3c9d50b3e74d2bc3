//! Cameras of a user's photographs: EXIF data, options, and the person's height.

use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use glam::{DMat3, DVec2};
use image::RgbaImage;
use image::imageops::interpolate_bilinear;
use snapsnap_splat::scene;
use snapsnap_tests::{refused, sample, succeed};

/// What `reconstruct -v` prints, and the centres of its Gaussians.
fn reconstruct(folder: &Path, pair: &[PathBuf; 2], options: &[&str]) -> (String, Vec<[f32; 3]>) {
    let mut command = sample::reconstruct(folder, pair);
    let said = succeed(command.args(["-v", "--set", "network.resolution=256"]).args(options));
    let means = scene::read(&folder.join("human.ply"), &Device::flex()).expect("a PLY").gaussians.means;
    let values: Vec<f32> = means.into_data().try_into_vec().expect("f32");
    (said, values.as_chunks::<3>().0.to_vec())
}

fn range(values: impl Iterator<Item = f32>) -> [f32; 2] {
    values.fold([f32::MAX, f32::MIN], |[low, high], value| [low.min(value), high.max(value)])
}

/// The told height is the height of what is written, from sole to crown, whatever the cameras.
#[test]
fn a_person_has_the_told_height_and_stands_on_the_floor() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let made = |options: &[&str]| reconstruct(temporary.path(), &sample::paths(), options);
    let (said, usual) = made(&[]);
    assert!(said.contains("person 1.72 m high, assumed"), "{said}");
    let (_, child) = made(&["--height", "1.1"]);
    let (_, low) = made(&["--height", "1.8", "--elevation", "-20"]);
    let (_, near) = made(&["--distance", "1"]);
    for (points, height) in [(&usual, 1.72), (&child, 1.1), (&low, 1.8), (&near, 1.72)] {
        let [floor, top] = range(points.iter().map(|p| p[1]));
        assert!(floor.abs() < 1e-4 && (top - height).abs() < 1e-3, "{floor} to {top}, not {height}");
    }
    // All lengths have one factor, unless the cameras differ.
    let apart = |of: &[[f32; 3]], height: f32| {
        let scaled =
            usual.iter().zip(of).flat_map(|(a, b)| (0..3).map(|c| (a[c] * height / 1.72 - b[c]).abs()));
        scaled.fold(0.0, f32::max)
    };
    assert!(usual.len() == child.len() && usual.len() > 1000);
    assert!(apart(&child, 1.1) < 1e-4 && apart(&low, 1.8) > 0.01);
}

/// A phone's file has its focal length and its tilt. The same values as options give the same person.
#[test]
fn a_telephone_tells_its_lens_and_its_tilt() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path();
    let photographs = ["front", "back"].map(|side| {
        let over = sample::over(&sample::picture(side), |_, _| [200.0; 3]);
        let path = folder.join(side).with_extension("jpg");
        over.save(&path).expect("written");
        let bytes = fs::read(&path).expect("read");
        // Behind the start of the image: a segment APP1. The phone looks up by 10 degrees.
        let tiff = snapsnap_tests::exif(26, [0, -985, 174]);
        let length = (tiff.len() + 8) as u16;
        let segment = [b"\xff\xe1", &length.to_be_bytes()[..], b"Exif\0\0", &tiff].concat();
        fs::write(&path, [&bytes[..2], &segment, &bytes[2..]].concat()).expect("written");
        path
    });
    let (said, own) = reconstruct(folder, &photographs, &[]);
    assert_eq!(said.matches("26 mm of 35 mm film, the file").count(), 2, "{said}");
    assert_eq!(said.matches("° (the file)").count(), 2, "{said}");
    let (_, unknown) = reconstruct(folder, &photographs, &["--distance", "2", "--elevation", "8"]);
    assert!(own.len() == unknown.len() && own.len() > 1000);
    let moved = own.iter().zip(&unknown).map(|(a, b)| (a[1] - b[1]).abs()).fold(0.0, f32::max);
    assert!((0.01..0.2).contains(&moved), "{moved} m");
    let elevation =
        said.split("looking down by ").nth(1).and_then(|rest| rest.split('°').next()).expect("degrees");
    let (said, same) = reconstruct(folder, &photographs, &["--focal", "26", "--elevation", elevation]);
    assert!(said.contains("--focal") && said.contains("(--elevation)"), "{said}");
    let apart =
        own.iter().zip(&same).flat_map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).abs())).fold(0.0, f32::max);
    assert!(apart < 3e-3, "{apart} m");
    // Distances ahead of the axis stay, but for the scale to the person's height.
    let ratios = own.iter().zip(&unknown).filter(|(a, _)| a[2].abs() > 0.05).map(|(a, b)| a[2] / b[2]);
    let [least, most] = range(ratios);
    assert!(most / least - 1.0 < 1e-4, "{least} to {most}");
}

/// A known lens corrects a person far from the middle of a wide-angle picture.
#[test]
fn a_known_lens_turns_pictures_towards_the_person() {
    const FOCAL: f64 = 0.8 * 1024.0;
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path();
    let rotation = DMat3::from_rotation_y(-17_f64.to_radians());
    let aside = ["front", "back"].map(|side| {
        let picture = sample::picture(side);
        let turned = RgbaImage::from_fn(1024, 1024, |x, y| {
            let place = (DVec2::new(f64::from(x), f64::from(y)) + 0.5 - 512.0) / FOCAL;
            let ray = rotation * place.extend(1.0);
            let [x, y] = (FOCAL * ray.truncate() / ray.z + 512.0 - 0.5).as_vec2().to_array();
            interpolate_bilinear(&picture, x, y).filter(|_| ray.z > 0.0).unwrap_or(image::Rgba([0; 4]))
        });
        let path = folder.join(side).with_extension("png");
        turned.save(&path).expect("written");
        path
    });
    // The lens of 0.8 times the picture's side.
    let focal = ["--focal", "24.477"];
    let (_, ahead) = reconstruct(folder, &sample::paths(), &focal);
    let (said, turned) = reconstruct(folder, &aside, &focal);
    assert_eq!(said.matches("turned towards the person by 1").count(), 2, "{said}");
    let (said, unknown) = reconstruct(folder, &aside, &[]);
    assert!(!said.contains("turned"), "{said}");
    // Without the outermost hundredths: the ends of fingers are a few points.
    let size = |points: &[[f32; 3]], axis: usize| {
        let mut places: Vec<f32> = points.iter().map(|p| p[axis]).collect();
        places.sort_by(f32::total_cmp);
        places[places.len() * 99 / 100] - places[places.len() / 100]
    };
    let shape = |points: &[[f32; 3]]| size(points, 0) / size(points, 1);
    let [ahead, turned, unknown] = [&ahead, &turned, &unknown].map(|points| shape(points));
    assert!((turned / ahead - 1.0).abs() < 0.01, "{turned} {ahead}");
    assert!((0.025..0.08).contains(&(unknown / ahead - 1.0)), "{unknown} {ahead}");
}

#[test]
fn impossible_cameras_are_refused() {
    let message =
        |options: &[&str]| refused(sample::reconstruct(Path::new("."), &sample::paths()).args(options));
    for (option, value) in [
        ("--height", "0"),
        ("--height", "NaN"),
        ("--focal", "0"),
        ("--distance", "0.2"),
        ("--elevation", "-90"),
    ] {
        let said = message(&[option, value]);
        assert!(said.contains(option) && said.contains("must be from"), "{said}");
    }
    for option in ["--height", "--focal", "--distance", "--elevation"] {
        let said = message(&["--as-is", option, "9"]);
        assert!(said.contains(option) && said.contains("--as-is"), "{said}");
    }
    let said = message(&["--distance", "1", "--elevation", "-45"]);
    assert!(said.contains("1.00 m away") && said.contains("check --distance and --elevation"), "{said}");
    let said = message(&["--focal", "26", "--distance", "2"]);
    assert!(said.contains("cannot be used with"), "{said}");
}
