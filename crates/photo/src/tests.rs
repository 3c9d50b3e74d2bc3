//! Tests of placement, soft edges and extreme sizes.

use std::path::Path;

use image::{Rgba, RgbaImage};

use super::*;

const SIDE: usize = 256;

/// A person of 40 × 80 pixels in a picture of 100 × 120: upper left red, upper right green, lower left blue, lower
/// right white. The surroundings are bright, transparent noise.
fn quarters() -> RgbaImage {
    RgbaImage::from_fn(100, 120, |x, y| match ((10..50).contains(&x), (30..110).contains(&y)) {
        (true, true) => match (x < 30, y < 70) {
            (true, true) => Rgba([255, 0, 0, 255]),
            (false, true) => Rgba([0, 255, 0, 255]),
            (true, false) => Rgba([0, 0, 255, 255]),
            (false, false) => Rgba([255, 255, 255, 255]),
        },
        _ => Rgba([255, (x * 37) as u8, (y * 91) as u8, 0]),
    })
}

/// Canvas and report of a person's photograph that is both front and back.
fn one(picture: &RgbaImage, placement: Placement) -> (Photograph, PhotoReport) {
    let file = tempfile::Builder::new().suffix(".png").tempfile().expect("temporary file");
    picture.save(file.path()).expect("PNG");
    let read = read(&[Source::file(file.path()); 2], Cutting::Given, SIDE, placement, None);
    let mut read = read.expect("a person");
    (read.canvases.remove(0), read.reports.remove(0))
}

fn check_quarters(canvas: &Photograph, rows: std::ops::Range<usize>) {
    let columns = {
        let width = rows.len() / 2;
        (SIDE - width) / 2..(SIDE + width) / 2
    };
    let area = SIDE * SIDE;
    let at = |row: usize, column: usize| [0, 1, 2].map(|c| canvas.rgb[c * area + row * SIDE + column]);
    let quarter = |r: &std::ops::Range<usize>, upper: bool| r.start + r.len() * if upper { 1 } else { 3 } / 4;
    for (upper, left, expected) in [
        (true, true, [1.0, -1.0, -1.0]),
        (true, false, [-1.0, 1.0, -1.0]),
        (false, true, [-1.0, -1.0, 1.0]),
        (false, false, [1.0, 1.0, 1.0]),
    ] {
        let got = at(quarter(&rows, upper), quarter(&columns, left));
        assert!((0..3).all(|c| (got[c] - expected[c]).abs() < 0.02), "{upper} {left}: {got:?}");
    }
    for i in 0..area {
        let inside = rows.contains(&(i / SIDE)) && columns.contains(&(i % SIDE));
        let near = (rows.start.saturating_sub(2)..rows.end + 2).contains(&(i / SIDE))
            && (columns.start - 2..columns.end + 2).contains(&(i % SIDE));
        assert!(canvas.valid[i] == inside || near, "row {} column {}", i / SIDE, i % SIDE);
        assert!(near || at(i / SIDE, i % SIDE) == [0.0; 3], "the background is 0");
    }
}

#[test]
fn the_person_stands_upright_where_training_subjects_stand_or_in_the_demos_middle() {
    // 740 and the middle row 493.5 of 1024, at a quarter of the size.
    check_quarters(&one(&quarters(), Placement::Training { height: 740 }).0, 31..216);
    check_quarters(&one(&quarters(), Placement::Demo { height: 700 }).0, 40..215);
}

#[test]
fn soft_edges_stay_soft_and_outside_the_box() {
    let picture = RgbaImage::from_fn(100, 200, |x, y| {
        let alpha = match y {
            40..160 if (30..70).contains(&x) => 255,
            35..40 if (30..70).contains(&x) => 100,
            _ => 0,
        };
        Rgba([200, (x * 2) as u8, y as u8, alpha])
    });
    let (canvas, _) = one(&picture, Placement::Training { height: 739 });
    let column: Vec<f32> = (0..SIDE).map(|row| canvas.mask[row * SIDE + SIDE / 2]).collect();
    let soft = column.iter().filter(|m| (0.3..0.5).contains(*m)).count();
    // Five rows of 100/255, enlarged by 739/4/120.
    assert!((6..=9).contains(&soft), "{soft} soft rows");
    assert!(column.iter().filter(|m| **m >= 0.5).count().abs_diff(185) <= 1);
}

#[test]
fn a_person_wider_than_the_canvas_gets_smaller_not_narrower() {
    let picture = RgbaImage::from_fn(400, 100, |x, y| {
        Rgba([x as u8, y as u8, 0, if (10..390).contains(&x) && (40..78).contains(&y) { 255 } else { 0 }])
    });
    for placement in [Placement::Training { height: 739 }, Placement::Demo { height: 700 }] {
        let (canvas, _) = one(&picture, placement);
        let rows = (0..SIDE).filter(|y| canvas.valid[y * SIDE + SIDE / 2]).count();
        let columns = canvas.valid.chunks_exact(SIDE).map(|r| r.iter().filter(|v| **v).count()).max();
        let ratio = columns.expect("rows") as f32 / rows as f32;
        assert!((ratio - 10.0).abs() < 0.7, "{placement:?}: {ratio}");
    }
}

/// The enlarged box of the whole mask would have 370,000 × 370,000 pixels.
#[test]
fn a_speck_far_from_a_tiny_person_costs_nothing() {
    let picture = RgbaImage::from_fn(1000, 1000, |x, y| {
        let alpha = match (x, y) {
            (500..502, 500..502) => 255,
            (0, 0) | (999, 999) => 1,
            _ => 0,
        };
        Rgba([(x % 256) as u8, (y % 256) as u8, 0, alpha])
    });
    let (canvas, _) = one(&picture, Placement::Training { height: 739 });
    let valid = canvas.valid.iter().filter(|v| **v).count();
    assert!((170 * 170..200 * 200).contains(&valid), "{valid}");
}

/// Two photographs from one place get the same scale, with the axis in the middle. Photographs of different sizes, or
/// with different heights of the person, are placed separately.
#[test]
fn photographs_from_one_place_are_placed_together() {
    let person = |size: (u32, u32), x: u32, y: u32, height: u32| {
        let mask = GrayImage::from_fn(size.0, size.1, |i, j| {
            image::Luma([if (x..x + 60).contains(&i) && (y..y + height).contains(&j) { 255 } else { 0 }])
        });
        (RgbImage::from_fn(size.0, size.1, |i, j| Rgb([(i % 251) as u8, (j % 241) as u8, 9])), mask)
    };
    let rows = |canvas: &Photograph| {
        let set: Vec<usize> = (0..SIDE * SIDE).filter(|i| canvas.valid[*i]).collect();
        let columns = || set.iter().map(|i| i % SIDE);
        let middle = columns().min().expect("a person") + columns().max().expect("a person");
        (set[0] / SIDE, set[set.len() - 1] / SIDE, middle)
    };
    let placed = |a: &(RgbImage, GrayImage), b: &(RgbImage, GrayImage)| {
        let sources = [a, b].map(|(rgb, mask)| Source::pixels(Path::new("x"), rgb, Some(mask)));
        let placement = Placement::Training { height: 800 };
        let made = read(&sources, Cutting::Given, SIDE, placement, None).expect("two people");
        let [front, back] = [0, 1].map(|i| made.frames[i].mapping);
        (rows(&made.canvases[0]), rows(&made.canvases[1]), front, back)
    };
    // Toes reach 10 pixels lower than heels; the axis is at 130.
    let (front, back) = (person((300, 300), 110, 40, 210), person((300, 300), 90, 40, 200));
    let (a, b, of_front, of_back) = placed(&front, &back);
    assert_eq!((of_front, a.0), (of_back, b.0));
    assert!(a.1 - a.0 == 199 && (a.1 - b.1).abs_diff(10) <= 1, "{a:?} {b:?}");
    // As far right of the middle as the other is left.
    assert!((a.2 + b.2).abs_diff(2 * (SIDE - 1)) <= 3 && a.2 > b.2 + 30, "{a:?} {b:?}");
    for other in
        [person((301, 300), 90, 40, 200), person((300, 300), 90, 40, 170), person((300, 300), 20, 40, 200)]
    {
        let (a, b, of_front, of_back) = placed(&front, &other);
        assert!(of_front != of_back && a.0.abs_diff(b.0) <= 1 && a.1.abs_diff(b.1) <= 1, "{a:?} {b:?}");
        assert!(a.2.abs_diff(SIDE - 1) <= 1 && b.2.abs_diff(SIDE - 1) <= 1, "{a:?} {b:?}");
    }
}

/// A mask that is a pixel too large, over a lawn. A user's photograph is corrected, a ready canvas is not.
#[test]
fn rims_of_the_background_are_left_out_of_a_users_photographs() {
    let side = SIDE as u32;
    let distance = |x: u32, y: u32| ((x as f32 - 128.0) / 60.0).hypot((y as f32 - 128.0) / 110.0);
    let picture = RgbaImage::from_fn(side, side, |x, y| {
        let [r, g, b] = match distance(x, y) < 1.0 {
            true => [170 + (y % 3) as u8, 60, 90],
            false => [60, 150 + (x % 7) as u8, 30 + (y % 5) as u8],
        };
        Rgba([r, g, b, if distance(x, y) < 1.012 { 255 } else { 0 }])
    });
    let greenish = |canvas: &Photograph| {
        let area = SIDE * SIDE;
        (0..area).filter(|i| canvas.valid[*i] && canvas.rgb[area + i] > canvas.rgb[*i]).count()
    };
    let (corrected, report) = one(&picture, Placement::Training { height: 880 });
    assert!(report.rim > 0 && report.to_string().contains("rim left out"), "{report}");
    assert_eq!(greenish(&corrected), 0);
    for placement in [Placement::AsIs, Placement::Demo { height: 880 }] {
        let (canvas, report) = one(&picture, placement);
        assert!(greenish(&canvas) > 300 && report.rim == 0, "{placement:?}: {}", greenish(&canvas));
    }
    // Photographs in memory, as in training, are corrected as well.
    let rgb = image::DynamicImage::from(picture.clone()).into_rgb8();
    let mask = GrayImage::from_fn(side, side, |x, y| image::Luma([picture.get_pixel(x, y).0[3]]));
    let source = Source::pixels(Path::new("x"), &rgb, Some(&mask));
    let training =
        read(&[source], Cutting::Given, SIDE, Placement::Training { height: 880 }, None).expect("a person");
    assert_eq!(greenish(&training.canvases[0]), 0);
}
