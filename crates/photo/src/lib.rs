//! Photographs of a person are placed on canvases and become Gaussians (docs/architecture.md, "The road").

mod cutout;
mod doubts;
mod exif_camera;
mod exposure;
mod joints;
mod look;
mod mask_rim;
mod mask_strokes;
mod matting;
mod mixed_colors;
mod person;
mod placing;
mod recentring;
mod rect;
mod report;
mod resize;
mod restoration;
mod rim;
pub mod segmenter;
mod source;
mod specks;
mod surface;
#[cfg(test)]
mod tests;

use std::panic::resume_unwind;

use glam::Vec3;
use image::{GrayImage, Rgb, RgbImage};
use snapsnap_base::FileError;
use snapsnap_net::Photograph;

use cutout::Cutout;
pub use doubts::{Doubt, Sign};
pub use exif_camera::{ELEVATIONS, FOCALS, Frame, Shot, Viewpoint};
use exposure::match_back;
pub use joints::{Facing, Joint, Part};
pub use person::{DISTANCES, DistanceBy, ElevationBy, Lens, NoPerson, Person, Seat, Told, Unplaced, person};
use placing::together;
pub use placing::{Mapping, on_canvas};
pub use rect::Rect;
pub use report::{Canvas, PhotoReport, Place};
pub use restoration::{AXIS, PlaneMap, Restoration, nominal, turn_to_front, turned};
pub use source::{Content, Cutting, Placement, Source};
pub use surface::reconstruct;

/// Mask value from which a pixel is the person's.
const INSIDE: u8 = 128;

/// Photographs of one person on their canvases: the front, then the back and other sides if there are more.
#[derive(Debug, Clone, Default)]
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
/// place and get the same scale and offset, and two files are exchanged if the first shows the back and the second the
/// front. If a focal length is known, from the files or as `focal` (millimetres of
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
    let cut_out = |source| Cutout::read(source, cutting, side, placement);
    // Threads of their own: a thread of the pool must not wait for the pool. Training samples have masks.
    let cutouts = if cutting != Cutting::Given && rayon::current_thread_index().is_none() {
        std::thread::scope(|scope| {
            let threads: Vec<_> =
                sources.iter().map(|source| scope.spawn(move || cut_out(*source))).collect();
            threads.into_iter().map(|thread| thread.join().unwrap_or_else(|e| resume_unwind(e))).collect()
        })
    } else {
        sources.iter().map(|source| cut_out(*source)).collect::<Vec<_>>()
    };
    let mut cutouts = cutouts.into_iter().collect::<Result<Vec<_>, _>>()?;
    // One camera took all photographs: a value that one file lacks is taken from another file.
    let pitch = cutouts.iter().find_map(|cutout| cutout.frame.shot.pitch);
    let lens = cutouts.iter().find_map(|cutout| cutout.frame.shot.focal);
    for cutout in &mut cutouts {
        let own = &mut cutout.frame.shot;
        (own.focal, own.pitch) = (focal.or(own.focal).or(lens), own.pitch.or(pitch));
    }
    let is_placed = matches!(placement, Placement::Training { .. });
    // A caller with pictures in memory knows their order.
    let is_free = is_placed && !sources.iter().any(|source| matches!(source.content, Content::Pixels(..)));
    let swapped = is_free && matches!(&*cutouts, [front, back] if doubts::are_swapped(front, back));
    if swapped {
        cutouts.reverse();
    }
    if let ([front, back], true) = (&mut *cutouts, is_placed) {
        back.report.gains = match_back((&front.rgb, &front.mask), (&mut back.rgb, &mut back.mask));
    }
    let doubts =
        if let [front, back] = &*cutouts { doubts::doubts(front, back, swapped) } else { Vec::new() };
    let common = |cutouts: &[Cutout]| match cutouts {
        [front, back] if is_placed => {
            together([&front.mask, &back.mask], [front.report.person, back.report.person])
        }
        _ => None,
    };
    let mut standing = common(&cutouts);
    let turn = |cutout: &mut Cutout| is_placed.then(|| cutout.turn(standing)).flatten();
    let unturned: Vec<_> = cutouts.iter_mut().map(turn).collect();
    if unturned.iter().any(Option::is_some) {
        standing = common(&cutouts);
    }
    let mut made = Photographs { doubts, ..Photographs::default() };
    for (mut cutout, before) in cutouts.into_iter().zip(unturned) {
        made.canvases.push(cutout.place(standing, side, placement)?);
        made.frames.push(cutout.frame);
        made.cutouts.push(before.unwrap_or((cutout.rgb, cutout.mask)));
        made.reports.push(cutout.report);
    }
    Ok(made)
}

/// A photograph without its background, and what was seen in it.
pub struct Figure {
    /// Colours of the photograph.
    pub rgb: RgbImage,
    /// Coverage by the person.
    pub mask: GrayImage,
    /// The person's 33 joints; none if nobody is recognised.
    pub joints: Vec<Joint>,
    /// What is wrong with the photograph.
    pub signs: Vec<Sign>,
}

/// One photograph, as [`read`] treats it with [`Placement::Training`].
///
/// # Errors
/// As [`read`].
pub fn cut_out(source: Source, cutting: Cutting) -> Result<Figure, FileError> {
    let cutout = Cutout::read(source, cutting, 0, Placement::Training { height: 0 })?;
    let joints = cutout.sight.joints().map_or_else(Vec::new, |joints| joints.0.clone());
    let signs = doubts::signs(&cutout);
    Ok(Figure { rgb: cutout.rgb, mask: cutout.mask, joints, signs })
}

/// The person's 33 joints on a canvas, in its pixels; none if nobody is recognised.
pub fn joints_on(canvas: &Photograph) -> Vec<Joint> {
    let side = canvas.mask.len().isqrt() as u32;
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    let area = canvas.mask.len();
    // A canvas is grey outside of the person.
    let color = |i: usize| [0, 1, 2].map(|c| byte(0.5 * canvas.rgb[c * area + i] + 0.5));
    let at = |x: u32, y: u32| (y * side + x) as usize;
    let rgb = RgbImage::from_fn(side, side, |x, y| Rgb(color(at(x, y))));
    let mask = GrayImage::from_fn(side, side, |x, y| image::Luma([byte(canvas.mask[at(x, y)])]));
    let person = Rect::around(&mask, INSIDE);
    let look = person.and_then(|person| look::Look::at(&rgb, &mask, person, &segmenter::pose));
    look.map_or_else(Vec::new, |look| look.joints.0)
}

/// A channel in [0, 1].
fn unit(value: u8) -> f32 {
    f32::from(value) / 255.0
}

/// A colour with channels in [0, 1].
fn unit_color(pixel: &Rgb<u8>) -> Vec3 {
    Vec3::from(pixel.0.map(f32::from)) / 255.0
}
