//! Removes specks of a mask far from the person. A few pixels in a corner would make the person's box larger and the
//! person smaller.

use image::GrayImage;

use crate::rect::Rect;

/// Largest number of cells along a side of the grid on which pieces are told apart.
const CELLS: u32 = 512;
/// Largest distance of a piece from the box of the largest one, as a share of that box's height.
const NEAR: f32 = 0.06;
/// Size from which a distant piece is no speck, as a share of the largest piece.
const LARGE: f32 = 0.03;

/// Pieces of a mask on a grid.
pub(super) struct Pieces {
    /// For each cell, row by row, the number of its piece, counted from 1; 0 for empty cells.
    pub of: Vec<u32>,
    /// Number of cells and box in cells of each piece.
    pub pieces: Vec<(usize, Rect)>,
}

/// Clears small pieces far from the largest piece of the pixels that reach `least`. Returns the number of pieces.
pub(super) fn remove(mask: &mut GrayImage, least: u8) -> usize {
    let (width, height) = mask.dimensions();
    let cell = width.max(height).div_ceil(CELLS).max(1);
    let columns = width.div_ceil(cell);
    let mut marked = vec![false; (columns * height.div_ceil(cell)) as usize];
    for (x, y, value) in mask.enumerate_pixels() {
        if value[0] >= least {
            marked[(y / cell * columns + x / cell) as usize] = true;
        }
    }
    let Pieces { of, pieces } = pieces(&marked, columns);
    let Some((largest, person)) = pieces.iter().max_by_key(|(size, _)| *size) else { return 0 };
    let near = (NEAR * person.height as f32).ceil() as u32;
    let is_speck: Vec<bool> = pieces
        .iter()
        .map(|(size, piece)| (*size as f32) < LARGE * *largest as f32 && !overlap(piece, person, near))
        .collect();
    let count = is_speck.iter().filter(|speck| **speck).count();
    if count > 0 {
        for (x, y, value) in mask.enumerate_pixels_mut() {
            let piece = of[(y / cell * columns + x / cell) as usize];
            if piece > 0 && is_speck[piece as usize - 1] {
                value[0] = 0;
            }
        }
    }
    count
}

/// Whether the boxes are at most `near` cells apart.
fn overlap(a: &Rect, b: &Rect, near: u32) -> bool {
    a.x <= b.x + b.width + near
        && b.x <= a.x + a.width + near
        && a.y <= b.y + b.height + near
        && b.y <= a.y + a.height + near
}

/// The connected pieces of the marked cells, with diagonal neighbours.
pub(super) fn pieces(marked: &[bool], columns: u32) -> Pieces {
    let rows = marked.len() as u32 / columns;
    let mut found = Pieces { of: vec![0; marked.len()], pieces: Vec::new() };
    let mut waiting = Vec::new();
    for first in 0..marked.len() as u32 {
        if !marked[first as usize] || found.of[first as usize] > 0 {
            continue;
        }
        let number = found.pieces.len() as u32 + 1;
        found.of[first as usize] = number;
        waiting.push(first);
        let (mut size, mut low, mut high) = (0, [u32::MAX; 2], [0; 2]);
        while let Some(cell) = waiting.pop() {
            let (x, y) = (cell % columns, cell / columns);
            size += 1;
            (low, high) = ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]);
            for next_y in y.saturating_sub(1)..(y + 2).min(rows) {
                for next_x in x.saturating_sub(1)..(x + 2).min(columns) {
                    let next = next_y * columns + next_x;
                    if marked[next as usize] && found.of[next as usize] == 0 {
                        found.of[next as usize] = number;
                        waiting.push(next);
                    }
                }
            }
        }
        let around = Rect { x: low[0], y: low[1], width: high[0] - low[0] + 1, height: high[1] - low[1] + 1 };
        found.pieces.push((size, around));
    }
    found
}

#[cfg(test)]
mod tests {
    use image::Luma;

    use super::*;

    fn mask(parts: &[(std::ops::Range<u32>, std::ops::Range<u32>)]) -> GrayImage {
        let mut mask = GrayImage::new(1200, 1600);
        for (columns, rows) in parts {
            for y in rows.clone() {
                columns.clone().for_each(|x| mask.put_pixel(x, y, Luma([255])));
            }
        }
        mask
    }

    #[test]
    fn a_distant_speck_goes_and_what_may_belong_to_the_person_stays() {
        let (body, speck, foot) = ((400..700, 100..1300), (1100..1120, 20..40), (420..500, 1340..1400));
        let mut with_speck = mask(&[body.clone(), foot.clone(), speck.clone()]);
        assert_eq!(remove(&mut with_speck, 128), 1);
        assert_eq!(with_speck, mask(&[body.clone(), foot]));
        // A cell of the grid is several pixels wide; a speck in a corner of one goes whole.
        let mut two = mask(&[body.clone(), (3..4, 1597..1598), speck]);
        assert_eq!(remove(&mut two, 128), 2);
        assert_eq!(two, mask(std::slice::from_ref(&body)));
        // Somebody else, or the half of a body.
        let mut large = mask(&[body.clone(), (900..1000, 100..600)]);
        assert_eq!(remove(&mut large, 128), 0);
        assert_eq!(large, mask(&[body, (900..1000, 100..600)]));
        assert_eq!(remove(&mut GrayImage::new(5, 5), 128), 0);
    }
}
