//! Resizing of pictures and of planes of values.

use std::ops::{Add, Mul};

use burn::tensor::{Device, Tensor, TensorData};
use image::imageops::{self, FilterType};
use image::{ImageBuffer, Luma, RgbImage};
use snapsnap_base::bilinear::Tap;
use snapsnap_ops::host;

/// Resizes `values` in [0, 1] of size `from` (rows, columns) to `to` with the image crate's Lanczos filter,
/// antialiased when shrinking.
pub fn lanczos3(values: Vec<f32>, from: [usize; 2], to: [usize; 2]) -> Vec<f32> {
    let plane = ImageBuffer::<Luma<f32>, _>::from_raw(from[1] as u32, from[0] as u32, values)
        .expect("as many values as pixels");
    imageops::resize(&plane, to[1] as u32, to[0] as u32, FilterType::Lanczos3).into_raw()
}

/// Resizes `values` of `from` (rows, columns) to `to` with the four samples around each target pixel's centre and with
/// repeated edges. It aliases when shrinking.
pub fn bilinear(values: Vec<f32>, [rows, columns]: [usize; 2], to: [usize; 2]) -> Vec<f32> {
    let plane = Tensor::from_data(TensorData::new(values, [1, 1, rows, columns]), &Device::flex());
    host(snapsnap_ops::bilinear(plane, to, false))
}

/// The picture with a longer side of `longest` pixels; `None` if it is not longer.
pub fn reduced(picture: &RgbImage, longest: u32) -> Option<RgbImage> {
    let (width, height) = picture.dimensions();
    let longer = width.max(height);
    let scaled = |side: u32| (u64::from(side) * u64::from(longest) / u64::from(longer)).max(1) as u32;
    // Unlike other filters, this one makes no copy in floats.
    (longer > longest).then(|| imageops::thumbnail(picture, scaled(width), scaled(height)))
}

/// The value of a plane of `columns` columns between its samples, down and across.
pub fn interpolate<T>(plane: &[T], columns: usize, [(y0, y1, fy), (x0, x1, fx)]: [Tap; 2]) -> T
where
    T: Copy + Mul<f32, Output = T> + Add<Output = T>,
{
    let along = |y: usize| plane[y * columns + x0] * (1.0 - fx) + plane[y * columns + x1] * fx;
    along(y0) * (1.0 - fy) + along(y1) * fy
}
