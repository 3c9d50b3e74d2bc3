//! Regions in which pictures are compared: the whole picture, the paper's window around the person, the person, or
//! the head (docs/method.md, "Evaluation").

use std::ops::Range;

use snapsnap_net::{Window, dilated};

use crate::pictures::Picture;
use crate::{EvalError, Result};

/// The paper's window, height and width at 1024 pixels.
const PAPER: [usize; 2] = [1000, 500];
/// Margin of the protocol `masked` around the person's mask, at 1024 pixels.
const MARGIN: usize = 8;
/// Share of the person's height that is head and neck.
const HEAD: f32 = 0.17;
/// The picture height to which [`PAPER`] and [`MARGIN`] refer.
const AT: usize = 1024;

/// The compared pixels of a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Left, top, width, height.
    pub window: [usize; 4],
    /// Mask `[height, width]` of the compared pixels of the window; `None`: all.
    pub inside: Option<Vec<bool>>,
}

impl Region {
    /// The whole picture.
    pub fn all(picture: &Picture) -> Self {
        Self { window: [0, 0, picture.width, picture.height], inside: None }
    }

    /// The paper's window of 1000 × 500 of 1024 pixels, scaled to the picture's height. It is centred on the box of
    /// all ground-truth pixels that are not black, then moved into the picture. Wider people are cut off.
    ///
    /// # Errors
    /// [`EvalError::Message`] for a black picture.
    pub fn paper(target: &Picture) -> Result<Self> {
        let Picture { width, height, .. } = *target;
        let seen = |i: usize| (0..3).any(|c| target.plane(c)[i] != 0.0);
        let seen: Vec<bool> = (0..width * height).map(seen).collect();
        let Some(Window { rows, columns }) = Window::around([&seen[..]].into_iter(), width) else {
            return Err(EvalError::new("the true picture is black throughout: there is no person"));
        };
        let side = |of: usize, most: usize| ((of * height + AT / 2) / AT).clamp(1, most);
        let [h, w] = [side(PAPER[0], height), side(PAPER[1], width)];
        let place = |of: Range<usize>, side: usize, most: usize| {
            ((of.start + of.end - 1) / 2).saturating_sub(side / 2).min(most - side)
        };
        let window = [place(columns, w, width), place(rows, h, height), w, h];
        Ok(Self { window, inside: None })
    }

    /// The person's mask `[H, W]` (any value above 0) with `margin` pixels around it.
    ///
    /// # Errors
    /// [`EvalError::Message`] for a mask without a person.
    pub fn masked(mask: &[f32], [_, width]: [usize; 2], margin: usize) -> Result<Self> {
        let inside = dilated(&mask.iter().map(|v| *v > 0.0).collect::<Vec<_>>(), width, margin);
        let Some(Window { rows, columns }) = Window::around([&inside[..]].into_iter(), width) else {
            return Err(EvalError::new("the mask is empty: there is no person"));
        };
        let window = [columns.start, rows.start, columns.len(), rows.len()];
        let line = |row: usize| &inside[row * width..][columns.clone()];
        let inside = rows.flat_map(line).copied().collect();
        Ok(Self { window, inside: Some(inside) })
    }

    /// The region's upper part, which shows the head of a person without raised arms.
    pub fn head(mut self) -> Self {
        let [.., width, height] = &mut self.window;
        *height = (HEAD * *height as f32).ceil() as usize;
        self.inside.iter_mut().for_each(|inside| inside.truncate(*width * *height));
        self
    }

    /// Whether a pixel of the picture is compared.
    pub fn counts(&self, column: usize, row: usize) -> bool {
        let [x, y, width, height] = self.window;
        let in_window = (x..x + width).contains(&column) && (y..y + height).contains(&row);
        in_window && self.inside.as_ref().is_none_or(|inside| inside[(row - y) * width + column - x])
    }

    /// Number of compared pixels.
    pub fn pixels(&self) -> usize {
        let [.., width, height] = self.window;
        self.inside.as_ref().map_or(width * height, |inside| inside.iter().filter(|set| **set).count())
    }
}

/// Margin of the protocol `masked` in pictures of this height: 8 pixels of 1024.
pub fn margin(height: usize) -> usize {
    (MARGIN * height).div_ceil(AT)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture([height, width]: [usize; 2], lit: &[[usize; 2]]) -> Picture {
        let mut values = vec![0.0; 3 * height * width];
        lit.iter().for_each(|[x, y]| values[height * width + y * width + x] = 1.0 / 255.0);
        Picture::new(values, [height, width], "picture").expect("a picture")
    }

    #[test]
    fn the_papers_window_lies_around_the_person_and_inside_the_picture() {
        let window =
            |lit: &[[usize; 2]]| Region::paper(&picture([1024, 1024], lit)).expect("a person").window;
        assert_eq!(window(&[[400, 100], [700, 900]]), [300, 0, 500, 1000]);
        assert_eq!(window(&[[400, 512], [700, 520]]), [300, 16, 500, 1000]);
        assert_eq!(window(&[[0, 1000], [10, 1023]]), [0, 24, 500, 1000]);
        assert_eq!(window(&[[1023, 0]]), [524, 0, 500, 1000]);
        // Scaled by the height; never larger than the picture.
        let small = Region::paper(&picture([256, 100], &[[50, 128]])).expect("a person");
        assert_eq!(small.window, [0, 3, 100, 250]);
    }

    #[test]
    fn a_masks_region_is_its_box_and_counts_its_pixels() {
        assert_eq!([256, 512, 1000, 1024, 2048].map(margin), [2, 4, 8, 8, 16]);
        let mut mask = vec![0.0; 20 * 10];
        mask[5 * 20 + 7] = 1.0;
        let region = Region::masked(&mask, [10, 20], 2).expect("a person");
        assert_eq!((region.window, region.pixels()), ([5, 3, 5, 5], 25));
        let head = region.head();
        assert_eq!((head.window, head.pixels()), ([5, 3, 5, 1], 5));
    }
}
