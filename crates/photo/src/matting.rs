//! Removes backgrounds (docs/method.md, "Background removal"): two networks find the person, a guided filter aligns
//! edges with the photograph's (He et al., "Guided Image Filtering", 2013; He and Sun, "Fast Guided Filter", 2015).

use glam::{DMat3, Mat3, Vec2, Vec3};
use image::imageops::{self, FilterType};
use image::{GrayImage, Luma, RgbImage};
use snapsnap_base::bilinear::taps;
use snapsnap_net::u2net::SIDE;

use super::look::{FindPose, Look};
use super::specks::{Pieces, pieces};
use super::unit_color;
use crate::mask_strokes::paint;
use crate::rect::Rect;
use crate::resize::{bilinear, interpolate, reduced};

/// Margin of the part in which the outline is looked for, around the person's box, as a share of the box's longer side.
const MARGIN: f32 = 0.1;
/// Probability above which a pixel counts as the person's.
const LIKELY: f32 = 0.5;
/// Distance from the person's largest piece, in pixels of [`SIDE`], beyond which no pixel belongs to the person.
const NEAR: usize = 6;
/// Width of the band on either side of the pose network's outline in which the other network may decide, in pixels of
/// the pose network.
const BAND: f32 = 8.0;
/// Probability of the pose network from which a pixel behind the band is the person's. Gaps beside arms have less.
const SURE: f32 = 0.99;
/// Probabilities of the pose network up to which a pixel shows the surroundings, and from which on it shows the person,
/// when the other network is judged by them.
const JUDGED: (f32, f32) = (0.1, 0.9);
/// Radius within which the other network is judged, in pixels of the pose network.
const COMPARED: f32 = 8.0;
/// Difference of the other network's mean probabilities for person and surroundings from which it begins to count, and
/// from which it decides alone.
const TOLD_APART: (f32, f32) = (0.6, 0.9);
/// Longest side of a cut-out. Larger pictures are reduced first, two of one size alike. Canvases have 1024 rows.
const LONGEST: u32 = 2048;
/// Longer side of the pictures on which filters are computed.
const FILTERED: u32 = 640;
/// Radius of the filters, in pixels.
const RADIUS: usize = 4;
/// Number of filters, each of the result of the filter before.
const FILTERS: usize = 3;
/// Variance below which the photograph has no edges.
const EPSILON: f32 = 1e-4;
/// Up to the first coverage, a mask's pixel is background, from the second on, person: filtered edges are soft.
const SOFT: (f32, f32) = (0.3, 0.7);

/// The signature of [`super::segmenter::segment`].
type Segment<'a> = dyn Fn(&[f32]) -> Vec<f32> + 'a;

/// A cut-out.
pub struct Matte {
    /// Colours of the picture.
    pub rgb: RgbImage,
    /// Coverage by the person.
    pub mask: GrayImage,
    /// What the pose network sees, if it sees a person.
    pub look: Option<Look>,
}

/// Cuts the person out of a picture. A picture longer than [`LONGEST`] is reduced first. The pose network says where the
/// person is, the network of salient objects where the outline runs. Without a person, the most salient object is cut
/// out. `strokes` correct the coverage. `None` if neither network finds anything.
pub fn matte(
    mut picture: RgbImage,
    segment: &Segment,
    pose: &FindPose,
    strokes: Option<&GrayImage>,
) -> Option<Matte> {
    if let Some(small) = reduced(&picture, LONGEST) {
        picture = small;
    }
    let whole = Rect { x: 0, y: 0, width: picture.width(), height: picture.height() };
    let look = Look::find(&picture, pose);
    let part = match &look {
        Some(look) => around(look.person, whole),
        None => {
            // From pixels of the network to pixels of the picture.
            let (_, Rect { x, y, width, height }) = largest(&found(&picture, whole, segment))?;
            let scale = Vec2::new(whole.width as f32, whole.height as f32) / SIDE as f32;
            let corners = [(x, y), (x + width, y + height)];
            around(corners.map(|(x, y)| scale * Vec2::new(x as f32, y as f32)), whole)
        }
    };
    // Now the person fills the picture.
    let mut probability = found(&picture, part, segment);
    if look.is_none() {
        let (is_near, _) = largest(&probability)?;
        probability.iter_mut().zip(&is_near).filter(|(_, near)| !**near).for_each(|(p, _)| *p = 0.0);
    }

    let mut mask = GrayImage::new(picture.width(), picture.height());
    let person = imageops::crop_imm(&picture, part.x, part.y, part.width, part.height).to_image();
    // Rows and columns of the pictures on which filters are computed.
    let longer = part.width.max(part.height);
    let scaled = |length: u32| (length * FILTERED.min(longer)).div_ceil(longer).max(1) as usize;
    let size = [scaled(part.height), scaled(part.width)];
    let mut probability = bilinear(probability, [SIDE; 2], size);
    if let Some(look) = &look {
        let scale = size[0] as f32 / part.height as f32 / look.scale();
        probability = combined(&probability, &look.probabilities(part, size), size[1], scale);
    }
    let (slope, offset) = filters(&person, &probability, size);
    let down = taps(size[0], part.height as usize, false);
    let across = taps(size[1], part.width as usize, false);
    for (y, down) in (part.y..).zip(&down) {
        for (x, across) in (part.x..).zip(&across) {
            let at = [*down, *across];
            let color = unit_color(picture.get_pixel(x, y));
            let share = interpolate(&slope, size[1], at).dot(color) + interpolate(&offset, size[1], at);
            mask.put_pixel(x, y, Luma([(255.0 * between(share, SOFT)).round() as u8]));
        }
    }
    if let Some(strokes) = strokes {
        paint(strokes, &mut mask);
    }
    Some(Matte { rgb: picture, mask, look })
}

/// The probabilities of both networks as one. `salient` decides the outline where it tells the person from the
/// surroundings as `pose` sees them; the outline of `pose` is coarse. `scale`: pixels per pixel of the pose network.
fn combined(salient: &[f32], pose: &[f32], width: usize, scale: f32) -> Vec<f32> {
    let local = |value: &dyn Fn(usize) -> f32, reach: f32| {
        let values: Vec<f32> = (0..pose.len()).map(value).collect();
        means(&values, width, ((reach * scale).round() as usize).max(1))
    };
    let person = |i: usize| f32::from(pose[i] > JUDGED.1);
    let surroundings = |i: usize| f32::from(pose[i] < JUDGED.0);
    let mean_of = |of: &dyn Fn(usize) -> f32, without: f32| -> Vec<f32> {
        let (areas, sums) = (local(of, COMPARED), local(&|i| of(i) * salient[i], COMPARED));
        areas.iter().zip(sums).map(|(area, sum)| if *area > 1e-3 { sum / area } else { without }).collect()
    };
    let (inside, outside) = (mean_of(&person, 1.0), mean_of(&surroundings, 0.0));
    let deep = local(&|i| f32::from(pose[i] > SURE), BAND);
    let near = local(&|i| f32::from(pose[i] > LIKELY), BAND);
    let value = |i: usize| match between(inside[i] - outside[i], TOLD_APART) {
        _ if deep[i] > 1.0 - 1e-6 => 1.0,
        _ if near[i] < 1e-6 => 0.0,
        share => share * salient[i] + (1.0 - share) * pose[i],
    };
    (0..pose.len()).map(value).collect()
}

/// The network's probabilities for a part of a picture.
fn found(picture: &RgbImage, part: Rect, segment: &Segment) -> Vec<f32> {
    let part = imageops::crop_imm(picture, part.x, part.y, part.width, part.height);
    let small = imageops::resize(&*part, SIDE as u32, SIDE as u32, FilterType::Lanczos3);
    // The network was trained on pictures with a white point of 1.
    let white = f32::from(small.as_raw().iter().copied().max().unwrap_or(0).max(1));
    let plane = |channel: usize| small.pixels().map(move |pixel| f32::from(pixel[channel]) / white);
    segment(&(0..3).flat_map(plane).collect::<Vec<f32>>())
}

/// Whether each pixel lies within [`NEAR`] of the largest piece of likely pixels, and the box of this piece.
fn largest(probability: &[f32]) -> Option<(Vec<bool>, Rect)> {
    let likely: Vec<bool> = probability.iter().map(|p| *p > LIKELY).collect();
    let Pieces { of, pieces } = pieces(&likely, SIDE as u32);
    let (row, (_, person)) = pieces.iter().enumerate().max_by_key(|(_, (size, _))| *size)?;
    let is_person: Vec<f32> = of.iter().map(|piece| f32::from(u8::from(*piece == row as u32 + 1))).collect();
    let near = means(&is_person, SIDE, NEAR);
    Some((near.iter().map(|share| *share > 1e-6).collect(), *person))
}

/// Adds the margin to a box.
fn around([low, high]: [Vec2; 2], whole: Rect) -> Rect {
    let margin = MARGIN * (high - low).max_element();
    let span = |low: f32, high: f32, most: u32| {
        let low = ((low - margin).max(0.0) as u32).min(most - 1);
        (low, ((high + margin).ceil() as u32).clamp(low + 1, most))
    };
    let ((x0, x1), (y0, y1)) = (span(low.x, high.x, whole.width), span(low.y, high.y, whole.height));
    Rect { x: x0, y: y0, width: x1 - x0, height: y1 - y0 }
}

/// The filters of a picture and its probabilities `p` at `size` (rows, columns), which are interpolated at full
/// resolution. Coverage = slope · colour + offset.
fn filters(rgb: &RgbImage, p: &[f32], [rows, columns]: [usize; 2]) -> (Vec<Vec3>, Vec<f32>) {
    let small = imageops::resize(rgb, columns as u32, rows as u32, FilterType::Triangle);
    let color: Vec<Vec3> = small.pixels().map(unit_color).collect();

    let mean = |of: &dyn Fn(usize) -> f32| means(&(0..p.len()).map(of).collect::<Vec<_>>(), columns, RADIUS);
    let mean_colors = |of: &dyn Fn(usize) -> Vec3| -> Vec<Vec3> {
        let planes: [Vec<f32>; 3] = std::array::from_fn(|c| mean(&|i| of(i)[c]));
        (0..p.len()).map(|i| Vec3::from_array(std::array::from_fn(|c| planes[c][i]))).collect()
    };
    let mean_color = mean_colors(&|i| color[i]);
    let products = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
    let products = products.map(|(a, b)| mean(&|i| color[i][a] * color[i][b]));
    // In f64: the three colours of a grey edge are nearly one.
    let inverse = |i: usize| {
        let m = mean_color[i];
        let [rr, rg, rb, gg, gb, bb] = std::array::from_fn(|k| products[k][i]);
        let covariance = Mat3::from_cols(
            Vec3::new(rr + EPSILON, rg, rb) - m * m.x,
            Vec3::new(rg, gg + EPSILON, gb) - m * m.y,
            Vec3::new(rb, gb, bb + EPSILON) - m * m.z,
        );
        covariance.as_dmat3().inverse()
    };
    let inverses: Vec<DMat3> = (0..p.len()).map(inverse).collect();
    let fitted = |p: &[f32]| {
        let mean_of_p = mean(&|i| p[i]);
        let mean_of_both = mean_colors(&|i| color[i] * p[i]);
        let line = |i: usize| {
            let m = mean_color[i];
            let slope = (inverses[i] * (mean_of_both[i] - m * mean_of_p[i]).as_dvec3()).as_vec3();
            (slope, mean_of_p[i] - slope.dot(m))
        };
        let (slope, offset): (Vec<Vec3>, Vec<f32>) = (0..p.len()).map(line).unzip();
        (mean_colors(&|i| slope[i]), mean(&|i| offset[i]))
    };
    let (mut slope, mut offset) = fitted(p);
    for _ in 1..FILTERS {
        let share = |i: usize| between(slope[i].dot(color[i]) + offset[i], SOFT);
        (slope, offset) = fitted(&(0..p.len()).map(share).collect::<Vec<_>>());
    }
    (slope, offset)
}

/// The share of the way from the first limit to the second.
fn between(alpha: f32, (low, high): (f32, f32)) -> f32 {
    ((alpha - low) / (high - low)).clamp(0.0, 1.0)
}

/// Means over the squares of pixels within `radius`, as far as they are in the picture.
fn means(values: &[f32], width: usize, radius: usize) -> Vec<f32> {
    let height = values.len() / width;
    let line = |length: usize, read: &dyn Fn(usize) -> f64, write: &mut dyn FnMut(usize, f64)| {
        let (mut sum, mut count) = (0.0, 0);
        for at in 0..length + radius {
            if at < length {
                (sum, count) = (sum + read(at), count + 1);
            }
            if at > 2 * radius {
                (sum, count) = (sum - read(at - 2 * radius - 1), count - 1);
            }
            if at >= radius {
                write(at - radius, sum / f64::from(count));
            }
        }
    };
    let mut rows = vec![0.0; values.len()];
    for y in 0..height {
        let row = &values[y * width..][..width];
        line(width, &|x| f64::from(row[x]), &mut |x, mean| rows[y * width + x] = mean);
    }
    let mut out = vec![0.0; values.len()];
    for x in 0..width {
        line(height, &|y| rows[y * width + x], &mut |y, mean| out[y * width + x] = mean as f32);
    }
    out
}

#[cfg(test)]
mod tests {
    use image::Rgb;
    use snapsnap_net::blazepose::Pose;

    use super::*;

    const PERSON: [u8; 3] = [200, 60, 40];
    const WALL: [u8; 3] = [60, 120, 160];

    /// A person of 100 × 300 units in a picture of 300 × 400, with a dark spot on the chest. A unit is `scale` pixels.
    /// The pixels along the left edge are half wall.
    fn photograph(scale: u32) -> RgbImage {
        RgbImage::from_fn(300 * scale, 400 * scale, |x, y| {
            let is_tall = (50 * scale..350 * scale).contains(&y);
            let is_spot = (145..155).contains(&(x / scale)) && (100..110).contains(&(y / scale));
            match x / scale {
                _ if x == 100 * scale && is_tall => Rgb(std::array::from_fn(|c| PERSON[c].midpoint(WALL[c]))),
                100..200 if is_tall && is_spot => Rgb([30, 30, 30]),
                100..200 if is_tall => Rgb(PERSON),
                _ => Rgb(WALL),
            }
        })
    }

    /// A network that finds reddish pixels, blurred, and is unsure about the grey spot.
    fn network(rgb: &[f32]) -> Vec<f32> {
        let (red, blue) = (&rgb[..SIDE * SIDE], &rgb[2 * SIDE * SIDE..]);
        let of = |(red, blue): (&f32, &f32)| {
            if red > blue { 1.0 } else { f32::from((red - blue).abs() < 0.02) * 0.4 }
        };
        means(&red.iter().zip(blue).map(of).collect::<Vec<f32>>(), SIDE, 3)
    }

    fn cut(picture: RgbImage, segment: &Segment, pose: &FindPose) -> Option<(RgbImage, GrayImage)> {
        matte(picture, segment, pose, None).map(|Matte { rgb, mask, .. }| (rgb, mask))
    }

    /// A pose network that sees the same, coarsely and sure of the spot, or nobody.
    fn pose(rgb: &[f32]) -> Pose {
        let (red, blue) = (&rgb[..256 * 256], &rgb[2 * 256 * 256..]);
        let of = |(red, blue): (&f32, &f32)| f32::from(*red > 0.0 && red + 0.1 > *blue);
        let mask = means(&red.iter().zip(blue).map(of).collect::<Vec<f32>>(), 256, 2);
        Pose { landmarks: vec![[128.0; 5]; 39], presence: 1.0, mask }
    }

    fn nobody(_: &[f32]) -> Pose {
        Pose { landmarks: vec![[0.0; 5]; 39], presence: 0.0, mask: vec![0.0; 256 * 256] }
    }

    #[test]
    fn outlines_follow_the_photograph() {
        let (rgb, mask) = cut(photograph(2), &network, &pose).expect("a person");
        assert!(rgb == photograph(2), "colours stay");
        let is_person = |x: u32, y: u32| (200..400).contains(&x) && (100..700).contains(&y);
        let wrong = mask.enumerate_pixels().filter(|(x, y, value)| {
            let mixed = *x == 200;
            !mixed && (value[0] >= 128) != is_person(*x, *y)
        });
        // Corners are rounder than the photograph's.
        let wrong = wrong.count();
        assert!(wrong < 40, "{wrong} pixels");
        assert_eq!(mask.get_pixel(300, 210)[0], 255, "the spot is no gap");
    }

    #[test]
    fn large_pictures_are_reduced_and_nobody_is_nobody() {
        // 3600 × 4800 pixels.
        let (rgb, mask) = cut(photograph(12), &network, &pose).expect("a person");
        assert_eq!((rgb.dimensions(), mask.dimensions()), ((1536, 2048), (1536, 2048)));
        let rows = mask.rows().filter(|row| row.clone().any(|value| value[0] > 127)).count() as f32;
        assert!((rows / 2048.0 - 0.75).abs() < 0.01, "{rows}");
        let line = RgbImage::from_fn(2, 70_000, |_, y| {
            Rgb(if (9_000..60_000).contains(&y) { PERSON } else { WALL })
        });
        assert_eq!(cut(line, &network, &nobody).expect("a person").1.dimensions(), (1, 2048));
        assert!(cut(RgbImage::from_pixel(90, 80, Rgb(WALL)), &network, &nobody).is_none());
        assert!(cut(RgbImage::new(1, 1), &|_| vec![0.0; SIDE * SIDE], &nobody).is_none());
        // Everything is the person.
        let (_, mask) = cut(RgbImage::from_pixel(70, 64, Rgb(PERSON)), &network, &nobody).expect("a person");
        assert!(mask.pixels().all(|value| value[0] == 255));
    }

    /// The salient network misses the left half of the person and finds a block beside it.
    #[test]
    fn the_pose_network_says_where_the_person_is() {
        let wrong = |rgb: &[f32]| -> Vec<f32> {
            let found = network(rgb);
            let right = |i: usize| found[i].max(f32::from(u8::from(i % SIDE > SIDE - 20)));
            (0..SIDE * SIDE).map(|i| if i % SIDE < SIDE / 2 { 0.0 } else { right(i) }).collect()
        };
        let (_, mask) = cut(photograph(2), &wrong, &pose).expect("a person");
        let is_person = |x: u32, y: u32| (200..400).contains(&x) && (100..700).contains(&y);
        let far = |x: u32, y: u32| {
            x.abs_diff(200).min(x.abs_diff(400)).min(y.abs_diff(100)).min(y.abs_diff(700)) > 8
        };
        let wrong = mask
            .enumerate_pixels()
            .filter(|(x, y, value)| far(*x, *y) && (value[0] >= 128) != is_person(*x, *y));
        assert_eq!(wrong.count(), 0);
    }

    #[test]
    fn means_are_those_of_the_pixels_in_the_picture() {
        let values = [1.0, 2.0, 6.0, 3.0, 4.0, 8.0];
        assert_eq!(means(&values, 3, 1), [2.5, 4.0, 5.0, 2.5, 4.0, 5.0]);
        assert_eq!(means(&values, 3, 9), [4.0; 6]);
        assert_eq!(means(&[7.0], 1, 4), [7.0]);
    }
}
