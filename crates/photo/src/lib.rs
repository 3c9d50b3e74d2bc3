//! Photographs of a person are placed on canvases and become Gaussians (docs/architecture.md, "The road").

mod cutout;
mod doubts;
mod exposure;
mod matting;
mod person;
mod placing;
mod planes;
mod report;
mod resize;
mod restoration;
mod rim;
mod segmenter;
mod shot;
mod specks;
mod strokes;
#[cfg(test)]
mod tests;
mod turning;

use std::path::Path;

use image::{DynamicImage, GrayImage, RgbImage};
use serde::Serialize;
use snapsnap_base::FileError;
use snapsnap_mesh::picture::{self, MAX_BYTES};
use snapsnap_net::Photograph;

use cutout::Cutout;
pub use doubts::{Doubt, Sign};
use exposure::match_back;
pub use person::{DISTANCES, DistanceBy, ElevationBy, NoGaussian, Person, Seat, Told, Unplaced, person};
use placing::together;
pub use placing::{Mapping, on_canvas};
pub use planes::PlaneMap;
pub use report::{Canvas, PhotoReport};
pub use restoration::{AXIS, Restoration, nominal, turn_to_front, turned};
pub use shot::{ELEVATIONS, FOCALS, Shot, Viewpoint};

/// Least side of a photograph in pixels.
const MIN_SIDE: u32 = 64;
/// Side of the canvas to which constant heights and rows refer, in pixels.
const REFERENCE_SIDE: f32 = 1024.0;

/// Placement of a photograph on its canvas.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Placement {
    /// The picture is the canvas.
    AsIs,
    /// The person's box is resized with antialiasing, to the place of the training subjects.
    Training {
        /// Height of the person in pixels of a canvas of 1024.
        height: usize,
    },
    /// As in the published demo: centred, resized without antialiasing, and valid only for pixels with a full mask.
    Demo {
        /// Height of the person in pixels of a canvas of 1024.
        height: usize,
    },
}

/// What separates the person from the background.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cutting {
    /// Masks and alpha channels alone.
    Given,
    /// A network, for photographs with neither a mask nor an alpha channel.
    Missing,
    /// A network, for all photographs without a mask file. Alpha channels are ignored.
    All,
}

/// Where the pixels of a photograph come from.
#[derive(Clone, Copy)]
pub enum Content<'a> {
    /// The file at the source's path.
    File,
    /// The content of a file.
    Bytes(&'a [u8]),
    /// The pixels, and a mask (the person's share of each pixel) if there is one.
    Pixels(&'a RgbImage, Option<&'a GrayImage>),
}

/// A photograph and what is known about it.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// Path of the file, or a name for messages.
    pub path: &'a Path,
    /// Where the pixels come from.
    pub content: Content<'a>,
    /// File of the mask (white: person).
    pub mask: Option<&'a Path>,
    /// A picture of any size that corrects the mask: white keeps, black removes, 128 changes nothing.
    pub strokes: Option<&'a GrayImage>,
}

impl<'a> Source<'a> {
    /// A photograph in a file, without mask file and strokes.
    pub fn file(path: &'a Path) -> Self {
        Self { path, content: Content::File, mask: None, strokes: None }
    }

    /// A photograph in memory, with its mask if there is one.
    pub fn pixels(name: &'a Path, rgb: &'a RgbImage, mask: Option<&'a GrayImage>) -> Self {
        Self { content: Content::Pixels(rgb, mask), ..Self::file(name) }
    }

    fn decode(&self) -> Result<DynamicImage, FileError> {
        match self.content {
            Content::File => picture::decode(self.path, MAX_BYTES),
            Content::Bytes(bytes) => picture::decode_bytes(self.path, bytes, MAX_BYTES),
            Content::Pixels(rgb, _) => Ok(rgb.clone().into()),
        }
    }
}

/// What is known about the camera of a photograph, after the photograph was turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Focal length and pitch, from the file or the user.
    pub shot: Shot,
    /// Width and height of the photograph in pixels.
    pub size: [u32; 2],
    /// Map from the photograph to the canvas.
    pub mapping: Mapping,
}

/// Photographs of one person on their canvases: the front, then the back and other sides if there are more.
#[derive(Debug, Clone)]
pub struct Photographs {
    /// The photographs, on canvases of one size.
    pub canvases: Vec<Photograph>,
    /// The camera of each photograph, as far as it is known.
    pub frames: Vec<Frame>,
    /// Colours and mask of each photograph before it is turned and placed.
    pub cutouts: Vec<(RgbImage, GrayImage)>,
    /// What was done to each photograph.
    pub reports: Vec<PhotoReport>,
    /// Signs that the first two photographs are unsuitable for the networks.
    pub doubts: Vec<Doubt>,
}

/// Reads photographs and places each on a canvas of `side` pixels. `cutting` says where the mask of a source without
/// one comes from. With [`Placement::Training`], two photographs whose sizes and boxes agree count as taken from one
/// place and get the same scale and offset. If a focal length is known, from the files or as `focal` (millimetres of
/// 35 mm film), a photograph whose person is beside the middle is turned towards the person.
///
/// # Errors
/// [`FileError`]: unreadable files, a mask of another size, an empty or missing mask, nobody found by the network, a
/// file below 64 pixels or of a single colour, or, with [`Placement::AsIs`], a picture of another size.
pub fn read(
    sources: &[Source],
    cutting: Cutting,
    side: usize,
    placement: Placement,
    focal: Option<f64>,
) -> Result<Photographs, FileError> {
    let mut cutouts = Vec::new();
    for source in sources {
        cutouts.push(Cutout::read(*source, cutting, side, placement)?);
    }
    // One camera took all photographs: a value that one file lacks is taken from another file.
    let (mut pitch, mut lens) = (None, focal);
    for cutout in &cutouts {
        (pitch, lens) = (pitch.or(cutout.frame.shot.pitch), lens.or(cutout.frame.shot.focal));
    }
    for cutout in &mut cutouts {
        let own = &mut cutout.frame.shot;
        (own.focal, own.pitch) = (focal.or(own.focal).or(lens), own.pitch.or(pitch));
    }
    let is_placed = matches!(placement, Placement::Training { .. });
    if let ([front, back], true) = (&mut *cutouts, is_placed) {
        back.report.gains = match_back((&front.rgb, &front.mask), (&mut back.rgb, &mut back.mask));
    }
    let doubts = if let [front, back] = &*cutouts { doubts::doubts(front, back) } else { Vec::new() };
    let common = |cutouts: &[Cutout]| match cutouts {
        [front, back] if is_placed => {
            together([&front.mask, &back.mask], [front.report.person, back.report.person])
        }
        _ => None,
    };
    let mut standing = common(&cutouts);
    let mut unturned = vec![None; cutouts.len()];
    if is_placed {
        for (cutout, before) in cutouts.iter_mut().zip(&mut unturned) {
            *before = cutout.turn(standing);
        }
        if unturned.iter().any(Option::is_some) {
            standing = common(&cutouts);
        }
    }
    let mut made = Photographs {
        canvases: Vec::new(),
        frames: Vec::new(),
        cutouts: Vec::new(),
        reports: Vec::new(),
        doubts,
    };
    for (mut cutout, before) in cutouts.into_iter().zip(unturned) {
        made.canvases.push(cutout.place(standing, side, placement)?);
        made.frames.push(cutout.frame);
        made.cutouts.push(before.unwrap_or((cutout.rgb, cutout.mask)));
        made.reports.push(cutout.report);
    }
    Ok(made)
}

/// Colours and mask of one photograph, as [`read`] computes them for [`Placement::Training`].
///
/// # Errors
/// As [`read`].
pub fn cut_out(source: Source, cutting: Cutting) -> Result<(RgbImage, GrayImage), FileError> {
    let Cutout { rgb, mask, .. } = Cutout::read(source, cutting, 0, Placement::Training { height: 0 })?;
    Ok((rgb, mask))
}

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
    fn clipped_around(self, inner: Self, [reach_x, reach_y]: [u32; 2]) -> Self {
        let (x, y) =
            (self.x.max(inner.x.saturating_sub(reach_x)), self.y.max(inner.y.saturating_sub(reach_y)));
        let right = (self.x + self.width).min(inner.x.saturating_add(inner.width).saturating_add(reach_x));
        let bottom = (self.y + self.height).min(inner.y.saturating_add(inner.height).saturating_add(reach_y));
        Self { x, y, width: right - x, height: bottom - y }
    }
}

fn unit(value: u8) -> f32 {
    f32::from(value) / 255.0
}
