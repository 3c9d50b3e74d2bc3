//! Photographs and masks in every format that they may have.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgba, RgbaImage};

use super::super::Format;
use super::{gaussians, put, weights};

/// Side of a photograph: the smallest that is taken.
const SIDE: u32 = 64;
/// A progressive JPEG of that side, which the encoder at hand does not write.
const PROGRESSIVE: &[u8] = include_bytes!("../../../../crates/mesh/tests/progressive.jpg");
/// A HEIC of that side, made with libheif.
const HEIC: &[u8] = include_bytes!("../../../../crates/mesh/tests/square.heic");

/// What all have in common.
const PICTURE: Format = Format {
    name: "",
    sample: |_| (),
    changed: &[],
    command: "",
    file: Some("out.ply"),
    partial: false,
    kept: &[],
    whole: gaussians::reconstruction,
    share: 24,
};

pub const FORMATS: &[Format] = &[
    Format {
        name: "picture-png",
        sample: |folder| with_alpha(folder, "png", ImageFormat::Png),
        changed: &["front.png"],
        command: "reconstruct in/front.png in/back.png --weights in/w.safetensors --device cpu -v -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-png-deep",
        sample: |folder| {
            with_alpha(folder, "png", ImageFormat::Png);
            let deep = DynamicImage::ImageRgba16(DynamicImage::from(picture()).into_rgba16());
            put(folder, "front.png", encoded(&deep, ImageFormat::Png));
        },
        changed: &["front.png"],
        command: "reconstruct in/front.png in/back.png --as-is --weights in/w.safetensors --device cpu -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-webp",
        sample: |folder| with_alpha(folder, "webp", ImageFormat::WebP),
        changed: &["front.webp"],
        command: "reconstruct in/front.webp in/back.webp --weights in/w.safetensors --device cpu -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-tiff",
        sample: |folder| with_alpha(folder, "tiff", ImageFormat::Tiff),
        changed: &["front.tiff"],
        command: "reconstruct in/front.tiff in/back.tiff --weights in/w.safetensors --device cpu -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-gif",
        sample: |folder| with_alpha(folder, "gif", ImageFormat::Gif),
        changed: &["front.gif"],
        command: "reconstruct in/front.gif in/back.gif --weights in/w.safetensors --device cpu -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-bmp",
        sample: |folder| with_alpha(folder, "bmp", ImageFormat::Bmp),
        changed: &["front.bmp"],
        command: "reconstruct in/front.bmp in/back.bmp --as-is --weights in/w.safetensors --device cpu -o out.ply",
        ..PICTURE
    },
    Format {
        name: "picture-jpeg",
        sample: |folder| with_masks(folder, &tagged_jpeg()),
        changed: &["front.jpg"],
        command: MASKED,
        ..PICTURE
    },
    Format {
        name: "picture-jpeg-progressive",
        sample: |folder| with_masks(folder, PROGRESSIVE),
        changed: &["front.jpg"],
        command: MASKED,
        ..PICTURE
    },
    // The first bytes of a picture say what it is, not its name.
    Format {
        name: "picture-heic",
        sample: |folder| with_masks(folder, HEIC),
        changed: &["front.jpg"],
        command: MASKED,
        ..PICTURE
    },
    Format {
        name: "mask",
        sample: |folder| with_masks(folder, &tagged_jpeg()),
        changed: &["mask.png", "mask.jpg"],
        command: MASKED,
        ..PICTURE
    },
];

const MASKED: &str = "reconstruct in/front.jpg in/back.jpg --masks in/mask.png in/mask.jpg \
                      --weights in/w.safetensors --device cpu -v -o out.ply";

/// A standing ellipse of many colours before nothing.
pub fn picture() -> RgbaImage {
    RgbaImage::from_fn(SIDE, SIDE, |x, y| {
        let [u, v] = [x, y].map(|at| at as f32 / SIDE as f32 - 0.5);
        let inside = (u / 0.3).powi(2) + (v / 0.45).powi(2) < 1.0;
        Rgba([(x * 7) as u8, (y * 5) as u8, ((x + y) * 3) as u8, if inside { 255 } else { 0 }])
    })
}

pub fn encoded(picture: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).expect("encodes");
    bytes.into_inner()
}

/// Front and back, and the weights to reconstruct with.
pub fn with_alpha(folder: &Path, ending: &str, format: ImageFormat) {
    for name in ["front", "back"] {
        put(folder, &format!("{name}.{ending}"), encoded(&picture().into(), format));
    }
    weights::write(folder);
}

/// Photographs without transparency, and a mask as PNG and as JPEG.
fn with_masks(folder: &Path, front: &[u8]) {
    put(folder, "front.jpg", front);
    put(folder, "back.jpg", tagged_jpeg());
    let picture = picture();
    let mask = GrayImage::from_fn(SIDE, SIDE, |x, y| Luma([picture.get_pixel(x, y).0[3]]));
    let mask = DynamicImage::from(mask);
    put(folder, "mask.png", encoded(&mask, ImageFormat::Png));
    put(folder, "mask.jpg", encoded(&mask, ImageFormat::Jpeg));
    weights::write(folder);
}

/// A JPEG whose EXIF data say which way is up.
fn tagged_jpeg() -> Vec<u8> {
    let jpeg = encoded(&DynamicImage::from(picture()).into_rgb8().into(), ImageFormat::Jpeg);
    // APP1 segment: "Exif", little-endian TIFF with one entry, tag 0x0112 (orientation) = 2 (mirrored).
    let exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x02\0\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat()
}
