//! Pictures for comparisons: red, green and blue planes in [0, 1]. Each kind of source has one checked constructor, so
//! that wrong ranges and orders of colours are errors.

use burn::tensor::{Device, Tensor, TensorData};
use image::{DynamicImage, RgbImage};
use rayon::prelude::*;

use crate::preview::picture;
use crate::region::Region;
use crate::{EvalError, Result};

/// One picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// `[3, H, W]` in [0, 1].
    values: Vec<f32>,
}

impl Picture {
    /// Red, green and blue planes `[3, H, W]`; `what` names them in errors.
    ///
    /// # Errors
    /// [`EvalError::Message`] for a value that is not finite or not in [0, 1].
    ///
    /// # Panics
    /// If the number of values does not fit the size.
    pub fn new(values: Vec<f32>, [height, width]: [usize; 2], what: &'static str) -> Result<Self> {
        assert_eq!(values.len(), 3 * height * width, "planes of {width}×{height}");
        if let Some(at) = values.iter().position(|v| !(0.0..=1.0).contains(v)) {
            let (row, column) = (at / width % height, at % width);
            let (channel, value) = (at / (height * width), values[at]);
            let place = format!("channel {channel}, row {row}, column {column} of the {what}");
            return Err(EvalError::new(format!("value {value} at {place}: must be 0 to 1")));
        }
        Ok(Self { width, height, values })
    }

    /// A render `[H, W, 3]`, clamped to [0, 1] and shrunk by `times`: each pixel is the mean of `times`² pixels.
    ///
    /// # Errors
    /// [`EvalError::Message`] for a value that is not finite.
    ///
    /// # Panics
    /// If the number of values does not fit the size, or if the size is no multiple of `times`.
    pub fn rendered(values: &[f32], [height, width]: [usize; 2], times: usize) -> Result<Self> {
        assert_eq!(values.len(), 3 * height * width, "pixels of {width}×{height}");
        assert!(height % times == 0 && width % times == 0, "{width}×{height} in parts of {times}");
        let cut = |v: f32| if v.is_finite() { v.clamp(0.0, 1.0) } else { v };
        let (pixels, _) = values.as_chunks::<3>();
        let size @ [rows, columns] = [height / times, width / times];
        let mut planes = vec![0.0; 3 * rows * columns];
        planes.par_chunks_mut(columns).enumerate().for_each(|(line, means)| {
            let (channel, row) = (line / rows, line % rows);
            for (column, mean) in means.iter_mut().enumerate() {
                let parts = (0..times).map(|part| (row * times + part) * width + column * times);
                let pixels = parts.flat_map(|start| &pixels[start..start + times]);
                let sum = pixels.fold(0.0, |sum, pixel| sum + cut(pixel[channel]));
                // Rounding can move the mean of ones beyond 1.
                *mean = if sum.is_nan() { sum } else { (sum / (times * times) as f32).min(1.0) };
            }
        });
        Self::new(planes, size, "render")
    }

    /// The picture of a decoded file. Alpha is blended over black, the background of the protocols.
    ///
    /// # Errors
    /// [`EvalError::Message`] for files of floating-point numbers with other values.
    pub fn from_file(picture: DynamicImage, what: &'static str) -> Result<Self> {
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        // Without alpha every pixel has an alpha of 1.
        let picture = picture.into_rgba32f();
        let plane = |c: usize| picture.pixels().map(move |pixel| pixel.0[c] * pixel.0[3]);
        Self::new((0..3).flat_map(plane).collect(), [height, width], what)
    }

    /// `[1, 3, H, W]`.
    pub fn tensor(&self, device: &Device) -> Tensor<4> {
        Tensor::from_data(TensorData::new(self.values.clone(), [1, 3, self.height, self.width]), device)
    }

    /// One of the three planes `[H, W]`.
    pub fn plane(&self, channel: usize) -> &[f32] {
        &self.values[channel * self.height * self.width..][..self.height * self.width]
    }

    /// The crop `[x, y, width, height]`.
    ///
    /// # Panics
    /// If the crop is not inside the picture.
    pub fn cropped(&self, [x, y, width, height]: [usize; 4]) -> Self {
        assert!(x + width <= self.width && y + height <= self.height, "{width}×{height} at {x}, {y}");
        let line = |c: usize, row: usize| &self.plane(c)[row * self.width + x..][..width];
        let lines = (0..3).flat_map(|c| (y..y + height).map(move |row| (c, row)));
        Self { width, height, values: lines.flat_map(|(c, row)| line(c, row)).copied().collect() }
    }

    /// The box of a region, with black pixels outside of the region's mask.
    pub fn within(&self, region: &Region) -> Self {
        let mut part = self.cropped(region.window);
        if let Some(inside) = &region.inside {
            for plane in part.values.chunks_exact_mut(inside.len().max(1)) {
                plane.iter_mut().zip(inside).filter(|(_, set)| !**set).for_each(|(v, _)| *v = 0.0);
            }
        }
        part
    }

    /// The picture with 8 bits per channel.
    pub fn to_rgb8(&self) -> RgbImage {
        picture([self.width, self.height], |i| [0, 1, 2].map(|c| self.plane(c)[i]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageBuffer, Rgb, Rgba};

    fn colorful() -> RgbImage {
        RgbImage::from_fn(5, 4, |x, y| Rgb([(40 * x) as u8, (60 * y) as u8, 255 - (10 * x * y) as u8]))
    }

    #[test]
    fn eight_and_sixteen_bits_and_floats_of_one_picture_are_equal() {
        let eight = DynamicImage::ImageRgb8(colorful());
        let files: [DynamicImage; 3] = [eight.to_rgb32f().into(), eight.to_rgb16().into(), eight];
        let [expected, others @ ..] =
            files.map(|picture| Picture::from_file(picture, "picture").expect("a picture"));
        assert_eq!(others, [expected.clone(), expected.clone()]);
        assert_eq!(snapsnap_ops::host(expected.tensor(&Device::flex())), expected.values);
        assert_eq!(expected.to_rgb8(), colorful());
        // Red is the first plane.
        assert_eq!(expected.plane(0)[3], 120.0 / 255.0);
    }

    #[test]
    fn values_outside_of_0_to_1_are_refused_with_their_place() {
        let values = |bad: f32| (0..18).map(|i| if i == 16 { bad } else { 0.5 }).collect::<Vec<f32>>();
        for bad in [255.0, -1e-6, 1.000_001, f32::NAN, f32::INFINITY] {
            let said = Picture::new(values(bad), [2, 3], "picture").expect_err("refused").to_string();
            assert!(said.contains("channel 2, row 1, column 1 of the picture"), "{said}");
        }
        // Renders are clamped, but a NaN is an error.
        assert_eq!(Picture::rendered(&values(7.0), [2, 3], 1).expect("cut").plane(1)[5], 1.0);
        assert!(Picture::rendered(&values(f32::NAN), [2, 3], 1).is_err());
    }

    #[test]
    fn transparent_pictures_lie_over_black() {
        let rgba = ImageBuffer::from_pixel(1, 1, Rgba([200_u8, 100, 50, 51]));
        let picture = Picture::from_file(DynamicImage::ImageRgba8(rgba), "picture").expect("a picture");
        let expected = [200.0, 100.0, 50.0].map(|v: f32| v / 255.0 * 0.2);
        assert!(picture.values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-7), "{picture:?}");
    }

    #[test]
    fn crops_and_shrunk_renders_keep_pixels_where_they_are() {
        let values: Vec<f32> = (0..48).map(|i| i as f32 / 48.0).collect();
        let picture = Picture::new(values, [4, 4], "picture").expect("a picture");
        let crop = picture.cropped([1, 2, 2, 1]);
        assert_eq!(crop.values, [9.0, 10.0, 25.0, 26.0, 41.0, 42.0].map(|v| v / 48.0));
        // A render has interleaved colours. Values over 1 are clamped before the mean.
        let render: Vec<f32> = (0..16).flat_map(|i| [0.0, if i == 6 { 9.0 } else { 0.5 }, 0.0]).collect();
        let half = Picture::rendered(&render, [4, 4], 2).expect("a picture");
        assert_eq!((half.width, half.plane(0)), (2, &[0.0; 4][..]));
        assert_eq!(half.plane(1), [0.5, 0.625, 0.5, 0.5]);
    }
}
