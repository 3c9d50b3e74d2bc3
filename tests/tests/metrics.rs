//! The metrics against scikit-image, scipy and trimesh (docs/metrics_reference.py), and properties of every metric.

use burn::tensor::Device;
use glam::DVec3;
use image::{Rgb, RgbImage};
use serde_json::Value;
use snapsnap_eval::geometry::{self, chamfer, consistency, icp, normals, point_to_surface};
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::{Region, margin};
use snapsnap_eval::score::Score;
use snapsnap_eval::similarity::{psnr, ssim, ssim_gaussian, ssim_of_loss};
use snapsnap_splat::Camera;
use snapsnap_tests::data;

/// Pseudo-random numbers in [0, 1), the same in every language.
fn number(stream: u32, place: usize) -> f64 {
    let mixed = (place as u32).wrapping_mul(2_654_435_761).wrapping_add(stream.wrapping_mul(40_503_121));
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519);
    f64::from(mixed ^ (mixed >> 13)) / 4_294_967_296.0
}

fn noise(stream: u32, [h, w]: [u32; 2]) -> RgbImage {
    let value = |i: u32| (256.0 * number(stream, i as usize)) as u8;
    RgbImage::from_fn(w, h, |x, y| Rgb([0, 1, 2].map(|c| value(3 * (y * w + x) + c))))
}

fn slope([h, w]: [u32; 2]) -> RgbImage {
    RgbImage::from_fn(w, h, |x, y| Rgb([0, 1, 2].map(|c| ((2 * x + y + 40 * c) % 256) as u8)))
}

fn people(x: u32, y: u32, w: u32, h: u32) -> RgbImage {
    let sheet = image::open(data("metrics/people.png")).expect("the sheet of people").into_rgb8();
    image::imageops::crop_imm(&sheet, x, y, w, h).to_image()
}

fn pair(name: &str) -> [RgbImage; 2] {
    const SIZE: [u32; 2] = [256, 160];
    let flat = |value| RgbImage::from_pixel(SIZE[1], SIZE[0], Rgb([value; 3]));
    let [h, w] = SIZE;
    match name {
        "noise" => [noise(1, SIZE), noise(2, SIZE)],
        "noise on a slope" => {
            let (a, b) = (slope(SIZE), noise(3, SIZE));
            let both = RgbImage::from_fn(w, h, |x, y| {
                Rgb([0, 1, 2].map(|c| a.get_pixel(x, y).0[c] / 2 + b.get_pixel(x, y).0[c] / 2))
            });
            [a, both]
        }
        "flat and slope" => [flat(77), slope(SIZE)],
        "flat and flat" => [flat(77), flat(80)],
        "people, shifted" => [people(11, 40, w, h), people(10, 40, w, h)],
        "other people" => [people(300, 40, w, h), people(20, 40, w, h)],
        "large" => [people(0, 0, 600, 512), people(2, 1, 600, 512)],
        other => panic!("no pair {other}"),
    }
}

fn picture(image: RgbImage) -> Picture {
    Picture::from_file(image.into(), "picture").expect("a picture")
}

fn expected() -> Value {
    let text = std::fs::read_to_string(data("metrics/expected.json")).expect("the reference");
    serde_json::from_str(&text).expect("JSON")
}

fn close(name: &str, got: f64, expected: &Value, limit: f64) {
    let expected = expected.as_f64().expect("a number");
    assert!((got - expected).abs() <= limit, "{name}: {got}, not {expected}");
}

/// The disc of the reference.
fn disc(width: usize, height: usize) -> Vec<f32> {
    let inside = |i: usize| {
        let (x, y) = ((i % width) as i64 - (width / 3) as i64, (i / width) as i64 - (height / 2) as i64);
        x * x + y * y < (width as i64 / 4).pow(2)
    };
    (0..width * height).map(|i| f32::from(u8::from(inside(i)))).collect()
}

/// Limit for f64 against f64 of the same 8-bit values: the order of sums and f32's rounding of v / 255 differ.
const EXACT: f64 = 2e-6;

#[test]
fn psnr_and_ssim_are_those_of_scikit_image_in_all_three_windows() {
    let expected = expected();
    for (name, figures) in expected["pictures"].as_object().expect("pictures") {
        let [a, b] = pair(name).map(picture);
        let check = |window: &str, region: &Region| {
            close(
                &format!("{name}, {window}: PSNR"),
                psnr(&a, &b, region).expect("one size"),
                &figures[window][0],
                EXACT,
            );
            let similarity = ssim(&a, &b, region).expect("one size").expect("large enough");
            close(&format!("{name}, {window}: SSIM"), similarity, &figures[window][1], EXACT);
        };
        check("all", &Region::all(&b));
        let paper = Region::paper(&b).expect("something is not black");
        let place: Vec<usize> =
            (2..6).map(|i| figures["paper"][i].as_u64().expect("a number") as usize).collect();
        assert_eq!(paper.window.to_vec(), place, "{name}");
        check("paper", &paper);
        let mask = disc(b.width, b.height);
        let masked = Region::masked(&mask, [b.height, b.width], margin(b.height)).expect("a disc");
        assert_eq!(Some(masked.pixels() as u64), figures["mask"][2].as_u64(), "{name}");
        check("mask", &masked);
    }
}

/// The metric computes in f64, the loss in f32 and with gradients.
#[test]
fn the_losss_similarity_is_the_one_that_training_uses() {
    let device = Device::flex();
    for name in ["noise", "flat and slope", "other people"] {
        let [a, b] = pair(name).map(picture);
        let got = ssim_of_loss(&a, &b, &Region::all(&b)).expect("one size");
        let map = ssim_gaussian(a.tensor(&device), b.tensor(&device));
        let expected = f64::from(map.mean().into_scalar::<f32>());
        assert!((got - expected).abs() < 1e-5, "{name}: {got}, not {expected}");
    }
}

#[test]
fn sizes_that_differ_are_refused_by_all() {
    let [a, b] = [noise(1, [20, 30]), noise(1, [30, 20])].map(picture);
    let region = Region::all(&b);
    for said in [
        psnr(&a, &b, &region).expect_err("PSNR").to_string(),
        ssim(&a, &b, &region).expect_err("SSIM").to_string(),
        ssim_of_loss(&a, &b, &region).expect_err("SSIM of the loss").to_string(),
        Score::new(&a, &b, &region, None).expect_err("score").to_string(),
    ] {
        assert_eq!(said, "the sizes differ: 30×20 and 20×30");
    }
}

fn cloud(stream: u32, n: usize, size: [f32; 3]) -> Vec<[f32; 3]> {
    let value = |i: usize| (2.0 * number(stream, i) - 1.0) as f32;
    (0..n).map(|row| [0, 1, 2].map(|c| value(3 * row + c) * size[c])).collect()
}

#[test]
fn distances_of_points_are_those_of_scipy_and_trimesh() {
    let expected = expected();
    let (a, b) = (cloud(1, 500, [1.0; 3]), cloud(2, 800, [0.5, 1.2, 0.8]));
    let apart = chamfer(&a, &b).expect("points");
    close("forward", apart.forward, &expected["chamfer"][0], 1e-6);
    close("backward", apart.backward, &expected["chamfer"][1], 1e-6);
    assert_eq!(apart.mean(), 0.5 * (apart.forward + apart.backward));
    assert_eq!(chamfer(&a, &a).expect("points").mean(), 0.0);
    let torus = snapsnap_mesh::import::read(&data("metrics/torus.obj")).expect("the torus");
    let distance = point_to_surface(&a, &torus).expect("a surface");
    close("point to surface", distance, &expected["point_to_surface"], 1e-6);
    // Sampled points lie on the surface, evenly: their mean is the surface's centre.
    let drawn = geometry::sampled(&torus, 20_000, 3).expect("an area");
    assert!(point_to_surface(&drawn, &torus).expect("a surface") < 1e-6);
    let mean = |c: usize| drawn.iter().map(|p| f64::from(p[c])).sum::<f64>() / 20_000.0;
    assert!((0..3).all(|c| mean(c).abs() < 0.02), "{:?}", [mean(0), mean(1), mean(2)]);
}

#[test]
fn icp_finds_the_motion_that_trimesh_finds() {
    let expected = &expected()["icp"];
    let entry =
        |from: &str, row: usize, column: usize| expected[from][row][column].as_f64().expect("a number");
    let points = cloud(5, 600, [1.0; 3]);
    let moved: Vec<[f32; 3]> = points
        .iter()
        .map(|p| {
            [0, 1, 2].map(|row| {
                let sum: f64 = (0..3).map(|c| entry("motion", row, c) * f64::from(p[c])).sum();
                (sum + entry("motion", row, 3)) as f32
            })
        })
        .collect();
    let found = icp(&points, &moved, false).expect("points");
    for (row, axis) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
        for (column, from) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
            let got = axis.dot(found.rotation * from);
            assert!((got - entry("found", row, column)).abs() < 1e-5, "{row}, {column}: {got}");
        }
        assert!(
            (found.translation.dot(axis) - entry("found", row, 3)).abs() < 1e-5,
            "{:?}",
            found.translation
        );
    }
    assert!(found.cost < 1e-10 && found.scale == 1.0, "{found:?}");
    // With a scale. Points that are aligned already stay.
    let larger: Vec<[f32; 3]> = points.iter().map(|p| p.map(|v| 1.1 * v)).collect();
    let found = icp(&points, &larger, true).expect("points");
    assert!((found.scale - 1.1).abs() < 1e-5 && found.cost < 1e-10, "{found:?}");
    assert_eq!(icp(&points, &points, true).expect("points").cost, 0.0);
}

/// A sphere of radius 0.5 at 2 m, and a plane that leans.
#[test]
fn normals_of_depth_maps_are_those_of_the_surfaces() {
    let camera = Camera::orbit_at_yaw_degrees(0.0, 256);
    let ray = |i: usize| {
        let at = glam::DVec2::new((i % 256) as f64 + 0.5, (i / 256) as f64 + 0.5);
        let at = (at - camera.principal_point) / camera.focal;
        DVec3::new(at.x, at.y, 1.0)
    };
    let centre = DVec3::new(0.0, 0.0, 2.0);
    let sphere = |i: usize| -> f32 {
        let ray = ray(i);
        let (a, b, c) = (ray.dot(ray), ray.dot(centre), centre.dot(centre) - 0.25);
        let root = b * b - a * c;
        if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { 0.0 }
    };
    let depth: Vec<f32> = (0..256 * 256).map(sphere).collect();
    let found = normals(&depth, &camera);
    let truth: Vec<Option<DVec3>> =
        (0..256 * 256).map(|i| found[i].map(|_| (ray(i) * f64::from(depth[i]) - centre) / 0.5)).collect();
    let (agreement, pixels) = consistency(&found, &truth).expect("a sphere");
    assert!(agreement > 0.9999 && pixels > 6000, "{agreement} on {pixels}");
    // Planes whose normals lie 20° apart.
    let plane = |angle: f64| -> Vec<f32> {
        let normal = DVec3::new(angle.to_radians().sin(), 0.0, -angle.to_radians().cos());
        (0..256 * 256).map(|i| (normal.dot(centre) / normal.dot(ray(i))) as f32).collect()
    };
    let [a, b] = [5.0, 25.0].map(|angle| normals(&plane(angle), &camera));
    let (agreement, pixels) = consistency(&a, &b).expect("planes");
    assert!(
        (agreement - 20.0_f64.to_radians().cos()).abs() < 1e-4 && pixels > 60_000,
        "{agreement} on {pixels}"
    );
}

#[test]
fn points_that_are_none_are_refused() {
    let nothing: &[[f32; 3]] = &[];
    for points in [nothing, &[[1.0, f32::NAN, 0.0]]] {
        assert!(chamfer(&[[0.0; 3]], points).is_err() && icp(points, &[[0.0; 3]], false).is_err());
    }
    let flat = snapsnap_mesh::mesh::Mesh { positions: vec![glam::Vec3::ZERO; 3], ..Default::default() };
    assert!(geometry::sampled(&flat, 10, 1).is_err() && point_to_surface(&[[0.0; 3]], &flat).is_err());
}
