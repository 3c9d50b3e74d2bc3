//! Signs that two photographs do not show the front and the back of one person who stands upright.

use glam::Vec2;
use image::GrayImage;
use serde::Serialize;

use super::INSIDE;
use super::cutout::Cutout;
use crate::joints::{Facing, Joints, Part, Sight};
use crate::rect::Rect;

/// Share of a border from which the mask counts as touching the border.
const TOUCHED: f32 = 0.05;
/// Number of touched borders from which a mask is doubtful.
const BORDERS: usize = 3;
/// Largest width of a person as a share of the height. Outstretched arms reach about 1.
const WIDEST: f32 = 1.2;
/// Least overlap (intersection over union) of the front's silhouette and the mirrored back's, scaled to one height.
/// Right pairs have 0.63 and more (docs/notes/photographs.md).
const OVERLAP: f32 = 0.6;
/// Share of the torso outside of the mask from which the mask has a hole.
const HOLE: f32 = 0.02;
/// Side of the grid on which silhouettes and colours are compared, in cells.
const GRID: u32 = 64;
/// Columns of a silhouette's grid, which is wider than outstretched arms.
const COLUMNS: i64 = 2 * GRID as i64;
/// Largest mean difference of colours, of 255, between two files of one picture.
const EQUAL: f32 = 2.0;

/// A sign that photographs are unsuitable, and the photographs that it concerns.
#[derive(Debug, Clone, PartialEq, Serialize, thiserror::Error)]
#[error("{}: {sign}", .photographs.join(" and "))]
pub struct Doubt {
    /// Files or other names of the photographs.
    pub photographs: Vec<String>,
    /// What is wrong.
    #[serde(flatten)]
    pub sign: Sign,
}

/// What is wrong with photographs.
#[derive(Debug, Clone, PartialEq, Serialize, thiserror::Error)]
#[serde(tag = "sign", rename_all = "kebab-case")]
#[allow(missing_docs, reason = "names and messages say it")]
pub enum Sign {
    /// The mask touches more borders of the picture than a person does.
    #[error("the mask touches {borders} borders of the picture: is it inverted? The person must be white")]
    TouchesBorders { borders: usize },
    /// The person is wider than high: width and height in pixels.
    #[error(
        "the person is wider than high ({}×{} pixels): the person should stand upright",
        .size[0], .size[1]
    )]
    Wide { size: [u32; 2] },
    #[error("this is the same picture twice")]
    Equal,
    #[error("one is the mirror image of the other")]
    Mirrored,
    #[error("the first shows the back, the second the front: they were exchanged")]
    Swapped,
    #[error("both show the person's {}: one must show the front, one the back", side(*.facing))]
    SameSide { facing: Facing },
    #[error("the person is seen from the side, not from the front or back")]
    FromTheSide,
    #[error("nobody is recognised in the picture")]
    Nobody,
    #[error("somebody else is in the picture: only one person is taken")]
    Accompanied,
    #[error("the person does not stand upright")]
    Lies,
    #[error("the person seems to sit: the person should stand")]
    Sits,
    #[error("the mask has a hole in the person's torso")]
    Hole,
    #[error("outside of the picture: {}: the whole person must be visible", list(.parts))]
    Outside { parts: Vec<Part> },
    #[error("elsewhere in the back photograph: {}: both need one pose", list(.parts))]
    Moved { parts: Vec<Part> },
    /// The silhouettes do not fit one another: intersection over union.
    #[error(
        "the silhouettes of the front and of the mirrored back overlap by {} % only: are they one person in one pose?",
        (100.0 * *.overlap).round()
    )]
    LittleOverlap { overlap: f32 },
}

impl Sign {
    /// What is wrong with parts of the body, and the parts.
    pub fn of_parts(&self) -> (&'static str, &[Part]) {
        match self {
            Self::Outside { parts } => ("outside of the picture", parts),
            Self::Moved { parts } => ("elsewhere", parts),
            _ => ("", &[]),
        }
    }
}

/// The word for a side.
fn side(facing: Facing) -> &'static str {
    if facing == Facing::Front { "front" } else { "back" }
}

fn list(parts: &[Part]) -> String {
    parts.iter().map(Part::to_string).collect::<Vec<_>>().join(", ")
}

/// Whether the first photograph shows the back and the second one the front.
pub(super) fn are_swapped(front: &Cutout, back: &Cutout) -> bool {
    let facing = |one: &Cutout| one.sight.joints().and_then(Joints::facing);
    (facing(front), facing(back)) == (Some(Facing::Back), Some(Facing::Front))
}

/// What is wrong with one photograph.
pub(super) fn signs(one: &Cutout) -> Vec<Sign> {
    let borders = borders(&one.mask);
    let mut signs = Vec::new();
    if borders >= BORDERS {
        signs.push(Sign::TouchesBorders { borders });
    }
    let Rect { width, height, .. } = one.report.person;
    if width as f32 > WIDEST * height as f32 {
        // The network knows upright people.
        signs.push(Sign::Wide { size: [width, height] });
        return signs;
    }
    let joints = match &one.sight {
        Sight::Unasked => return signs,
        Sight::Nobody => {
            signs.push(Sign::Nobody);
            return signs;
        }
        Sight::Person(joints) => joints,
    };
    let parts = joints.outside(one.frame.size);
    let is_out = |at: &Vec2| {
        let (x, y) = (at.x.max(0.0) as u32, at.y.max(0.0) as u32);
        one.mask.get_pixel_checked(x, y).is_some_and(|mask| mask[0] < INSIDE)
    };
    let (count, out) = (joints.on_torso().count(), joints.on_torso().filter(is_out).count());
    let found = [
        (one.is_accompanied, Sign::Accompanied),
        (joints.lies(), Sign::Lies),
        (!joints.lies() && joints.sits(), Sign::Sits),
        (!joints.lies() && joints.facing() == Some(Facing::Side), Sign::FromTheSide),
        (out as f32 > HOLE * count as f32, Sign::Hole),
        (!parts.is_empty(), Sign::Outside { parts }),
    ];
    signs.extend(found.into_iter().filter(|(is_so, _)| *is_so).map(|(_, sign)| sign));
    signs
}

/// The doubts about both photographs.
pub(super) fn doubts(front: &Cutout, back: &Cutout, swapped: bool) -> Vec<Doubt> {
    let mut doubts = Vec::new();
    let mut add = |about: &[&Cutout], sign: Sign| {
        let photographs = about.iter().map(|one| one.path.display().to_string()).collect();
        doubts.push(Doubt { photographs, sign });
    };
    for one in [front, back] {
        signs(one).into_iter().for_each(|sign| add(&[one], sign));
    }
    let both = [front, back];
    if are_equal(front, back, false) {
        add(&both, Sign::Equal);
    } else if are_equal(front, back, true) {
        add(&both, Sign::Mirrored);
    } else {
        if swapped {
            // In the order in which they were given.
            add(&[back, front], Sign::Swapped);
        }
        if let (Some(a), Some(b)) = (front.sight.joints(), back.sight.joints()) {
            match (a.facing(), b.facing()) {
                (Some(Facing::Front), Some(Facing::Back)) => {
                    let parts = a.moved(b);
                    if !parts.is_empty() {
                        add(&both, Sign::Moved { parts });
                    }
                }
                (Some(facing), other) if Some(facing) == other && facing != Facing::Side => {
                    add(&both, Sign::SameSide { facing });
                }
                _ => {}
            }
        }
        let overlap = overlap(front, back);
        if overlap < OVERLAP {
            add(&both, Sign::LittleOverlap { overlap });
        }
    }
    doubts
}

/// Number of borders that the person touches.
fn borders(mask: &GrayImage) -> usize {
    let (width, height) = mask.dimensions();
    let rows = [0, height - 1].map(|y| share(width, |x| mask.get_pixel(x, y)[0]));
    let columns = [0, width - 1].map(|x| share(height, |y| mask.get_pixel(x, y)[0]));
    rows.into_iter().chain(columns).filter(|share| *share > TOUCHED).count()
}

/// Share of the places along a border that belong to the person.
fn share(length: u32, value: impl Fn(u32) -> u8) -> f32 {
    (0..length).filter(|at| value(*at) >= INSIDE).count() as f32 / length as f32
}

/// Intersection over union of the front's and the mirrored back's silhouette, at one height and where they overlap
/// most. Widths may differ: an arm looks longer in the photograph in which it is nearer to the camera.
fn overlap(front: &Cutout, back: &Cutout) -> f32 {
    let (front, back) = (silhouette(front, false), silhouette(back, true));
    let common = |shift: usize| {
        let count = |a: &[bool], b: &[bool]| a.iter().skip(shift).zip(b).filter(|(a, b)| **a && **b).count();
        let rows = || front.iter().zip(&back);
        // Shifted to either side.
        let counts = [rows().map(|(a, b)| count(a, b)).sum(), rows().map(|(a, b)| count(b, a)).sum()];
        counts.into_iter().fold(0, usize::max)
    };
    let most = (0..=GRID as usize / 2).map(common).fold(0, usize::max);
    let [front, back] = [front, back].map(|rows| rows.iter().flatten().filter(|inside| **inside).count());
    most as f32 / (front + back - most).max(1) as f32
}

/// Rows of a silhouette, mirrored or not, in cells of 1/64 of the person's height, around the middle of its box.
fn silhouette(one: &Cutout, mirrored: bool) -> Vec<Vec<bool>> {
    let Rect { x, y, width, height } = one.report.person;
    let (height, grid) = (i64::from(height), i64::from(GRID));
    let middle = i64::from(x) + i64::from(width) / 2;
    let inside = |row: i64, column: i64| {
        let column = if mirrored { COLUMNS - 1 - column } else { column };
        let across = middle + (2 * column + 1 - COLUMNS) * height / (2 * grid);
        let down = i64::from(y) + (2 * row + 1) * height / (2 * grid);
        let place = u32::try_from(across).ok().zip(u32::try_from(down).ok());
        place.and_then(|(x, y)| one.mask.get_pixel_checked(x, y)).is_some_and(|mask| mask[0] >= INSIDE)
    };
    (0..grid).map(|row| (0..COLUMNS).map(|column| inside(row, column)).collect()).collect()
}

/// Whether the person has the same colours in both pictures, or in one and the mirror image of the other.
fn are_equal(front: &Cutout, back: &Cutout, mirrored: bool) -> bool {
    let (mut sum, mut count) = (0.0, 0);
    // Cells of a grid over the person's box.
    let at = |first: u32, length: u32, cell: u32| first + (2 * cell + 1) * length / (2 * GRID);
    for (column, row) in (0..GRID).flat_map(|row| (0..GRID).map(move |column| (column, row))) {
        let other = if mirrored { GRID - 1 - column } else { column };
        let [a, b] = [(front, column), (back, other)].map(|(one, column)| {
            let person = one.report.person;
            let (x, y) = (at(person.x, person.width, column), at(person.y, person.height, row));
            (one.rgb.get_pixel(x, y).0.map(f32::from), one.mask.get_pixel(x, y)[0] >= INSIDE)
        });
        if a.1 || b.1 {
            sum += a.0.iter().zip(b.0).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0;
            count += 1;
        }
    }
    count > 0 && sum / count as f32 <= EQUAL
}
