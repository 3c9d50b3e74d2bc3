//! Where the person comes to lie, and what happens to edges and extremes.

use super::*;
use image::{Rgba, RgbaImage};

const SIDE: usize = 256;

/// A person of 40 × 80 pixels in a picture of 100 × 120: upper left red, upper right green, lower left blue, lower
/// right white; what surrounds it is bright, transparent noise.
fn quarters() -> tempfile::NamedTempFile {
    let picture =
        RgbaImage::from_fn(100, 120, |x, y| match ((10..50).contains(&x), (30..110).contains(&y)) {
            (true, true) => match (x < 30, y < 70) {
                (true, true) => Rgba([255, 0, 0, 255]),
                (false, true) => Rgba([0, 255, 0, 255]),
                (true, false) => Rgba([0, 0, 255, 255]),
                (false, false) => Rgba([255, 255, 255, 255]),
            },
            _ => Rgba([255, (x * 37) as u8, (y * 91) as u8, 0]),
        });
    let file = tempfile::Builder::new().suffix(".png").tempfile().expect("temporary file");
    picture.save(file.path()).expect("PNG");
    file
}

fn check_quarters(canvas: &Canvas, rows: std::ops::Range<usize>) {
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
fn the_person_stands_upright_where_training_subjects_stand() {
    let canvas = load(quarters().path(), None, SIDE, Placement::Training { height: 740 }).expect("a person");
    // 740 and the middle row 493.5 of 1024, at a quarter of the size.
    check_quarters(&canvas, 31..216);
}

#[test]
fn the_demo_puts_the_person_in_the_middle() {
    let canvas = load(quarters().path(), None, SIDE, Placement::Demo { height: 700 }).expect("a person");
    check_quarters(&canvas, 40..215);
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
    let file = tempfile::Builder::new().suffix(".png").tempfile().expect("temporary file");
    picture.save(file.path()).expect("PNG");
    let canvas = load(file.path(), None, SIDE, Placement::Training { height: 739 }).expect("a person");
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
    let file = tempfile::Builder::new().suffix(".png").tempfile().expect("temporary file");
    picture.save(file.path()).expect("PNG");
    for placement in [Placement::Training { height: 739 }, Placement::Demo { height: 700 }] {
        let canvas = load(file.path(), None, SIDE, placement).expect("a person");
        let rows = (0..SIDE).filter(|y| canvas.valid[y * SIDE + SIDE / 2]).count();
        let columns = canvas.valid.chunks_exact(SIDE).map(|r| r.iter().filter(|v| **v).count()).max();
        let ratio = columns.expect("rows") as f32 / rows as f32;
        assert!((ratio - 10.0).abs() < 0.7, "{placement:?}: {ratio}");
    }
}

/// Enlarging everything the mask touches would need a plane of 370,000 × 370,000 pixels here.
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
    let file = tempfile::Builder::new().suffix(".png").tempfile().expect("temporary file");
    picture.save(file.path()).expect("PNG");
    let canvas = load(file.path(), None, SIDE, Placement::Training { height: 739 }).expect("a person");
    let valid = canvas.valid.iter().filter(|v| **v).count();
    assert!((170 * 170..200 * 200).contains(&valid), "{valid}");
}
