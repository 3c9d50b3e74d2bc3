//! Changes that give a data set's views the faults of a user's photographs.

use image::{GrayImage, RgbImage};
use serde::{Deserialize, Serialize};

use super::augment::moved;
use super::scene::{Scene, behind, photographed};
use snapsnap_base::{config, random};
use snapsnap_photo::Rect;

/// Canvas side that lengths refer to.
const REFERENCE_SIDE: f32 = 1024.0;

/// How photographs become a person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Road {
    /// The photographs are the canvases already. Cameras and masks are the data set's.
    #[default]
    Canvas,
    /// The photographs are placed on their canvases like a user's photographs. Cameras and masks are the data set's.
    Placed,
    /// The photographs are treated as a user's photographs: cameras and masks are unknown. The similarity that moves
    /// the Gaussians nearest to where the true cameras see them brings the person into the data set's world.
    User,
}

/// Changes to photographs before they become a model's input: the section `[photographs]` of an evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhotographChanges {
    /// How photographs become a person.
    pub road: Road,
    /// Difference of exposure, in stops, between the first photograph and the others; each photograph gets half of it.
    pub exposure: f32,
    /// Stops by which the exposure of the back changes. The front does not change.
    pub back_exposure: f32,
    /// Colour of the background from 0 to 1; unset: the data set's. The background shows through too large masks.
    pub background: Option<[f32; 3]>,
    /// What is behind the person instead of a background of one colour.
    pub scene: Option<Scene>,
    /// Whether photographs have the faults of a camera: point spread, sharpening, noise and JPEG.
    pub camera: bool,
    /// Error of the masks in pixels of 1024: above 0 they are too large, below 0 too small.
    pub mask: f32,
    /// Share of the person's width that the frame cuts off, on the left of the first photograph and on the right of the
    /// others.
    pub cut: f32,
    /// Whether all of the person's pixels have their mean colour, so that only the outline is left.
    pub grey: bool,
}

impl PhotographChanges {
    /// Whether the photographs get another background.
    pub fn has_background(&self) -> bool {
        self.scene.is_some() || self.background.is_some()
    }

    /// The first invalid key, and why it is invalid.
    pub fn problem(&self) -> Option<(&'static str, String)> {
        // Photographs of a user come without masks, and only masks say where the frame cuts the person off.
        if self.road == Road::User && (self.mask != 0.0 || self.cut != 0.0) {
            let key = if self.mask != 0.0 { "mask" } else { "cut" };
            return Some((key, "must be 0 with `photographs.road = \"user\"`, which uses no masks".into()));
        }
        if self.scene.is_some() && self.background.is_some() {
            let message = "must be unset with `photographs.background`: it is behind the person";
            return Some(("scene", message.into()));
        }
        let background = self.background.unwrap_or_default().map(|value| ("background", value, 0.0..=1.0));
        config::outside([
            ("exposure", self.exposure, -4.0..=4.0),
            ("back_exposure", self.back_exposure, -4.0..=4.0),
            ("mask", self.mask, -64.0..=64.0),
            ("cut", self.cut, 0.0..=0.9),
        ])
        .or_else(|| config::outside(background))
    }

    /// The changed photograph number `index` of the person `name`, and its mask.
    pub(super) fn apply(
        &self,
        name: &str,
        index: usize,
        mut color: RgbImage,
        mut mask: GrayImage,
    ) -> (RgbImage, GrayImage) {
        if self.grey {
            flatten(&mut color, &mask);
        }
        let stops = if index == 0 { 0.5 * self.exposure } else { self.back_exposure - 0.5 * self.exposure };
        if stops != 0.0 {
            let gain = stops.exp2();
            color.iter_mut().for_each(|v| *v = (f32::from(*v) * gain).round().min(255.0) as u8);
        }
        let mut random = random::stream(&format!("photograph/{name}/{index}"));
        let plain = self.background.map(|background| background.map(|v| 255.0 * v));
        let scene = self.scene.map(|scene| behind(scene, &color, &mask, &mut random));
        if self.has_background() {
            for (x, y, pixel) in color.enumerate_pixels_mut() {
                let share = f32::from(mask.get_pixel(x, y).0[0]) / 255.0;
                let other = scene.as_ref().map(|scene| scene.get_pixel(x, y).0.map(f32::from));
                let other = other.or(plain).expect("one of them is there");
                let mixed = |c: usize| share * f32::from(pixel.0[c]) + (1.0 - share) * other[c];
                pixel.0 = [0, 1, 2].map(|c| mixed(c).round() as u8);
            }
        }
        if self.camera {
            color = photographed(&color, &mut random);
        }
        let reach = self.mask * mask.width() as f32 / REFERENCE_SIDE;
        if reach != 0.0 {
            mask = moved(&mask, reach);
        }
        if let Some(person) = Rect::around(&mask, 1).filter(|_| self.cut > 0.0) {
            let cut = (self.cut * person.width as f32).round() as u32;
            let from = if index == 0 { person.x } else { person.x + person.width - cut };
            for (x, _, pixel) in mask.enumerate_pixels_mut() {
                if (from..from + cut).contains(&x) {
                    pixel.0 = [0];
                }
            }
        }
        (color, mask)
    }
}

/// Gives all pixels the mean colour of the pixels in the mask.
fn flatten(color: &mut RgbImage, mask: &GrayImage) {
    let (mut sum, mut weight) = ([0.0_f64; 3], 0.0);
    for (pixel, share) in color.pixels().zip(mask.pixels()) {
        let share = f64::from(share.0[0]);
        (0..3).for_each(|c| sum[c] += share * f64::from(pixel.0[c]));
        weight += share;
    }
    if weight > 0.0 {
        let mean = sum.map(|sum| (sum / weight).round() as u8);
        color.pixels_mut().for_each(|pixel| pixel.0 = mean);
    }
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;

    #[test]
    fn backgrounds_show_in_masks_that_are_too_large() {
        let color = RgbImage::from_pixel(1024, 1, Rgb([100, 0, 40]));
        let mask = GrayImage::from_fn(1024, 1, |x, _| Luma([[255, 51, 0][(x as usize).min(2)]]));
        let changes = PhotographChanges {
            background: Some([0.0, 1.0, 0.5]),
            mask: 2.0,
            ..PhotographChanges::default()
        };
        assert_eq!(changes.problem(), None);
        let (mixed, grown) = changes.apply("person", 0, color, mask);
        let pixels: Vec<[u8; 3]> = mixed.pixels().take(3).map(|pixel| pixel.0).collect();
        // A fifth of the second pixel is the person's.
        assert_eq!(pixels, [[100, 0, 40], [20, 204, 110], [0, 255, 128]]);
        assert_eq!(grown.get_pixel(2, 0).0, [255]);
        let wrong = PhotographChanges { background: Some([0.0, 1.5, 0.5]), ..changes };
        assert!(wrong.problem().is_some_and(|(key, message)| key == "background" && message.contains("1.5")));
    }

    #[test]
    fn the_road_of_a_user_has_no_masks_to_change() {
        let user = PhotographChanges { road: Road::User, ..PhotographChanges::default() };
        assert_eq!(user.problem(), None);
        let key = |changes: PhotographChanges| changes.problem().expect("refused").0;
        assert_eq!(key(PhotographChanges { mask: 3.0, ..user }), "mask");
        assert_eq!(key(PhotographChanges { cut: 0.1, ..user }), "cut");
        let both = PhotographChanges { scene: Some(Scene::Wall), background: Some([1.0; 3]), ..user };
        assert_eq!(key(both), "scene");
    }

    #[test]
    fn a_grey_person_has_the_mean_colour_of_its_pixels_alone() {
        let color = RgbImage::from_fn(4, 1, |x, _| {
            Rgb([[100, 0, 40], [200, 0, 80], [255, 255, 255], [9, 9, 9]][x as usize])
        });
        let mask = GrayImage::from_fn(4, 1, |x, _| Luma([if x < 2 { 255 } else { 0 }]));
        let grey = PhotographChanges { grey: true, ..PhotographChanges::default() };
        let (flat, same) = grey.apply("person", 0, color, mask.clone());
        assert_eq!(same, mask);
        assert!(flat.pixels().all(|pixel| pixel.0 == [150, 0, 60]), "{flat:?}");
    }
}
