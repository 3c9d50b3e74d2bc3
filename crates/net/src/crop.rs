//! The part of the canvas that the regressor looks at.

use std::fmt;
use std::ops::Range;

use crate::regressor::RECEPTIVE_RADIUS;

/// The regressor halves the image twice, so windows start and end at multiples of this.
const ALIGNMENT: usize = 4;

/// Rows and columns of a square canvas.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Window {
    /// Rows.
    pub rows: Range<usize>,
    /// Columns.
    pub columns: Range<usize>,
}

impl Window {
    /// The whole canvas.
    pub fn whole(side: usize) -> Self {
        Self { rows: 0..side, columns: 0..side }
    }

    /// The tight box around all set pixels of the masks `[side, side]`; `None` if none is set.
    pub fn around<'a>(masks: impl Iterator<Item = &'a [bool]>, side: usize) -> Option<Self> {
        let mut found: Option<Self> = None;
        for mask in masks {
            for (row, line) in mask.chunks_exact(side).enumerate() {
                let Some(first) = line.iter().position(|v| *v) else { continue };
                let last = line.iter().rposition(|v| *v).expect("there is a first");
                let window = found.get_or_insert(Self { rows: row..row + 1, columns: first..last + 1 });
                window.rows = window.rows.start.min(row)..window.rows.end.max(row + 1);
                window.columns = window.columns.start.min(first)..window.columns.end.max(last + 1);
            }
        }
        found
    }

    /// Grown by the regressor's receptive radius, so that what lies outside cannot matter, to aligned edges inside the
    /// canvas (whose side is a multiple of 4).
    pub fn padded(&self, side: usize) -> Self {
        let grow = |r: &Range<usize>| {
            let start = r.start.saturating_sub(RECEPTIVE_RADIUS) / ALIGNMENT * ALIGNMENT;
            start..(r.end + RECEPTIVE_RADIUS).next_multiple_of(ALIGNMENT).min(side)
        };
        Self { rows: grow(&self.rows), columns: grow(&self.columns) }
    }

    /// This part of an image `[channels, side, side]`.
    pub fn crop(&self, image: &[f32], channels: usize, side: usize) -> Vec<f32> {
        let rows = (0..channels).flat_map(|c| self.rows.clone().map(move |row| (c * side + row) * side));
        rows.flat_map(|start| &image[start + self.columns.start..start + self.columns.end]).copied().collect()
    }

    /// Row-major positions within the window of the mask's set pixels.
    pub fn indices(&self, mask: &[bool], side: usize) -> Vec<i64> {
        let inside = |row: usize| {
            let start = (row - self.rows.start) * self.columns.len();
            let line = &mask[row * side + self.columns.start..row * side + self.columns.end];
            line.iter().enumerate().filter(|(_, set)| **set).map(move |(column, _)| (start + column) as i64)
        };
        self.rows.clone().flat_map(inside).collect()
    }
}

impl fmt::Display for Window {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}×{}", self.columns.len(), self.rows.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_hold_the_person_and_stay_aligned_inside_the_canvas() {
        let side = 512;
        let mut mask = vec![false; side * side];
        mask[201 * side + 250] = true;
        mask[300 * side + 203] = true;
        let person = Window::around([mask.as_slice()].into_iter(), side).expect("pixels");
        assert_eq!(person, Window { rows: 201..301, columns: 203..251 });
        let padded = person.padded(side);
        assert_eq!(padded, Window { rows: 100..404, columns: 100..352 });
        assert_eq!(padded.indices(&mask, side), vec![(101 * 252 + 150), (200 * 252 + 103)]);
        assert_eq!(Window::around([vec![false; 16].as_slice()].into_iter(), 4), None);
    }

    #[test]
    fn cropping_keeps_channels_and_rows_in_order() {
        let image: Vec<f32> = (0..32).map(|v| v as f32).collect();
        let window = Window { rows: 1..3, columns: 2..4 };
        assert_eq!(window.crop(&image, 2, 4), [6.0, 7.0, 10.0, 11.0, 22.0, 23.0, 26.0, 27.0]);
    }
}
