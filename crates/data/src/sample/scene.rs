//! A person before a made wall or in a made room, through the faults of a camera.

use glam::Vec3;
use image::{GrayImage, RgbImage, imageops};
use rand::Rng;
use serde::{Deserialize, Serialize};
use snapsnap_photo::Rect;

use super::INSIDE;
use super::augment::compressed;

/// What is behind a person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scene {
    /// A wall in the mean colour of the upper half of the person.
    Wall,
    /// A wall with a floor, full of boxes in colours of their own, in focus.
    Room,
}

/// Boxes of a room.
const BOXES: usize = 60;
/// Largest change of the brightness across a wall, as a share.
const SHADE: f32 = 0.25;
/// Standard deviation of a camera's point-spread function in pixels of 1024.
const SPREAD: f32 = 0.8;
/// Share of the difference from a blurred picture that sharpening adds, and that blur's standard deviation in pixels of
/// 1024. It leaves halos along outlines.
const SHARPENED: (f32, f32) = (0.5, 1.6);
/// Largest noise of a channel, of 255.
const NOISE: f32 = 4.0;
/// JPEG quality of a telephone.
const QUALITY: u8 = 85;

/// The colours behind a person's picture.
pub(super) fn behind(scene: Scene, color: &RgbImage, mask: &GrayImage, random: &mut impl Rng) -> RgbImage {
    let (width, height) = color.dimensions();
    let way: [f32; 2] = [(); 2].map(|()| random.random_range(-1.0..1.0));
    let lit = |base: Vec3, x: u32, y: u32| {
        let along = [(x, width), (y, height)].map(|(at, length)| at as f32 / length as f32 - 0.5);
        base * (1.0 + SHADE * (along[0] * way[0] + along[1] * way[1]))
    };
    let mut hue = || Vec3::new(random.random(), random.random(), random.random());
    let base = match scene {
        Scene::Wall => upper_mean(color, mask),
        Scene::Room => 0.3 + 0.7 * hue(),
    };
    let mut picture = RgbImage::from_fn(width, height, |x, y| bytes(lit(base, x, y)));
    if scene == Scene::Room {
        let floor = 0.6 * hue();
        for y in height * 4 / 5..height {
            (0..width).for_each(|x| picture.put_pixel(x, y, bytes(lit(floor, x, y))));
        }
        for _ in 0..BOXES {
            let corner = [width, height].map(|side| random.random_range(0..side));
            let size = [width, height].map(|side| random.random_range(side / 50..side / 5 + 2));
            let own = Vec3::new(random.random(), random.random(), random.random());
            for y in corner[1]..(corner[1] + size[1]).min(height) {
                (corner[0]..(corner[0] + size[0]).min(width))
                    .for_each(|x| picture.put_pixel(x, y, bytes(lit(own, x, y))));
            }
        }
    }
    picture
}

/// The picture of a camera: point spread, sharpening, noise and JPEG.
pub(super) fn photographed(color: &RgbImage, random: &mut impl Rng) -> RgbImage {
    let unit = color.width() as f32 / 1024.0;
    let seen = imageops::blur(color, SPREAD * unit);
    let soft = imageops::blur(&seen, SHARPENED.1 * unit);
    let mut sharp = seen;
    for (value, soft) in sharp.iter_mut().zip(soft.iter()) {
        let (own, soft) = (f32::from(*value), f32::from(*soft));
        let noise = random.random_range(-NOISE..NOISE);
        *value = (own + SHARPENED.0 * (own - soft) + noise).round().clamp(0.0, 255.0) as u8;
    }
    compressed(sharp, QUALITY)
}

fn bytes(color: Vec3) -> image::Rgb<u8> {
    image::Rgb((255.0 * color.clamp(Vec3::ZERO, Vec3::ONE)).round().to_array().map(|v| v as u8))
}

/// Mean colour, in [0, 1], of the person's pixels in the upper half of its rows; grey without one.
fn upper_mean(color: &RgbImage, mask: &GrayImage) -> Vec3 {
    let Some(person) = Rect::around(mask, INSIDE) else { return Vec3::splat(0.5) };
    let middle = person.y + (person.height - 1) / 2;
    let upper = mask.enumerate_pixels().filter(|(_, y, share)| share[0] >= INSIDE && *y <= middle);
    let (sum, count) = upper.fold((Vec3::ZERO, 0.0), |(sum, count), (x, y, _)| {
        (sum + Vec3::from(color.get_pixel(x, y).0.map(f32::from)), count + 1.0)
    });
    sum / (255.0 * count)
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};
    use snapsnap_base::random::stream;

    use super::*;

    #[test]
    fn walls_have_the_upper_half_s_colour_and_rooms_have_many() {
        let color = RgbImage::from_fn(64, 64, |_, y| Rgb(if y < 32 { [200, 40, 40] } else { [0, 0, 90] }));
        let mask = GrayImage::from_fn(64, 64, |x, _| Luma([if (20..40).contains(&x) { 255 } else { 0 }]));
        let scene = |scene| behind(scene, &color, &mask, &mut stream("scene"));
        let wall = scene(Scene::Wall);
        let [r, g, b] = wall.get_pixel(32, 32).0.map(f32::from);
        assert!((r - 200.0).abs() < 8.0 && (g - 40.0).abs() < 3.0 && (b - 40.0).abs() < 3.0, "{r} {g} {b}");
        let count = |picture: &RgbImage| {
            picture.pixels().map(|p| p.0).collect::<std::collections::HashSet<_>>().len()
        };
        assert!(count(&scene(Scene::Room)) > 2 * count(&wall));
        assert_eq!(scene(Scene::Room), scene(Scene::Room));
    }

    /// Beside an edge, a camera's picture is a mixture; farther away there is a halo; elsewhere noise alone.
    #[test]
    fn cameras_mix_colours_along_edges() {
        let edge = RgbImage::from_fn(1024, 64, |x, _| Rgb([if x < 512 { 60 } else { 200 }; 3]));
        let seen = photographed(&edge, &mut stream("camera"));
        let column = |x: u32| (0..64).map(|y| f32::from(seen.get_pixel(x, y)[1])).sum::<f32>() / 64.0;
        assert!((column(100) - 60.0).abs() < 2.0 && (column(900) - 200.0).abs() < 2.0);
        assert!((65.0..125.0).contains(&column(511)) && (135.0..195.0).contains(&column(512)));
        assert!(column(509) < 58.0 && column(514) > 202.0, "{} {}", column(509), column(514));
    }
}
