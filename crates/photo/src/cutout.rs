//! A photograph without its background.

use std::borrow::Cow;
use std::mem::replace;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use image::{DynamicImage, GrayImage, RgbImage};
use snapsnap_base::FileError;
use snapsnap_mesh::picture::{self, MAX_BYTES};
use snapsnap_net::Photograph;

use crate::exif_camera::{Frame, Shot};
use crate::joints::Sight;
use crate::look::Look;
use crate::matting::{Matte, matte};
use crate::mixed_colors::{self, Background};
use crate::placing::{Mapping, Standing, on_canvas, placed, placed_as_demo};
use crate::recentring::Turn;
use crate::rect::Rect;
use crate::report::{Canvas, PhotoReport};
use crate::segmenter::{pose, segment};
use crate::source::{Content, Cutting, Placement, Source};
use crate::{INSIDE, mask_rim, mask_strokes, specks};

/// Least side of a photograph in pixels.
const MIN_SIDE: u32 = 64;

/// A photograph without its background.
pub(super) struct Cutout<'a> {
    pub path: &'a Path,
    /// File of the mask; without one, of the photograph.
    mask_path: &'a Path,
    pub rgb: RgbImage,
    pub mask: GrayImage,
    pub frame: Frame,
    pub report: PhotoReport,
    /// What the pose network sees.
    pub sight: Sight,
    /// Whether another person is beside the person.
    pub is_accompanied: bool,
}

impl<'a> Cutout<'a> {
    pub fn read(
        source: Source<'a>,
        cutting: Cutting,
        side: usize,
        placement: Placement,
    ) -> Result<Self, FileError> {
        let Source { path, content, mask, strokes } = source;
        let is_file = !matches!(content, Content::Pixels(..));
        let picture = {
            // One after the other: decoders need the most memory.
            static DECODING: Mutex<()> = Mutex::new(());
            let _alone = DECODING.lock().unwrap_or_else(PoisonError::into_inner);
            source.decode()?
        };
        let (width, height) = (picture.width(), picture.height());
        if placement == Placement::AsIs && (width as usize, height as usize) != (side, side) {
            let message =
                format!("is {width}×{height}, --as-is needs a picture of the canvas's size, {side}×{side}");
            return Err(FileError::unsuitable(path, message));
        }
        if is_file && placement != Placement::AsIs && width.min(height) < MIN_SIDE {
            let message = format!("is {width}×{height}; both sides must have at least {MIN_SIDE} pixels");
            return Err(FileError::unsuitable(path, message));
        }
        let (given, mask_path) = match (mask, cutting) {
            (_, Cutting::Given | Cutting::Missing) if let Content::Pixels(_, Some(mask)) = content => {
                (Ok(mask.clone()), path)
            }
            (Some(mask_path), _) => (Ok(grey(&picture::decode(mask_path, MAX_BYTES)?)), mask_path),
            (None, Cutting::All) => (Err(""), path),
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
        let Matte { mut rgb, mut mask, mut look } = match (given, cutting) {
            (Ok(mask), _) => Matte { rgb, mask, look: None },
            (Err(_), Cutting::Missing | Cutting::All) => {
                matte(rgb, &segment, &pose, strokes).ok_or_else(|| {
                    // A page has no options.
                    let is_path = matches!(content, Content::File);
                    let advice = if is_path { ": give masks with --masks FRONT_MASK BACK_MASK" } else { "" };
                    FileError::unsuitable(path, format!("no person was found in the picture{advice}"))
                })?
            }
            (Err(message), Cutting::Given) => return Err(FileError::unsuitable(path, message)),
        };
        let is_accompanied = look.as_ref().is_some_and(|look| look.is_accompanied(&rgb, &pose));
        // The demo includes every pixel that is not 0. Lossy masks have many such pixels outside the person.
        let least = if matches!(placement, Placement::Demo { .. }) { 1 } else { INSIDE };
        // The demo removes neither specks nor rims, and a network's mask has none.
        let (specks, rim) = match placement {
            Placement::Training { .. } if is_given => {
                (specks::remove(&mut mask, least), mask_rim::clean(&mut rgb, &mut mask))
            }
            _ => (0, 0),
        };
        // [`matte`] has applied the strokes to a network's mask already.
        if let Some(strokes) = strokes.filter(|_| is_given) {
            mask_strokes::paint(strokes, &mut mask);
        }
        let person = Rect::around(&mask, least).ok_or_else(|| nobody(mask_path, placement))?;
        if is_file && is_single_colour(&rgb, &mask) {
            let message = "the person is of a single colour: this is no photograph";
            return Err(FileError::unsuitable(path, message));
        }
        // Training samples need no joints.
        if is_given && is_file {
            look = Look::at(&rgb, &mask, person, &pose);
        }
        let sight = match look {
            Some(look) => Sight::Person(look.joints),
            None if is_given && !is_file => Sight::Unasked,
            None => Sight::Nobody,
        };
        let mixed = match placement {
            Placement::Training { .. } => {
                let is_hair = |place| sight.joints().is_some_and(|joints| joints.is_hair(place));
                let size = rgb.dimensions().into();
                let is_kept = |x, y| strokes.is_some_and(|strokes| mask_strokes::keeps(strokes, size, x, y));
                let background = match source.mask {
                    _ if !is_given => Background::OfNetwork,
                    Some(_) => Background::Visible,
                    None => Background::Unknown,
                };
                mixed_colors::replace(&mut rgb, &mask, background, is_hair, is_kept)
            }
            _ => 0,
        };
        let report = PhotoReport {
            size: [width, height],
            cut_out: (!is_given).then(|| rgb.dimensions().into()),
            person,
            specks,
            rim,
            mixed,
            gains: None,
            turned: None,
            canvas: Canvas::AsIs,
        };
        let shot = if is_file { Shot::of(&source) } else { Shot::default() };
        let frame = Frame { shot, size: rgb.dimensions().into(), mapping: Mapping::AS_IT_IS };
        Ok(Self { path, mask_path, rgb, mask, frame, report, sight, is_accompanied })
    }

    /// Turns the photograph towards the middle of the person's box, or of the common box of both photographs. Returns
    /// colours and mask before the turn.
    pub fn turn(&mut self, common: Option<Standing>) -> Option<(RgbImage, GrayImage)> {
        let person = common.map_or(self.report.person, |standing| standing.person);
        let turn = Turn::towards(person, self.frame.size, self.frame.shot)?;
        let (rgb, mask) = turn.apply(&self.rgb, &self.mask);
        self.report.person = Rect::around(&mask, INSIDE)?;
        self.report.turned = Some(turn.angles);
        self.frame.shot = turn.shot;
        Some((replace(&mut self.rgb, rgb), replace(&mut self.mask, mask)))
    }

    /// Places the photograph by the person's box, or by the common box of both photographs.
    pub fn place(
        &mut self,
        common: Option<Standing>,
        side: usize,
        placement: Placement,
    ) -> Result<Photograph, FileError> {
        let Self { rgb, mask, report, .. } = &*self;
        let (photograph, mapping, canvas) = match placement {
            Placement::AsIs => (on_canvas(rgb, mask), Mapping::AS_IT_IS, Canvas::AsIs),
            Placement::Training { height } => placed(rgb, mask, report.person, common, [height, side]),
            Placement::Demo { height } => placed_as_demo(rgb, mask, report.person, [height, side]),
        };
        (self.frame.mapping, self.report.canvas) = (mapping, canvas);
        if photograph.valid.contains(&true) { Ok(photograph) } else { Err(nobody(self.mask_path, placement)) }
    }
}

fn nobody(mask_path: &Path, placement: Placement) -> FileError {
    let least =
        if matches!(placement, Placement::Demo { .. }) { "255, which `mode.compat` needs" } else { "128" };
    let message = format!("the mask is empty: no pixel of the person reaches {least}");
    FileError::unsuitable(mask_path, message)
}

/// A mask picture's brightness, black where it is transparent. A picture of black and one dark colour is a picture of
/// labels, whose colour marks the person.
fn grey(picture: &DynamicImage) -> GrayImage {
    let pixels = picture.to_luma_alpha8();
    let mut mask = GrayImage::from_fn(pixels.width(), pixels.height(), |x, y| {
        let [value, alpha] = pixels.get_pixel(x, y).0;
        image::Luma([(u16::from(value) * u16::from(alpha) / 255) as u8])
    });
    let label = mask.iter().copied().find(|value| *value > 0).filter(|value| *value < INSIDE);
    if label.is_some_and(|label| mask.iter().all(|value| [0, label].contains(value))) {
        mask.iter_mut().for_each(|value| *value = if *value > 0 { u8::MAX } else { 0 });
    }
    mask
}

/// The alpha channel as a mask.
fn alpha(picture: &DynamicImage) -> Result<GrayImage, &'static str> {
    if !picture.color().has_alpha() {
        return Err(
            "has no alpha channel: cut the person out, give masks with --masks FRONT_MASK BACK_MASK, or let --cutout auto do it",
        );
    }
    // RGBA, the usual case, needs no copy.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Pictures of black and one dark colour are labels. Others keep their brightness.
    #[test]
    fn labels_are_masks() {
        let masks = [([0, 1, 1], [0, 255, 255]), ([0, 40, 60], [0, 40, 60]), ([0, 200, 0], [0, 200, 0])];
        for (values, expected) in masks {
            let mask = GrayImage::from_raw(3, 1, values.to_vec()).expect("three pixels");
            assert_eq!(grey(&mask.into()).as_raw(), &expected, "{values:?}");
        }
    }
}
