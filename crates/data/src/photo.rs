//! A photograph and its mask → a square canvas, with the person at the networks' place and size.

mod doubts;
mod exposure;
mod matting;
mod placing;
mod planes;
mod rim;
mod specks;
mod strokes;
#[cfg(test)]
mod tests;
mod turning;
mod viewpoint;

use std::borrow::Cow;
use std::mem::replace;
use std::path::Path;

use image::{DynamicImage, GrayImage, RgbImage};

use snapsnap_base::FileError;
use snapsnap_mesh::picture::{self, MAX_BYTES};

use exposure::match_back;
use matting::matte;
pub use matting::{SEGMENTER_SIDE, Segmenter};
pub use placing::Mapping;
use placing::{Standing, placed, placed_as_demo, together};
pub(crate) use placing::{on_canvas, place};
pub(crate) use planes::PlaneMap;
use turning::Turn;
pub use viewpoint::{ELEVATIONS, FOCALS, Shot, Viewpoint};

/// Least side of a photograph in pixels.
const MIN_SIDE: u32 = 64;
/// Least share of the person in a pixel of the person.
const THRESHOLD: f32 = 0.5;
/// Canvas side to which heights and rows refer.
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

/// Who tells a photograph's person from the background.
#[derive(Clone, Copy)]
pub enum Cutting<'a> {
    /// Masks and alpha channels alone.
    Given,
    /// A network, for photographs without either.
    Missing(&'a Segmenter<'a>),
    /// A network, for all photographs without a mask's file.
    All(&'a Segmenter<'a>),
}

/// A photograph and what is known about it.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// Its file, or beside `bytes` a name for messages.
    pub path: &'a Path,
    /// The content of its file, if it is in memory.
    pub bytes: Option<&'a [u8]>,
    /// File of the mask (white: person).
    pub mask: Option<&'a Path>,
    /// Corrections of the mask, of any size: white keeps, black removes, 128 changes nothing.
    pub strokes: Option<&'a GrayImage>,
}

impl<'a> Source<'a> {
    /// A file alone.
    pub fn file(path: &'a Path) -> Self {
        Self { path, bytes: None, mask: None, strokes: None }
    }

    fn decode(&self) -> Result<DynamicImage, FileError> {
        match self.bytes {
            Some(bytes) => picture::decode_bytes(self.path, bytes, MAX_BYTES),
            None => picture::decode(self.path, MAX_BYTES),
        }
    }
}

/// One photograph on its canvas; arrays are row-major, side S.
#[derive(Debug, Clone)]
pub struct Canvas {
    /// `[3, S, S]`: colours in [−1, 1] times the mask; the background is 0.
    pub rgb: Vec<f32>,
    /// `[S, S]`: share of the person in each pixel, 0 to 1.
    pub mask: Vec<f32>,
    /// `[S, S]`: whether the pixel belongs to the person.
    pub valid: Vec<bool>,
    /// Map from the photograph to the canvas.
    pub mapping: Mapping,
    /// The placement in words.
    pub report: String,
}

/// The photographs of front and back.
#[derive(Debug, Clone)]
pub struct Pair {
    /// Front and back on their canvases.
    pub canvases: [Canvas; 2],
    /// Colours and masks of front and back before they are turned and placed.
    pub cutouts: [(RgbImage, GrayImage); 2],
    /// Their cameras, as far as they are known, after a turn.
    pub shots: [Shot; 2],
    /// Signs that they are not photographs as the networks need them, a sentence each: a mask that touches three borders, a
    /// person who is wider than high, equal pictures, silhouettes that do not fit one another.
    pub doubts: Vec<String>,
}

/// Loads the photographs of front and back and places each on a canvas of `side` pixels. The mask of the person is the source's, or
/// without one what `cutting` says. With [`Placement::Training`],
/// photographs whose sizes and boxes agree are taken for photographs from one place. They get the same scale and
/// offset. If a focal length is known, from the files or as `focal` in millimetres of 35 mm film, people beside the middle are turned
/// into it.
///
/// # Errors
/// [`FileError`]: unreadable files, a mask of another size, an empty or missing mask, a photograph in which the network finds nobody, a
/// picture below 64 pixels or of a single colour, or, with [`Placement::AsIs`], of another size than the canvas.
pub fn load(
    [front, back]: [Source; 2],
    cutting: Cutting,
    side: usize,
    placement: Placement,
    focal: Option<f64>,
) -> Result<Pair, FileError> {
    let [of_front, of_back] = [front, back].map(|source| Shot::of(&source));
    // Photographs of one person are taken with one camera.
    let both = |own: Shot, other: Shot| Shot {
        focal: focal.or(own.focal).or(other.focal),
        pitch: own.pitch.or(other.pitch),
    };
    let mut shots = [both(of_front, of_back), both(of_back, of_front)];
    let mut front = Cutout::read(front, cutting, side, placement)?;
    let mut back = Cutout::read(back, cutting, side, placement)?;
    if let Placement::Training { .. } = placement
        && let Some([r, g, b]) = match_back((&front.rgb, &front.mask), (&mut back.rgb, &back.mask))
    {
        back.source +=
            &format!(", made {r:.2}, {g:.2}, {b:.2} times as bright (red, green, blue) to match the front");
    }
    let doubts = doubts::doubts(&front, &back);
    let together =
        |front: &Cutout, back: &Cutout| together([&front.mask, &back.mask], [front.person, back.person]);
    let (mut common, mut unturned) = (None, [None, None]);
    if let Placement::Training { .. } = placement {
        common = together(&front, &back);
        unturned = [front.turn(common, &mut shots[0]), back.turn(common, &mut shots[1])];
        if unturned.iter().any(Option::is_some) {
            common = together(&front, &back);
        }
    }
    let canvases = [front.canvas(common, side, placement)?, back.canvas(common, side, placement)?];
    let [of_front, of_back] = unturned;
    let cutouts = [(front, of_front), (back, of_back)]
        .map(|(cutout, unturned)| unturned.unwrap_or((cutout.rgb, cutout.mask)));
    Ok(Pair { canvases, cutouts, shots, doubts })
}

/// Colours and mask of one photograph, as [`load`] takes them for [`Placement::Training`].
///
/// # Errors
/// As [`load`].
pub fn cut_out(source: Source, cutting: Cutting) -> Result<(RgbImage, GrayImage), FileError> {
    let Cutout { rgb, mask, .. } = Cutout::read(source, cutting, 0, Placement::Training { height: 0 })?;
    Ok((rgb, mask))
}

/// A photograph without its background.
struct Cutout<'a> {
    path: &'a Path,
    /// File of the mask.
    mask_path: &'a Path,
    rgb: RgbImage,
    mask: GrayImage,
    person: Rect,
    /// The picture's and the box's size in words.
    source: String,
}

impl<'a> Cutout<'a> {
    fn read(
        source: Source<'a>,
        cutting: Cutting,
        side: usize,
        placement: Placement,
    ) -> Result<Self, FileError> {
        let Source { path, mask, strokes, .. } = source;
        let picture = source.decode()?;
        let (width, height) = (picture.width(), picture.height());
        if placement == Placement::AsIs && (width as usize, height as usize) != (side, side) {
            let message =
                format!("is {width}×{height}, --as-is needs a picture of the canvas's size, {side}×{side}");
            return Err(FileError::unsuitable(path, message));
        }
        if placement != Placement::AsIs && width.min(height) < MIN_SIDE {
            let message = format!("is {width}×{height}; both sides must have at least {MIN_SIDE} pixels");
            return Err(FileError::unsuitable(path, message));
        }
        let (given, mask_path) = match (mask, cutting) {
            (Some(mask_path), _) => (Ok(grey(&picture::decode(mask_path, MAX_BYTES)?)), mask_path),
            (None, Cutting::All(_)) => (Err(""), path),
            (None, _) => (alpha(&picture), path),
        };
        if let Ok((mask_width, mask_height)) = given.as_ref().map(GrayImage::dimensions)
            && (mask_width, mask_height) != (width, height)
        {
            let path = path.display();
            let message =
                format!("the mask is {mask_width}×{mask_height}, its picture {path} is {width}×{height}");
            return Err(FileError::unsuitable(mask_path, message));
        }
        let is_given = given.is_ok();
        let rgb = picture.into_rgb8();
        let (mut rgb, mut mask) = match (given, cutting) {
            (Ok(mask), _) => (rgb, mask),
            (Err(_), Cutting::Missing(segment) | Cutting::All(segment)) => matte(rgb, segment, strokes)
                .ok_or_else(|| {
                    let message =
                        "no person was found in the picture: give masks with --masks FRONT_MASK BACK_MASK";
                    FileError::unsuitable(path, message)
                })?,
            (Err(message), Cutting::Given) => return Err(FileError::unsuitable(path, message)),
        };
        // The demo includes every pixel that is not 0. Lossy masks have many such pixels outside the person.
        let least = if matches!(placement, Placement::Demo { .. }) { 1 } else { u8::MAX.div_ceil(2) };
        // The demo has no such steps, and a network's mask needs none.
        let (specks, rim) = match placement {
            Placement::Training { .. } if is_given => {
                (specks::remove(&mut mask, least), rim::clean(&mut rgb, &mut mask))
            }
            _ => (0, 0),
        };
        // A network's mask has them already.
        if let Some(strokes) = strokes.filter(|_| is_given) {
            strokes::paint(strokes, &mut mask, |_, _| {});
        }
        let person = Rect::around(&mask, least).ok_or_else(|| nobody(mask_path, placement))?;
        if is_single_colour(&rgb, &mask) {
            let message = "the person is of a single colour: this is no photograph";
            return Err(FileError::unsuitable(path, message));
        }
        let cut_out = if is_given {
            String::new()
        } else {
            format!(", cut out by the network at {}×{}", rgb.width(), rgb.height())
        };
        let mut source = format!(
            "{width}×{height}{cut_out}, person's box {}×{} at ({}, {})",
            person.width, person.height, person.x, person.y
        );
        if specks > 0 {
            source += &format!(", {specks} specks of the mask left out");
        }
        if rim > 0 {
            source += &format!(", {rim} pixels of the mask's rim left out: they show the background");
        }
        Ok(Self { path, mask_path, rgb, mask, person, source })
    }

    /// Turns the photograph towards the middle of the person's box, or of the common box of both photographs. `shot` is then the turned
    /// camera. Returns colours and mask before the turn.
    fn turn(&mut self, common: Option<Standing>, shot: &mut Shot) -> Option<(RgbImage, GrayImage)> {
        let person = common.map_or(self.person, |standing| standing.person);
        let turn = Turn::towards(person, self.rgb.dimensions().into(), *shot)?;
        let (rgb, mask) = turn.apply(&self.rgb, &self.mask);
        self.person = Rect::around(&mask, u8::MAX.div_ceil(2))?;
        *shot = turn.shot;
        self.source += &format!(", {}", turn.report());
        Some((replace(&mut self.rgb, rgb), replace(&mut self.mask, mask)))
    }

    /// Places the photograph by the person's box, or by the common box of both photographs.
    fn canvas(
        &self,
        common: Option<Standing>,
        side: usize,
        placement: Placement,
    ) -> Result<Canvas, FileError> {
        let Self { mask_path, rgb, mask, person, source, .. } = self;
        let canvas = match placement {
            Placement::AsIs => on_canvas(rgb, mask, format!("{source}, used as it is")),
            Placement::Training { height } => {
                let with = if common.is_some() { ", with the other" } else { "" };
                let standing = common.unwrap_or(Standing::alone(*person));
                placed(rgb, mask, standing, [height, side], &format!("{source}{with}"))
            }
            Placement::Demo { height } => placed_as_demo(rgb, mask, *person, [height, side], source),
        };
        if canvas.valid.contains(&true) { Ok(canvas) } else { Err(nobody(mask_path, placement)) }
    }
}

fn nobody(mask_path: &Path, placement: Placement) -> FileError {
    let least =
        if matches!(placement, Placement::Demo { .. }) { "255, which `mode.compat` needs" } else { "128" };
    let message = format!("the mask is empty: no pixel of the person reaches {least}");
    FileError::unsuitable(mask_path, message)
}

/// A mask picture's brightness, black where it is transparent.
fn grey(picture: &DynamicImage) -> GrayImage {
    let pixels = picture.to_luma_alpha8();
    GrayImage::from_fn(pixels.width(), pixels.height(), |x, y| {
        let [value, alpha] = pixels.get_pixel(x, y).0;
        image::Luma([(u16::from(value) * u16::from(alpha) / 255) as u8])
    })
}

/// The alpha channel as a mask.
fn alpha(picture: &DynamicImage) -> Result<GrayImage, &'static str> {
    if !picture.color().has_alpha() {
        return Err(
            "has no alpha channel: cut the person out, give masks with --masks FRONT_MASK BACK_MASK, or let --cutout auto do it",
        );
    }
    // The usual case needs no copy.
    let rgba = picture.as_rgba8().map_or_else(|| Cow::Owned(picture.to_rgba8()), Cow::Borrowed);
    let mask = GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| image::Luma([rgba.get_pixel(x, y)[3]]));
    if mask.pixels().all(|p| p[0] == u8::MAX) {
        return Err(
            "is opaque everywhere, so its alpha channel does not show the person: cut the person out, give masks with --masks \
                    FRONT_MASK BACK_MASK, or let --cutout auto do it",
        );
    }
    Ok(mask)
}

fn is_single_colour(rgb: &RgbImage, mask: &GrayImage) -> bool {
    let mut inside = rgb.pixels().zip(mask.pixels()).filter(|(_, m)| m[0] > 0).map(|(p, _)| p);
    let first = inside.next();
    inside.all(|p| Some(p) == first)
}

/// A box of pixels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rect {
    pub x: u32,
    pub y: u32,
    pub width: u32,
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
