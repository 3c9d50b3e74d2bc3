//! Windows: the parts of the canvas that the networks receive.

use std::fmt;
use std::ops::Range;

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::config::{Config, Sides};

/// The regressor halves the image twice, so windows start and end at multiples of this.
const ALIGNMENT: usize = 4;

/// Rows and columns of a square canvas.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
        let lines = masks.flat_map(|mask| mask.chunks_exact(side).enumerate());
        let boxes = lines.filter_map(|(row, line)| {
            let (first, last) = (line.iter().position(|v| *v)?, line.iter().rposition(|v| *v)?);
            Some(Self { rows: row..row + 1, columns: first..last + 1 })
        });
        boxes.reduce(|all, line| all.united(&line))
    }

    /// The tight box around the person in photographs with these masks `[.., side, side]`: every pixel above 0.
    pub fn around_person(masks: &[f32], side: usize) -> Option<Self> {
        let masks: Vec<bool> = masks.iter().map(|mask| *mask > 0.0).collect();
        Self::around(masks.chunks_exact(side * side), side)
    }

    /// The smallest window that contains both.
    pub fn united(&self, other: &Self) -> Self {
        let both = |a: &Range<usize>, b: &Range<usize>| a.start.min(b.start)..a.end.max(b.end);
        Self { rows: both(&self.rows, &other.rows), columns: both(&self.columns, &other.columns) }
    }

    /// Part of the canvas that the point predictor receives: the whole canvas, or the window around the box `person`.
    pub fn of_predictor(config: &Config, person: Option<Self>) -> Self {
        let side = config.network.resolution;
        let person = person.filter(|_| config.network.window);
        let cell = config.network.patch * config.upsample_factor();
        let mut window = person.map_or_else(|| Self::whole(side), |person| person.in_cells(cell, side));
        if config.network.sides == Sides::Completed {
            // From the side, the nearer foot of a person with the legs apart is lower than in the photographs.
            window.rows.end = (window.rows.end + cell).min(side);
        }
        if config.network.mirror || config.network.both_ways || config.network.details.is_some() {
            // Grown until a horizontal flip of the canvas leaves it in place.
            let start = window.columns.start.min(side - window.columns.end);
            window.columns = start..side - start;
        }
        window
    }

    /// Grown by `margin` pixels, then to multiples of 4, inside the canvas, whose side is a multiple of 4. With the
    /// regressor's receptive radius as the margin, pixels outside have no influence.
    pub fn padded(&self, margin: usize, side: usize) -> Self {
        let grow = |r: &Range<usize>| {
            let start = r.start.saturating_sub(margin) / ALIGNMENT * ALIGNMENT;
            start..(r.end + margin).next_multiple_of(ALIGNMENT).min(side)
        };
        Self { rows: grow(&self.rows), columns: grow(&self.columns) }
    }

    /// Grown to whole cells of `cell` pixels, a divisor of `side`, for the point predictor. Windows are at least half
    /// as wide as the person is high, since the unseen sides are seldom wider.
    pub fn in_cells(&self, cell: usize, side: usize) -> Self {
        let (middle, width) =
            ((self.columns.start + self.columns.end) / 2, self.columns.len().max(self.rows.len() / 2).max(1));
        let columns = middle.saturating_sub(width.div_ceil(2))..middle + width.div_ceil(2);
        let whole = |r: &Range<usize>| r.start / cell * cell..r.end.next_multiple_of(cell).min(side);
        Self { rows: whole(&self.rows), columns: whole(&columns) }
    }

    /// The same part of a canvas that is `factor` times smaller. `factor` divides all edges.
    pub fn shrunk(&self, factor: usize) -> Self {
        let shrink = |r: &Range<usize>| r.start / factor..r.end / factor;
        Self { rows: shrink(&self.rows), columns: shrink(&self.columns) }
    }

    /// Crops images `[.., side, side]` to this part.
    pub fn cut<const D: usize>(&self, images: Tensor<D>) -> Tensor<D> {
        let rows = images.narrow(D - 2, self.rows.start, self.rows.len());
        rows.narrow(D - 1, self.columns.start, self.columns.len())
    }

    /// Pastes maps of this part `[B, h, w, C]` into a canvas of zeros `[B, side, side, C]`.
    pub fn pasted(&self, maps: Tensor<4>, side: usize) -> Tensor<4> {
        let [b, _, _, c] = maps.dims();
        let canvas = Tensor::zeros([b, side, side, c], &maps.device());
        canvas.slice_assign([0..b, self.rows.clone(), self.columns.clone(), 0..c], maps)
    }

    /// Crops an image `[channels, side, side]` on the host to this part.
    pub fn crop(&self, image: &[f32], channels: usize, side: usize) -> Vec<f32> {
        let rows = (0..channels).flat_map(|c| self.rows.clone().map(move |row| (c * side + row) * side));
        rows.flat_map(|start| &image[start + self.columns.start..start + self.columns.end]).copied().collect()
    }

    /// Row-major indices, within the window, of the set pixels of a mask `[side, side]`.
    pub fn indices(&self, mask: &[bool], side: usize) -> Vec<i32> {
        let inside = |row: usize| {
            let start = (row - self.rows.start) * self.columns.len();
            let line = &mask[row * side + self.columns.start..row * side + self.columns.end];
            line.iter().enumerate().filter(|(_, set)| **set).map(move |(column, _)| (start + column) as i32)
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
        let padded = person.padded(crate::config::RECEPTIVE_RADIUS, side);
        assert_eq!(padded, Window { rows: 100..404, columns: 100..352 });
        assert_eq!(padded.indices(&mask, side), vec![(101 * 252 + 150), (200 * 252 + 103)]);
        assert_eq!(Window::around([vec![false; 16].as_slice()].into_iter(), 4), None);
    }

    #[test]
    fn the_predictors_windows_are_whole_cells_and_wide_enough_for_the_sides() {
        let person = Window { rows: 201..401, columns: 240..260 };
        assert_eq!(person.in_cells(16, 512), Window { rows: 192..416, columns: 192..304 });
        let corner = Window { rows: 0..500, columns: 490..512 };
        assert_eq!(corner.in_cells(32, 512), Window { rows: 0..512, columns: 352..512 });
        let device = burn::tensor::Device::flex();
        let window = Window { rows: 1..3, columns: 2..3 };
        let map = Tensor::<4>::from_floats([[[[5.0]], [[7.0]]]], &device);
        let canvas = window.pasted(map, 4);
        let values: Vec<f32> = canvas.clone().into_data().try_into_vec().expect("f32");
        assert_eq!((values[6], values[10], values.iter().sum::<f32>()), (5.0, 7.0, 12.0));
        let cut: Vec<f32> = window.cut(canvas.reshape([1, 1, 4, 4])).into_data().try_into_vec().expect("f32");
        assert_eq!(cut, [5.0, 7.0]);
    }

    #[test]
    fn cropping_keeps_channels_and_rows_in_order() {
        let image: Vec<f32> = (0..32).map(|v| v as f32).collect();
        let window = Window { rows: 1..3, columns: 2..4 };
        assert_eq!(window.crop(&image, 2, 4), [6.0, 7.0, 10.0, 11.0, 22.0, 23.0, 26.0, 27.0]);
    }
}
