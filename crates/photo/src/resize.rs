//! Resizing of one plane of values.

use image::imageops::{self, FilterType};
use image::{ImageBuffer, Luma};
use snapsnap_base::bilinear::taps;

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
    let (down, across) = (taps(rows, to[0], false), taps(columns, to[1], false));
    let mut out = Vec::with_capacity(to[0] * to[1]);
    for &(y0, y1, fy) in &down {
        for &(x0, x1, fx) in &across {
            let along = |y: usize| values[y * columns + x0] * (1.0 - fx) + values[y * columns + x1] * fx;
            out.push(along(y0) * (1.0 - fy) + along(y1) * fy);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [0, 1] → [0, ¼, ¾, 1] (docs/method.md, "Check values").
    #[test]
    fn bilinear_has_its_published_check_value() {
        assert_eq!(bilinear(vec![0.0, 1.0], [1, 2], [1, 4]), [0.0, 0.25, 0.75, 1.0]);
    }

    #[test]
    fn lanczos_keeps_constants_and_averages_fine_detail_away() {
        let flat = lanczos3(vec![0.25; 48], [6, 8], [3, 5]);
        assert!(flat.iter().all(|v| (v - 0.25).abs() < 1e-6), "{flat:?}");
        let stripes: Vec<f32> = (0..64 * 64).map(|i| (i % 2) as f32).collect();
        let small = lanczos3(stripes, [64, 64], [8, 8]);
        assert!(small.iter().all(|v| (v - 0.5).abs() < 0.05), "{small:?}");
    }
}
