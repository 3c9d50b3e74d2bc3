//! What a photograph's background leaves in a person: colours of the background, and parts beside the person
//! (docs/method.md, "Evaluation").

use std::collections::{BTreeSet, HashMap};

use image::imageops::{FilterType, resize};
use image::{GrayImage, RgbImage};

use crate::Result;
use crate::geometry::nearest;
use crate::pictures::Picture;
use crate::region::{Region, margin};

/// Steps of a channel that are told apart.
const STEPS: f32 = 63.0;
/// Distance from the nearest of the person's colours from which a colour may be foreign. Channels are 0 to 1.
const DISTINCT: f64 = 0.1;
/// Brightest channel from which a pixel of a render over black shows something.
const SHOWN: f32 = 0.05;

type Cell = [u8; 3];

/// Colours of the person and of the background in photographs.
pub struct Palette {
    person: BTreeSet<Cell>,
    background: BTreeSet<Cell>,
}

/// Shares of the person's pixels in a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Traces {
    /// Pixels in a colour of the background.
    pub foreign: f64,
    /// Pixels that show something beside the person.
    pub beside: f64,
}

impl Palette {
    /// The colours of photographs with the masks of `truth`.
    pub fn new(photographs: &[(RgbImage, GrayImage)], truth: &[(RgbImage, GrayImage)]) -> Self {
        let of = |is_meant: fn(u8) -> bool| {
            let pairs = photographs.iter().zip(truth);
            let pixels = pairs.flat_map(|((color, _), (_, mask))| color.pixels().zip(mask.pixels()));
            let meant = pixels.filter(|(_, share)| is_meant(share[0]));
            meant.map(|(pixel, _)| cell(pixel.0.map(|v| f32::from(v) / 255.0))).collect()
        };
        Self { person: of(|share| share == u8::MAX), background: of(|share| share == 0) }
    }

    /// The traces of the background in a picture whose truth is `target`, with the person's share `mask` of each pixel.
    ///
    /// # Errors
    /// [`EvalError::Message`](crate::EvalError::Message) for a mask without a person.
    pub fn traces(&self, image: &Picture, target: &Picture, mask: &[f32]) -> Result<Traces> {
        let region = Region::masked(mask, [image.height, image.width], margin(image.height))?;
        let color = |of: &Picture, i: usize| [0, 1, 2].map(|c| of.plane(c)[i]);
        let own: Vec<usize> = (0..mask.len()).filter(|i| mask[*i] > 0.5).collect();
        let true_colors = own.iter().map(|i| cell(color(target, *i)));
        let person: BTreeSet<Cell> = self.person.iter().copied().chain(true_colors).collect();
        let is_shown = |i: &usize| color(image, *i).iter().any(|v| *v > SHOWN);
        let mut counts: HashMap<Cell, usize> = HashMap::new();
        own.iter()
            .filter(|i| is_shown(i))
            .for_each(|i| *counts.entry(cell(color(image, *i))).or_default() += 1);
        let (cells, counts): (Vec<Cell>, Vec<usize>) = counts.into_iter().unzip();
        let (cells, person, background) = (places(cells), places(person), places(self.background.clone()));
        let foreign = if background.is_empty() || person.is_empty() || cells.is_empty() {
            0
        } else {
            let (own, other) = (nearest(&cells, &person), nearest(&cells, &background));
            let is_foreign = |i: &usize| own[*i].1 > other[*i].1.max(DISTINCT);
            (0..cells.len()).filter(is_foreign).map(|i| counts[i]).sum()
        };
        let is_beside = |i: &usize| is_shown(i) && !region.counts(i % image.width, i / image.width);
        let beside = (0..mask.len()).filter(is_beside).count();
        let share = |count: usize| count as f64 / own.len().max(1) as f64;
        Ok(Traces { foreign: share(foreign), beside: share(beside) })
    }
}

/// Intersection over union of a mask and the true one, with pixels from 128 on, at the first one's size.
pub fn overlap(found: &GrayImage, truth: &GrayImage) -> f64 {
    let truth = resize(truth, found.width(), found.height(), FilterType::Triangle);
    let count = |is_meant: fn(bool, bool) -> bool| {
        found.pixels().zip(truth.pixels()).filter(|(a, b)| is_meant(a[0] >= 128, b[0] >= 128)).count() as f64
    };
    count(|a, b| a && b) / count(|a, b| a || b).max(1.0)
}

fn cell(color: [f32; 3]) -> Cell {
    color.map(|v| (STEPS * v).round() as u8)
}

fn places(cells: impl IntoIterator<Item = Cell>) -> Vec<[f32; 3]> {
    cells.into_iter().map(|cell| cell.map(|v| f32::from(v) / STEPS)).collect()
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;

    /// A red person of 10 × 20 pixels before a blue wall. The truth has a yellow side, which no photograph shows.
    #[test]
    fn colours_of_the_wall_and_parts_beside_the_person_are_counted() {
        let is_person = |x: u32, y: u32| (10..20).contains(&x) && (5..25).contains(&y);
        let photograph = RgbImage::from_fn(30, 30, |x, y| {
            Rgb(if is_person(x, y) { [200, 30, 30] } else { [30, 30, 220] })
        });
        let mask = GrayImage::from_fn(30, 30, |x, y| Luma([if is_person(x, y) { 255 } else { 0 }]));
        let palette =
            Palette::new(&[(photograph.clone(), GrayImage::new(30, 30))], &[(photograph, mask.clone())]);
        let picture = |color: &dyn Fn(u32, u32) -> [u8; 3]| {
            let pixels = RgbImage::from_fn(30, 30, |x, y| Rgb(color(x, y)));
            Picture::from_file(pixels.into(), "picture").expect("a picture")
        };
        let share: Vec<f32> = mask.pixels().map(|m| f32::from(m[0]) / 255.0).collect();
        let target = picture(&|x, y| if is_person(x, y) { [220, 200, 30] } else { [0; 3] });
        // A column of the wall, a shade of the truth, a column beside the margin, and a hole.
        let image = picture(&|x, y| match x {
            12 if y == 12 => [0; 3],
            10 if is_person(x, y) => [40, 40, 210],
            22 if (5..25).contains(&y) => [90, 90, 90],
            _ if is_person(x, y) => [210, 190, 40],
            _ => [0; 3],
        });
        let traces = |image| palette.traces(image, &target, &share).expect("a person");
        assert_eq!(traces(&image), Traces { foreign: 0.1, beside: 0.1 });
        assert_eq!(traces(&target), Traces { foreign: 0.0, beside: 0.0 });
    }

    #[test]
    fn masks_overlap_by_their_common_pixels() {
        let mask = |from: u32| GrayImage::from_fn(8, 4, |x, _| Luma([if x >= from { 200 } else { 100 }]));
        let shares = [(4, 6), (3, 3), (8, 8)].map(|(a, b)| overlap(&mask(a), &mask(b)));
        assert_eq!(shares, [0.5, 1.0, 0.0]);
    }
}
