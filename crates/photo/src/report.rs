//! What was done to a photograph on its way to the canvas.

use std::fmt;

use serde::Serialize;

use crate::rect::Rect;

/// What was done to a photograph on its way to the canvas.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotoReport {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Width and height at which a network removed the background, if it did.
    pub cut_out: Option<[u32; 2]>,
    /// The box around the person, in pixels of the photograph; of the turned one, if it was turned.
    pub person: Rect,
    /// Specks of the mask that were left out.
    pub specks: usize,
    /// Pixels of the mask's rim that show the background and were left out.
    pub rim: usize,
    /// Width in pixels of the rim whose colours mix person and background and were replaced by the colours behind.
    pub mixed: usize,
    /// Factors of red, green and blue that match the back to the front.
    pub gains: Option<[f32; 3]>,
    /// Degrees to the right and down by which the photograph was turned towards the person.
    pub turned: Option<[f64; 2]>,
    /// How it came onto the canvas.
    pub canvas: Canvas,
}

/// How a photograph came onto its canvas.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "placed", rename_all = "kebab-case")]
pub enum Canvas {
    /// It is the canvas.
    AsIs,
    /// The person's box was scaled to a place of the canvas.
    Scaled {
        /// Whether the common box of both photographs was placed.
        together: bool,
        /// Canvas pixels per pixel.
        scale: f32,
        /// Whether the person is too wide for its usual height.
        limited_by_width: bool,
        /// Its place.
        #[serde(flatten)]
        place: Place,
    },
    /// As in the published demo.
    Demo(Place),
}

/// The place of the person's box on the canvas.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Place {
    /// Width and height.
    pub size: [usize; 2],
    /// Left and top.
    pub at: [usize; 2],
    /// Side of the canvas.
    pub side: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { size: [w, h], at: [x, y], side } = self;
        write!(f, "{w}×{h} at ({x}, {y}) of {side}×{side}")
    }
}

impl fmt::Display for PhotoReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { size: [width, height], cut_out, person, specks, rim, mixed, gains, turned, canvas } = self;
        write!(f, "{width}×{height}")?;
        if let Some([width, height]) = cut_out {
            write!(f, ", cut out by the network at {width}×{height}")?;
        }
        write!(f, ", person's box {}×{} at ({}, {})", person.width, person.height, person.x, person.y)?;
        if *specks > 0 {
            write!(f, ", {specks} specks of the mask left out")?;
        }
        if *rim > 0 {
            write!(f, ", {rim} pixels of the mask's rim left out: they show the background")?;
        }
        if *mixed > 0 {
            write!(f, ", mixed colours replaced up to {mixed} pixels inside of the outline")?;
        }
        if let Some([r, g, b]) = gains {
            write!(f, ", made {r:.2}, {g:.2}, {b:.2} times as bright (red, green, blue) to match the front")?;
        }
        if let Some([right, down]) = turned {
            write!(f, ", turned towards the person by {right:.1}° to the right and {down:.1}° down")?;
        }
        match canvas {
            Canvas::AsIs => write!(f, ", used as it is"),
            Canvas::Scaled { together, scale, limited_by_width, place } => {
                let with = if *together { ", with the other" } else { "" };
                let limited = if *limited_by_width { " (limited by the width)" } else { "" };
                write!(f, "{with}, scaled by {scale:.4}{limited} to {place}")
            }
            Canvas::Demo(place) => write!(f, ", sampled to {place} as in the demo"),
        }
    }
}
