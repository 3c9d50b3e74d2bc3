use std::fs;

use image::{Rgb, RgbImage};

use super::*;

/// A picture with detail everywhere.
fn picture() -> RgbImage {
    RgbImage::from_fn(120, 90, |x, y| {
        let v = (x * 7919 + y * 104_729) % 251;
        Rgb([v as u8, (x * 2) as u8, (y * 2) as u8])
    })
}

fn encoded(format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture().write_to(&mut bytes, format).expect("encodes");
    bytes.into_inner()
}

/// 64×64 progressive, made with another encoder.
const PROGRESSIVE: &[u8] = include_bytes!("../../tests/progressive.jpg");

#[test]
fn pictures_that_are_cut_short_are_refused() {
    let decoded = |bytes: &[u8]| decode_bytes(Path::new("picture"), bytes, MAX_BYTES).map(drop);
    let jpeg = encoded(ImageFormat::Jpeg);
    let mut thumbnail = vec![0xff, 0xd8, 0xff, 0xe1];
    // The end of a picture inside a segment is not the end of the file.
    thumbnail.extend((PROGRESSIVE.len() as u16 + 2).to_be_bytes());
    thumbnail.extend(PROGRESSIVE);
    thumbnail.extend(&jpeg[2..]);
    let pictures = [
        ("baseline JPEG", jpeg),
        ("progressive JPEG", PROGRESSIVE.to_vec()),
        ("JPEG with a thumbnail", thumbnail),
        ("PNG", encoded(ImageFormat::Png)),
        ("WebP", encoded(ImageFormat::WebP)),
        ("BMP", encoded(ImageFormat::Bmp)),
        ("TIFF", encoded(ImageFormat::Tiff)),
        ("GIF", encoded(ImageFormat::Gif)),
    ];
    for (name, bytes) in pictures {
        decoded(&bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
        for percent in (5..=95).step_by(3) {
            let error = decoded(&bytes[..bytes.len() * percent / 100]).expect_err(name).to_string();
            assert!(error.contains("not a readable image"), "{name} at {percent} %: {error}");
        }
    }
}

#[test]
fn jpegs_are_decoded_as_by_the_image_crate() {
    let mut grey = Cursor::new(Vec::new());
    DynamicImage::from(picture()).into_luma8().write_to(&mut grey, ImageFormat::Jpeg).expect("encodes");
    for bytes in [encoded(ImageFormat::Jpeg), PROGRESSIVE.to_vec(), grey.into_inner()] {
        let expected = image::load_from_memory(&bytes).expect("decodes");
        assert_eq!(decode_bytes(Path::new("a.jpg"), &bytes, MAX_BYTES).expect("decodes"), expected);
    }
}

/// A JPEG with EXIF data that tell of a turn by 90° in a number of this type, after `stray` bytes.
fn turned(kind: u16, stray: &[u8]) -> Vec<u8> {
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01".to_vec();
    exif.extend([&kind.to_le_bytes()[..], &[1, 0, 0, 0, 6, 0, 0, 0], &[0; 4]].concat());
    let jpeg = encoded(ImageFormat::Jpeg);
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], b"\xff\xe1", &length, &exif, stray, &jpeg[2..]].concat()
}

#[test]
fn orientations_of_every_type_count_and_stray_bytes_between_segments_do_not() {
    let size = |bytes: Vec<u8>| {
        let picture = photograph(Path::new("a.jpg"), Some(&bytes)).expect("decodes");
        // Textures of other files stay as they are.
        assert_eq!(decode_bytes(Path::new("a.glb"), &bytes, MAX_BYTES).expect("decodes").width(), 120);
        [picture.width(), picture.height()]
    };
    assert_eq!(size(encoded(ImageFormat::Jpeg)), [120, 90]);
    // Bytes, shorts and longs; texts are no numbers.
    for (kind, expected) in [(1, [90, 120]), (3, [90, 120]), (4, [90, 120]), (2, [120, 90])] {
        for stray in [&b""[..], b"\0", b"\0\x01\xff\xff\xff"] {
            assert_eq!(size(turned(kind, stray)), expected, "{kind} {stray:?}");
        }
    }
}

#[test]
fn sizes_are_checked_before_pixels_are_decoded() {
    let error = |bytes: &[u8], most| {
        decode_bytes(Path::new("a"), bytes, most).map(|_| ()).expect_err("refuses").to_string()
    };
    let refused = error(&encoded(ImageFormat::Png), 32_399);
    assert!(refused.starts_with("a: is 120×90, 1 MiB in memory, more than 0"), "{refused}");
    assert!(decode_bytes(Path::new("a"), &encoded(ImageFormat::Png), 32_400).is_ok());
    assert!(error(&encoded(ImageFormat::Jpeg), 32_399).contains("is 120×90"));

    // A header of 16000×15999 pixels in a file of a few kilobytes.
    let mut jpeg = encoded(ImageFormat::Jpeg);
    let frame = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).expect("a frame header");
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0x3e, 0x7f, 0x3e, 0x80]);
    let refused = error(&jpeg, u64::MAX);
    assert!(refused.contains("the file ends before the picture does"), "{refused}");
}

/// 96×64: a grey ramp of 8 columns, red, and blue from column 48 on. Made with libheif.
const HEIC: &[u8] = include_bytes!("../../tests/small.heic");

#[test]
fn heic_pictures_are_read_and_damaged_ones_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("a.heic");
    let saved = |bytes: &[u8]| fs::write(&path, bytes).expect("writes");
    saved(HEIC);
    assert_eq!(size(&path, None).expect("a size"), [96, 64]);
    let picture = decode(&path, MAX_BYTES).expect("decodes").into_rgb8();
    for (x, y, expected) in [(30, 20, [200, 60, 40]), (80, 50, [40, 90, 200]), (3, 32, [128, 128, 128])] {
        let found = picture.get_pixel(x, y).0;
        assert!((0..3).all(|c| found[c].abs_diff(expected[c]) < 8), "{x}, {y}: {found:?}");
    }
    let refused = decode(&path, 16 * 96 * 64 - 1).map(|_| ()).expect_err("too large").to_string();
    assert!(refused.contains("is 96×64"), "{refused}");
    for length in (12..HEIC.len()).step_by(7) {
        saved(&HEIC[..length]);
        let error = decode(&path, MAX_BYTES).map(|_| ()).expect_err("cut").to_string();
        assert!(error.contains("not a readable image") && error.contains("a.heic"), "{length}: {error}");
    }
    // Without a grid the coded size counts once, with a grid once for each item.
    assert_eq!(heic::size(HEIC).expect("a size"), ([96, 64], 16 * 96 * 64));
    let more = [HEIC, b"grid", &b"hvc1".repeat(40)].concat();
    let items = more.windows(4).filter(|kind| *kind == b"hvc1").count() as u64;
    assert!(items > 40);
    assert_eq!(heic::size(&more).expect("a size").1, 16 * 96 * 64 * items);
}

/// Pictures of colours and greys with a profile, as PNG and JPEG, and the pixels that the same colours have in sRGB.
#[test]
fn colours_are_converted_to_srgb() {
    use image::{ExtendedColorType, ImageEncoder, codecs};
    let decoded = |bytes: &[u8]| photograph(Path::new("a"), Some(bytes)).expect("decodes").into_rgb8();
    let png = |pixels: &[u8], kind: ExtendedColorType, profile: &[u8]| {
        let mut bytes = Vec::new();
        let mut encoder = codecs::png::PngEncoder::new(&mut bytes);
        encoder.set_icc_profile(profile.to_vec()).expect("PNG has profiles");
        encoder.write_image(pixels, 2, 1, kind).expect("encodes");
        bytes
    };
    let (p3, adobe) = (ColorProfile::new_display_p3(), ColorProfile::new_adobe_rgb());
    // Computed with the matrices of the standards: P3 (200, 60, 40) and Adobe RGB (120, 160, 90).
    for (name, profile, stored, expected) in [
        ("P3", &p3, [200, 60, 40], [217, 42, 23]),
        ("Adobe RGB", &adobe, [120, 160, 90], [99, 161, 85]),
        ("sRGB", &ColorProfile::new_srgb(), [200, 60, 40], [200, 60, 40]),
    ] {
        let icc = profile.encode().expect("a profile");
        let picture = decoded(&png(&[stored, [77; 3]].concat(), ExtendedColorType::Rgb8, &icc));
        let found = picture.get_pixel(0, 0).0;
        assert!((0..3).all(|c| found[c].abs_diff(expected[c]) <= 1), "{name}: {found:?}");
        assert!(picture.get_pixel(1, 0).0.iter().all(|v| v.abs_diff(77) <= 2), "{name}: grey stays");
        let mut bytes = Vec::new();
        let mut encoder = codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 100);
        encoder.set_icc_profile(icc).expect("JPEG has profiles");
        encoder.write_image(&stored.repeat(64), 8, 8, ExtendedColorType::Rgb8).expect("encodes");
        let found = decoded(&bytes).get_pixel(4, 4).0;
        assert!((0..3).all(|c| found[c].abs_diff(expected[c]) <= 3), "{name} as JPEG: {found:?}");
    }
    let grey = ColorProfile::new_gray_with_gamma(1.8).encode().expect("a profile");
    let picture = decoded(&png(&[100, 255, 0, 128], ExtendedColorType::La8, &grey));
    // (100 / 255) ^ 1.8 = 0.185 is sRGB's 119.
    assert!((117..=121).contains(&picture.get_pixel(0, 0).0[0]), "{:?}", picture.get_pixel(0, 0));
    // A profile for other channels, and one that is damaged.
    for profile in [&grey[..], b"no profile"] {
        let other = decoded(&png(&[9, 99, 200, 7, 7, 7], ExtendedColorType::Rgb8, profile));
        assert_eq!(other.as_raw(), &[9, 99, 200, 7, 7, 7]);
    }
}

#[test]
fn a_bmp_whose_alpha_is_0_everywhere_is_opaque() {
    let rgba = |alpha: u8| {
        let (mut rgba, mut bytes) = (DynamicImage::from(picture()).into_rgba8(), Cursor::new(Vec::new()));
        rgba.pixels_mut().for_each(|pixel| pixel.0[3] = alpha);
        rgba.write_to(&mut bytes, ImageFormat::Bmp).expect("encodes");
        decode_bytes(Path::new("picture"), bytes.get_ref(), MAX_BYTES).expect("decodes")
    };
    let (empty, half) = (rgba(0), rgba(128));
    assert!(!empty.color().has_alpha() && empty.into_rgb8() == picture());
    assert!(half.into_rgba8().pixels().all(|pixel| pixel.0[3] == 128));
}
