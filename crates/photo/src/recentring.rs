//! Turns a photograph towards its person: the view of a camera in the same place that looks at the person's middle
//! (docs/method.md, "Cameras of a user").

use glam::{DMat3, DVec2, DVec3};
use image::{GrayImage, Luma, Rgb, RgbImage};
use rayon::prelude::*;

use crate::exif_camera::{ELEVATIONS, Shot, pixels};
use crate::rect::Rect;

/// Angle in degrees between the optical axis and the person's middle up to which a photograph stays as it is.
const LEAST: f64 = 2.0;
/// Angle in degrees beyond which focal length and place of the person contradict each other.
const MOST: f64 = 45.0;

/// A turn of a camera about its centre. Both pictures have the same size, and their optical axes in their middles.
pub(super) struct Turn {
    /// From the turned camera's axes (x right, y down, z forward) to the photograph's.
    rotation: DMat3,
    /// Focal lengths of the photograph and of the turned picture, in pixels.
    focals: [f64; 2],
    size: DVec2,
    /// To the right and down, in degrees.
    pub angles: [f64; 2],
    /// The turned camera.
    pub shot: Shot,
}

impl Turn {
    /// The turn towards the middle of the box `person` in a photograph of size `picture`. A camera without roll has
    /// none after the turn. `None` for an unknown focal length, and for a person in the middle or too far from it.
    pub fn towards(person: Rect, picture: [u32; 2], shot: Shot) -> Option<Self> {
        let focal = pixels(shot.focal?, picture);
        let size = DVec2::from(picture.map(f64::from));
        let corner = DVec2::new(f64::from(person.x), f64::from(person.y));
        let extent = DVec2::new(f64::from(person.width), f64::from(person.height));
        let ray = |place: DVec2| ((place - 0.5 * size) / focal).extend(1.0);
        let forward = ray(corner + 0.5 * extent).normalize();
        if !(LEAST..=MOST).contains(&forward.z.acos().to_degrees()) {
            return None;
        }
        // Other pitches are implausible for a standing person.
        let pitch = shot.pitch.filter(|pitch| ELEVATIONS.contains(pitch)).unwrap_or(0.0).to_radians();
        let up = DVec3::new(0.0, -pitch.cos(), -pitch.sin());
        let right = forward.cross(up).normalize();
        let rotation = DMat3::from_cols(right, forward.cross(right), forward);
        // The person stays inside of the picture.
        let corners = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)];
        let reach = |(x, y)| {
            let seen = rotation.transpose() * ray(corner + DVec2::new(x, y) * extent);
            2.0 * focal * (seen.truncate() / seen.z).abs() / size
        };
        let reach = corners.map(reach).into_iter().fold(DVec2::ONE, DVec2::max).max_element();
        let angle = |a: f64| a.atan2(forward.z).to_degrees();
        let pitch = shot.pitch.map(|_| (-forward.dot(up)).asin().to_degrees());
        Some(Self {
            rotation,
            focals: [focal, focal / reach],
            size,
            angles: [angle(forward.x), angle(forward.y)],
            shot: Shot { focal: shot.focal.map(|focal| focal / reach), pitch },
        })
    }

    /// The turned picture and its mask, sampled bilinearly. Colours are weighted by the mask.
    pub fn apply(&self, rgb: &RgbImage, mask: &GrayImage) -> (RgbImage, GrayImage) {
        let (width, height) = rgb.dimensions();
        let [from, to] = self.focals;
        let (mut turned, mut turned_mask) = (RgbImage::new(width, height), GrayImage::new(width, height));
        let rows = turned.par_chunks_mut(3 * width as usize).zip(turned_mask.par_chunks_mut(width as usize));
        rows.enumerate().for_each(|(y, (colors, shares))| {
            for (x, (color, share)) in colors.chunks_exact_mut(3).zip(shares).enumerate() {
                let place = DVec2::new(x as f64, y as f64) + 0.5 - 0.5 * self.size;
                let ray = self.rotation * (place / to).extend(1.0);
                if ray.z <= 0.0 {
                    continue;
                }
                let place = from * ray.truncate() / ray.z + 0.5 * self.size - 0.5;
                if let Some((Rgb(there), Luma([m]))) = sample(rgb, mask, place) {
                    color.copy_from_slice(&there);
                    *share = m;
                }
            }
        });
        (turned, turned_mask)
    }
}

/// The colour and the mask at a place, where the first pixel's centre is (0, 0). `None` where the mask is 0.
fn sample(rgb: &RgbImage, mask: &GrayImage, place: DVec2) -> Option<(Rgb<u8>, Luma<u8>)> {
    let corner = place.floor();
    let part = place - corner;
    let (mut sum, mut total) = ([0.0; 3], 0.0);
    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
        let (x, y) = (corner.x + dx, corner.y + dy);
        if x < 0.0 || y < 0.0 || x >= f64::from(rgb.width()) || y >= f64::from(rgb.height()) {
            continue;
        }
        let weight = (1.0 - (part.x - dx).abs()) * (1.0 - (part.y - dy).abs());
        let share = weight * f64::from(mask.get_pixel(x as u32, y as u32)[0]);
        let color = rgb.get_pixel(x as u32, y as u32);
        (0..3).for_each(|c| sum[c] += share * f64::from(color[c]));
        total += share;
    }
    (total > 0.0).then(|| (Rgb(sum.map(|v| (v / total).round() as u8)), Luma([total.round() as u8])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A white ball on black in the direction `towards` of a camera of 26 mm, of 40 pixels in the middle.
    fn ball(picture: [u32; 2], towards: DVec3) -> (RgbImage, GrayImage) {
        let focal = pixels(26.0, picture);
        let is_inside = |x: u32, y: u32| {
            let place = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)
                - 0.5 * DVec2::from(picture.map(f64::from));
            (place / focal).extend(1.0).normalize().dot(towards.normalize()) > (40.0 / focal).atan().cos()
        };
        let mask = GrayImage::from_fn(picture[0], picture[1], |x, y| Luma([255 * u8::from(is_inside(x, y))]));
        let rgb = RgbImage::from_fn(picture[0], picture[1], |x, y| Rgb([mask.get_pixel(x, y)[0], 9, 200]));
        (rgb, mask)
    }

    #[test]
    fn a_ball_beside_the_middle_is_round_in_a_turned_picture() {
        let picture = [600, 400];
        for (towards, pitch) in [(DVec3::new(0.5, 0.0, 1.0), None), (DVec3::new(-0.45, 0.1, 1.0), Some(5.0))]
        {
            let (rgb, mask) = ball(picture, towards);
            let before = Rect::around(&mask, 128).expect("a ball");
            let wide =
                f64::from(before.width.max(before.height)) / f64::from(before.width.min(before.height));
            assert!(wide > 1.05, "{before:?}");
            let shot = Shot { focal: Some(26.0), pitch };
            let turn = Turn::towards(before, picture, shot).expect("is beside the middle");
            let (turned, turned_mask) = turn.apply(&rgb, &mask);
            let after = Rect::around(&turned_mask, 128).expect("a ball");
            assert!(after.width.abs_diff(80) <= 1 && after.height.abs_diff(80) <= 1, "{after:?}");
            // The middle of the box of an ellipse is a little beside the ball's middle.
            let middle = [after.x + after.width / 2, after.y + after.height / 2];
            assert!(middle[0].abs_diff(300) <= 6 && middle[1].abs_diff(200) <= 6, "{after:?}");
            // The background's black does not enter the rim.
            let rim = turned.pixels().zip(turned_mask.pixels()).filter(|(_, m)| m[0] > 0);
            assert!(rim.clone().count() > 1000 && rim.into_iter().all(|(color, _)| color.0 == [255, 9, 200]));
            // The camera looks where the ball is.
            let down = (towards.y * (pitch.unwrap_or(0.0_f64).to_radians()).cos()
                + pitch.unwrap_or(0.0).to_radians().sin())
                / towards.length();
            match turn.shot.pitch {
                Some(found) => assert!((found - down.asin().to_degrees()).abs() < 1.0, "{found} {down}"),
                None => assert_eq!(pitch, None),
            }
        }
    }

    #[test]
    fn people_in_the_middle_and_unknown_lenses_stay() {
        let shot = Shot { focal: Some(26.0), pitch: None };
        let person = Rect { x: 190, y: 20, width: 200, height: 350 };
        assert!(Turn::towards(person, [600, 400], shot).is_none());
        let aside = Rect { x: 400, ..person };
        assert!(Turn::towards(aside, [600, 400], Shot::default()).is_none());
        // A camera that looks straight down tells no upright direction: no roll.
        let down = Turn::towards(aside, [600, 400], Shot { pitch: Some(85.0), ..shot })
            .expect("is beside the middle");
        assert!(down.rotation.row(1).x.abs() < 1e-9, "{}", down.rotation);
        // A person of the whole height stays inside.
        let tall = Rect { x: 300, y: 0, width: 300, height: 400 };
        let turn = Turn::towards(tall, [600, 400], shot).expect("is beside the middle");
        let full = GrayImage::from_fn(600, 400, |x, _| Luma([255 * u8::from(x >= 300)]));
        let (_, mask) = turn.apply(&RgbImage::new(600, 400), &full);
        let seen = Rect::around(&mask, 1).expect("a person");
        assert!(seen.x > 0 && seen.x + seen.width < 600 && seen.height <= 400, "{seen:?}");
        assert!(turn.shot.focal.is_some_and(|focal| focal <= 26.0));
    }
}
