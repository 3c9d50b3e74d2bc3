//! The whole inference through the command line, from the authors' checkpoints to the Gaussians, against the authors'
//! numbers. The data are in this repository.

use image::{GrayImage, RgbImage};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{Numbers, data, device, device_name, relative_error, succeed, toml_config};

/// Relative L2 error of points and attributes.
const BOUND: f64 = 1e-4;
/// A confidence this close to the threshold may fall on either side of it.
const UNDECIDED: f32 = 1e-5;
const THRESHOLD: f32 = 0.9;
/// Largest number of side pixels with the colour of another, equally near neighbour. Random weights give a few ties.
const MOST_TIES: usize = 4;

/// Writes the fixture's pictures and masks.
fn pictures(numbers: &Numbers, place: &Workplace) {
    for side in ["front", "back"] {
        let (shape, rgb) = numbers.u8(&format!("{side}_rgb"));
        let (h, w) = (shape[1], shape[2]);
        let pixel = |x: u32, y: u32| {
            let at = y as usize * w + x as usize;
            image::Rgb([rgb[at], rgb[h * w + at], rgb[2 * h * w + at]])
        };
        RgbImage::from_fn(w as u32, h as u32, pixel).save(place.path(&format!("{side}.png"))).expect("PNG");
        let (_, mask) = numbers.u8(&format!("{side}_mask"));
        let high = if mask.iter().all(|v| *v <= 1) { 255 } else { 1 };
        let mask = mask.iter().map(|v| v * high).collect();
        let mask = GrayImage::from_raw(w as u32, h as u32, mask).expect("as many values as pixels");
        mask.save(place.path(&format!("{side}_mask.png"))).expect("PNG");
    }
}

#[test]
fn authors_checkpoints_give_the_authors_gaussians() {
    if device().is_none() {
        return;
    }
    let source = data("pipeline");
    let place = Workplace::empty();
    place.write("config.toml", toml_config(&source.join("config.json")));
    let checkpoints = ["stage1.pth", "stage2.pth"].map(|name| source.join(name));
    succeed(place.run("import-weights --quiet --config config.toml -o w").args(checkpoints));
    let expected = Numbers::read(&source.join("pipeline.safetensors"));
    pictures(&expected, &place);
    let device = device_name().replace("flex", "cpu");
    let line =
        "front.png back.png --masks front_mask.png back_mask.png --as-is --weights w --dump dump --quiet";
    succeed(&mut place.run(&format!("reconstruct {line} --device {device}")));
    compare(&Numbers::read(&place.path("dump")), &expected);
}

fn compare(got: &Numbers, expected: &Numbers) {
    let close = |name: &str, got: &[f32], expected: &[f32]| {
        let error = relative_error(got, expected);
        println!("{name}: relative error {error:.2e}");
        assert!(error <= BOUND, "{name}: {error:e}");
    };
    for name in ["points", "conf"] {
        let (got, expected) = (got.f32(name), expected.f32(name));
        assert_eq!(got.0, expected.0, "{name}: shape");
        close(name, &got.1, &expected.1);
    }

    let (valid, expected_valid) = (got.u8("valid"), expected.u8("valid"));
    assert_eq!(valid.0, expected_valid.0, "valid: shape");
    let conf = expected.f32("conf").1;
    for (i, (a, b)) in valid.1.iter().zip(&expected_valid.1).enumerate() {
        assert!(a == b || (conf[i] - THRESHOLD).abs() < UNDECIDED, "valid: pixel {i}");
    }
    let ties = side_images(got, expected, &valid.1, &expected_valid.1);
    // A tie with the other colour changes the regressor's input of that side, so that its Gaussians have no
    // counterpart. `networks` compares the regressor on equal inputs.
    let area = valid.0[1..].iter().product::<usize>();
    let same_picture = |pixel: usize| pixel / area < 2 || ties[pixel / area - 2] == 0;

    // Rows of the pixels that are valid in both, in the common order.
    let both: Vec<bool> = valid.1.iter().zip(&expected_valid.1).map(|(a, b)| *a > 0 && *b > 0).collect();
    let both: Vec<bool> = both.into_iter().enumerate().map(|(i, both)| both && same_picture(i)).collect();
    let rows = |valid: &[u8], values: &[f32], width: usize| -> Vec<f32> {
        let chosen = (0..valid.len()).filter(|&i| valid[i] > 0).zip(values.chunks_exact(width));
        chosen.filter(|(i, _)| both[*i]).flat_map(|(_, row)| row.to_vec()).collect()
    };
    for (name, width) in [("means", 3), ("opacity", 1), ("scale", 3), ("rotation", 4), ("rgb", 3)] {
        let (got, expected) = (got.f32(name), expected.f32(name));
        assert_eq!(got.0[1], width, "{name}: shape");
        close(name, &rows(&valid.1, &got.1, width), &rows(&expected_valid.1, &expected.1, width));
    }
}

/// Side images agree except where two neighbours are equally near. Returns the number of ties per side.
fn side_images(got: &Numbers, expected: &Numbers, valid: &[u8], expected_valid: &[u8]) -> [usize; 2] {
    let points = expected.f32("points").1;
    let (got, expected_images) = (got.f32("side_images"), expected.f32("side_images"));
    assert_eq!(got.0, expected_images.0, "side_images: shape");
    let area = got.0[2] * got.0[3];
    let rgb = ["front", "back"].map(|side| expected.u8(&format!("{side}_rgb")).1);
    let distance = |a: usize, b: usize| -> f32 {
        (0..3).map(|k| points[3 * a + k] - points[3 * b + k]).map(|d| d * d).sum::<f32>().sqrt()
    };
    let (mut compared, mut ties) = (0, [0; 2]);
    for side in 0..2 {
        for i in 0..area {
            let pixel = (2 + side) * area + i;
            if valid[pixel] != expected_valid[pixel] {
                continue;
            }
            compared += 1;
            let color = |image: &[f32]| [0, 1, 2].map(|c| image[(side * 3 + c) * area + i]);
            let (got, expected) = (color(&got.1), color(&expected_images.1));
            if got.iter().zip(&expected).all(|(a, b)| (a - b).abs() <= 1e-6) {
                continue;
            }
            ties[side] += 1;
            // A reference point of our colour must be as near as the nearest, but for f32 rounding at about 2 m.
            let references = || (0..2 * area).filter(|&r| expected_valid[r] > 0);
            let nearest = references().map(|r| distance(pixel, r)).fold(f32::INFINITY, f32::min);
            let has_color = |r: usize| {
                let byte = |c: usize| f32::from(rgb[r / area][c * area + r % area]);
                (0..3).all(|c| (2.0 * byte(c) / 255.0 - 1.0 - got[c]).abs() <= 1e-6)
            };
            let ours = references()
                .filter(|&r| has_color(r))
                .map(|r| distance(pixel, r))
                .fold(f32::INFINITY, f32::min);
            assert!(ours - nearest <= 2e-6, "side {side} pixel {i}: neighbour at {ours}, nearest {nearest}");
        }
    }
    println!("side_images: {ties:?} ties among {compared} pixels");
    assert!(ties.iter().sum::<usize>() <= MOST_TIES, "{ties:?} ties");
    ties
}
