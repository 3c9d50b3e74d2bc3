//! `--save-cutouts`: the photographs without background.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::{GrayImage, ImageFormat, Rgb, RgbImage, Rgba, RgbaImage};

use crate::failure::Failure;
use crate::output::{check_folder, make_folder, write};

/// Paths of front and back in the folder. Refuses a path that is no folder and cannot become one.
pub fn paths(folder: &Path) -> Result<[PathBuf; 2], Failure> {
    check_folder(folder)?;
    Ok(["front.png", "back.png"].map(|name| folder.join(name)))
}

/// Writes a photograph with its mask as alpha channel, and makes the folder. Colours without coverage are black.
pub fn save(path: &Path, rgb: &RgbImage, mask: &GrayImage) -> Result<(), Failure> {
    make_folder(path.parent().expect("a name in the folder"))?;
    let pixels = RgbaImage::from_fn(rgb.width(), rgb.height(), |x, y| {
        let (Rgb([r, g, b]), alpha) = (*rgb.get_pixel(x, y), mask.get_pixel(x, y)[0]);
        if alpha > 0 { Rgba([r, g, b, alpha]) } else { Rgba([0; 4]) }
    });
    let mut bytes = Vec::new();
    let encoded = pixels.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png);
    encoded.map_err(|e| Failure::Internal(format!("{}: cannot encode: {e}", path.display())))?;
    write(path, &bytes)
}
