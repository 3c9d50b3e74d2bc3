//! Boxes of pixels.

use image::GrayImage;
use serde::Serialize;

/// A box of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Rect {
    /// Left.
    pub x: u32,
    /// Top.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Rect {
    /// The smallest box around the pixels whose mask is at least `least`.
    pub fn around(mask: &GrayImage, least: u8) -> Option<Self> {
        let set = mask.enumerate_pixels().filter(|(_, _, p)| p[0] >= least);
        let bounds = set.fold(None, |bounds, (x, y, _)| {
            let (x0, y0, x1, y1) = bounds.unwrap_or((x, y, x, y));
            Some((x0.min(x), y0.min(y), x1.max(x), y1.max(y)))
        });
        bounds.map(|(x0, y0, x1, y1)| Self { x: x0, y: y0, width: x1 - x0 + 1, height: y1 - y0 + 1 })
    }

    /// The part of this box within `reach` (x, y) pixels of the box `inner` inside it.
    pub(crate) fn clipped_around(self, inner: Self, [reach_x, reach_y]: [u32; 2]) -> Self {
        let (x, y) =
            (self.x.max(inner.x.saturating_sub(reach_x)), self.y.max(inner.y.saturating_sub(reach_y)));
        let right = (self.x + self.width).min(inner.x.saturating_add(inner.width).saturating_add(reach_x));
        let bottom = (self.y + self.height).min(inner.y.saturating_add(inner.height).saturating_add(reach_y));
        Self { x, y, width: right - x, height: bottom - y }
    }
}
