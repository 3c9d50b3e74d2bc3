//! Places photographs on canvases: unchanged, as the published demo does, or at the training subjects' size and place.

use glam::DVec2;
use image::{GenericImageView, GrayImage, RgbImage, imageops};

use snapsnap_net::Photograph;

use super::unit;
use crate::rect::Rect;
use crate::report::{Canvas, Place};
use crate::resize::{bilinear, lanczos3};

/// Side of the canvas to which constant heights and rows refer, in pixels.
const REFERENCE_SIDE: f32 = 1024.0;
/// Middle row of a training subject on a canvas of 1024. The subject covers rows 124.39 to 862.52
/// (docs/method.md, "Cameras").
const TRAINING_CENTRE: f32 = 493.5;

/// Map from a photograph's pixels to a canvas, both with pixel centres at +½.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mapping {
    /// Canvas pixels per pixel of the photograph, across and down.
    pub scale: DVec2,
    /// Place of the photograph's origin on the canvas.
    pub origin: DVec2,
}

impl Mapping {
    /// The map of a photograph that is the canvas.
    pub const AS_IT_IS: Self = Self { scale: DVec2::ONE, origin: DVec2::ZERO };

    /// The map of the box `person` to the place `left`, `top` and this size.
    pub(crate) fn of(person: Rect, [left, top]: [usize; 2], [width, height]: [usize; 2]) -> Self {
        let size = |width: u32, height: u32| DVec2::new(f64::from(width), f64::from(height));
        let scale = DVec2::new(width as f64, height as f64) / size(person.width, person.height);
        Self { scale, origin: DVec2::new(left as f64, top as f64) - size(person.x, person.y) * scale }
    }

    /// The place on the photograph of a place on the canvas.
    pub fn source(&self, canvas: DVec2) -> DVec2 {
        (canvas - self.origin) / self.scale
    }

    /// The map from the canvas to the photograph.
    pub fn inverse(&self) -> Self {
        Self { scale: 1.0 / self.scale, origin: -self.origin / self.scale }
    }
}

/// The box that is placed, and its axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing {
    pub person: Rect,
    /// Column that is placed in the middle of the canvas.
    axis: f32,
}

/// The box around the person in both photographs, if they are taken from one place: if their sizes are equal, and the
/// person's heights and columns nearly so. A person who turns on the spot has the same share left of the axis in front
/// as right of it behind.
pub(super) fn together(masks: [&GrayImage; 2], people: [Rect; 2]) -> Option<Standing> {
    /// Largest ratio of the heights. In a camera that looks down, toes reach lower than heels by up to a tenth of the
    /// height. A person also moves a little.
    const TALLER: f32 = 1.2;
    /// Largest distance of the median columns, as a share of the height. They are close to the axis in every pose of
    /// the arms.
    const ASIDE: f32 = 0.1;
    let [a, b] = people;
    let ratio = a.height as f32 / b.height as f32;
    let [front, back] = [0, 1].map(|i| median_column(masks[i], people[i]));
    let aside = front.abs_diff(back);
    let is_one = masks[0].dimensions() == masks[1].dimensions()
        && (1.0 / TALLER..=TALLER).contains(&ratio)
        && aside as f32 <= ASIDE * a.height.max(b.height) as f32;
    is_one.then(|| {
        let (x, y) = (a.x.min(b.x), a.y.min(b.y));
        let (right, bottom) = ((a.x + a.width).max(b.x + b.width), (a.y + a.height).max(b.y + b.height));
        let person = Rect { x, y, width: right - x, height: bottom - y };
        Standing { person, axis: (front + back) as f32 / 2.0 }
    })
}

/// The median column of the person in a box.
fn median_column(mask: &GrayImage, person: Rect) -> u32 {
    let inside = imageops::crop_imm(mask, person.x, person.y, person.width, person.height);
    let mut columns = vec![0_u64; person.width as usize];
    inside.pixels().for_each(|(x, _, share)| columns[x as usize] += u64::from(share[0]));
    let half = columns.iter().sum::<u64>() / 2;
    let mut sum = 0;
    let before = columns.iter().take_while(|count| {
        sum += **count;
        sum <= half
    });
    person.x + before.count() as u32
}

/// Places the box of both photographs, or of this `person`, whose axis is the middle of the box, at the size and place of
/// the training subjects, with soft edges outside the box.
pub(super) fn placed(
    rgb: &RgbImage,
    mask: &GrayImage,
    person: Rect,
    common: Option<Standing>,
    [height, side]: [usize; 2],
) -> (Photograph, Mapping, Canvas) {
    let alone = Standing { person, axis: person.x as f32 + person.width as f32 / 2.0 };
    let Standing { person, axis } = common.unwrap_or(alone);
    let canvas = side as f32;
    let by_height = height as f32 / REFERENCE_SIDE * canvas / person.height as f32;
    // A person with outstretched arms may be wider than high.
    let (before, behind) = (axis - person.x as f32, (person.x + person.width) as f32 - axis);
    let scale = by_height.min(canvas / 2.0 / before.max(behind));
    let limited_by_width = scale < by_height;
    let size = |length: u32| ((length as f32 * scale).round() as usize).clamp(1, side);
    let (width, height) = (size(person.width), size(person.height));
    let left = ((canvas / 2.0 - before * scale - 0.5).ceil().max(0.0) as usize).min(side - width);
    let centre = TRAINING_CENTRE / REFERENCE_SIDE * canvas;
    let top = ((centre - height as f32 / 2.0).round().max(0.0) as usize).min(side - height);
    let mapping = Mapping::of(person, [left, top], [width, height]);

    // The box of all pixels with any coverage, cut to the reach of the canvas, and its place relative to the person's
    // box. Without the cut a distant speck would be enlarged with a small person.
    let (sx, sy) = (width as f32 / person.width as f32, height as f32 / person.height as f32);
    let reach = |scale: f32| (canvas / scale).ceil() as u32;
    let touched = Rect::around(mask, 1).expect("the person's box is not empty");
    let touched = touched.clipped_around(person, [reach(sx), reach(sy)]);
    let target = |length: u32, scale: f32| ((length as f32 * scale).round() as usize).max(1);
    let (wide, high) = (target(touched.width, sx), target(touched.height, sy));
    let apart = |a: u32, b: u32, scale: f32| ((i64::from(a) - i64::from(b)) as f32 * scale).round() as i64;
    let x0 = left as i64 - apart(person.x, touched.x, sx);
    let y0 = top as i64 - apart(person.y, touched.y, sy);

    // Colours are resized after multiplication by the mask, so that the background does not bleed into them.
    let premultiplied = |color, m| unit(color) * unit(m);
    let mut planes = planes(rgb, mask, touched, premultiplied, [high, wide], lanczos3);
    // Lanczos overshoots at edges.
    planes[3].iter_mut().for_each(|share| *share = share.clamp(0.0, 1.0));
    let color = |value: f32, share: f32| 2.0 * value.clamp(0.0, share) - share;
    let (values, on_canvas) = pasted(&planes, [high, wide], [y0, x0], side, color);
    let place = Place { size: [width, height], at: [left, top], side };
    let canvas = Canvas::Scaled { together: common.is_some(), scale, limited_by_width, place };
    (Photograph::new(values, on_canvas), mapping, canvas)
}

/// The picture without a resize (docs/method.md, "Photographs on the canvas").
pub fn on_canvas(rgb: &RgbImage, mask: &GrayImage) -> Photograph {
    let mask: Vec<f32> = mask.pixels().map(|p| unit(p[0])).collect();
    let area = mask.len();
    let mut values = vec![0.0; 3 * area];
    for (i, pixel) in rgb.pixels().enumerate() {
        for c in 0..3 {
            values[c * area + i] = (2.0 * unit(pixel[c]) - 1.0) * mask[i];
        }
    }
    Photograph::new(values, mask)
}

/// The placement of the published demo with its quirks. The box loses its last row and column, sampling is bilinear,
/// colours are cut at half coverage instead of multiplied by it, and only pixels with a full mask are valid.
pub(super) fn placed_as_demo(
    rgb: &RgbImage,
    mask: &GrayImage,
    person: Rect,
    [height, side]: [usize; 2],
) -> (Photograph, Mapping, Canvas) {
    let person = Rect { width: (person.width - 1).max(1), height: (person.height - 1).max(1), ..person };
    let height = ((height as f32 / REFERENCE_SIDE * side as f32).round() as usize).clamp(1, side);
    let scaled = person.width as usize * height / person.height as usize;
    // The demo fails on a person wider than its canvas. Here the person gets smaller.
    let height =
        if scaled > side { (person.height as usize * side / person.width as usize).max(1) } else { height };
    let width = (scaled / 2 * 2).clamp(2.min(side), side / 2 * 2);
    let (left, top) = ((side - width) / 2, (side - height) / 2);
    let mapping = Mapping::of(person, [left, top], [width, height]);
    let planes = planes(rgb, mask, person, |color, _| unit(color), [height, width], bilinear);
    let color = |value, share| if share >= Photograph::LEAST { 2.0 * value - 1.0 } else { 0.0 };
    let place = [top as i64, left as i64];
    let (values, on_canvas) = pasted(&planes, [height, width], place, side, color);
    let valid = on_canvas.iter().map(|m| *m >= 1.0).collect();
    let canvas = Canvas::Demo(Place { size: [width, height], at: [left, top], side });
    (Photograph { rgb: values, mask: on_canvas, valid }, mapping, canvas)
}

/// Red, green, blue and mask of the person's box, resized to `size` (rows, columns). `color` converts a colour and the
/// mask's value. Planes are made one by one, since a plane in f32 takes as much memory as the picture.
fn planes(
    rgb: &RgbImage,
    mask: &GrayImage,
    person: Rect,
    color: impl Fn(u8, u8) -> f32,
    size: [usize; 2],
    resize: fn(Vec<f32>, [usize; 2], [usize; 2]) -> Vec<f32>,
) -> [Vec<f32>; 4] {
    std::array::from_fn(|channel| {
        let rows = person.y..person.y + person.height;
        let places = rows.flat_map(|y| (person.x..person.x + person.width).map(move |x| (x, y)));
        let value = |(x, y)| {
            let m = mask.get_pixel(x, y)[0];
            if channel == 3 { unit(m) } else { color(rgb.get_pixel(x, y)[channel], m) }
        };
        resize(places.map(value).collect(), [person.height as usize, person.width as usize], size)
    })
}

/// Colours `[3, S, S]` and mask `[S, S]` of an empty canvas of `side`² pixels, onto which `planes` of `size` (rows,
/// columns) are pasted from the row and the column `place` on. `color` makes a colour of its value and its mask.
fn pasted(
    [r, g, b, m]: &[Vec<f32>; 4],
    [high, wide]: [usize; 2],
    [y0, x0]: [i64; 2],
    side: usize,
    color: impl Fn(f32, f32) -> f32,
) -> (Vec<f32>, Vec<f32>) {
    let area = side * side;
    let (mut values, mut mask) = (vec![0.0; 3 * area], vec![0.0; area]);
    for y in (0..high).filter(|y| (0..side as i64).contains(&(y0 + *y as i64))) {
        for x in (0..wide).filter(|x| (0..side as i64).contains(&(x0 + *x as i64))) {
            let from = y * wide + x;
            let to = (y0 + y as i64) as usize * side + (x0 + x as i64) as usize;
            mask[to] = m[from];
            for (c, plane) in [r, g, b].into_iter().enumerate() {
                values[c * area + to] = color(plane[from], m[from]);
            }
        }
    }
    (values, mask)
}
