//! Reading of SOG of version 2, SH included. Gaussians are turned back by 180° about z.

use std::io::{Cursor, Read, Seek};

use image::codecs::webp::WebPDecoder;
use image::{DynamicImage, ImageDecoder, RgbaImage};
use serde_json::Value;
use zip::ZipArchive;

use super::{FIRST_LEFT_OUT, MAX_SIDE};
use crate::stored::{COEFFICIENTS, Problem, Stored, check_ratio, logit, smallest_three};

/// Largest `meta.json` in bytes.
const MAX_META: u64 = 1 << 20;
/// Palette entries of SH in one row of their picture.
const ENTRIES: u32 = 64;
/// Pixels of the largest palette: 65,536 entries of 15 coefficients.
const LARGEST_PALETTE: u64 = 15 << 16;
/// Bytes of a Gaussian in memory: its columns, and its pixels of five pictures.
const BYTES: u64 = 14 * 4 + 5 * 4;

/// Reads a SOG, a ZIP archive of `length` bytes.
pub(crate) fn read(mut input: impl Read, length: u64) -> Result<Stored, Problem> {
    let mut bytes = Vec::new();
    input.read_to_end(&mut bytes)?;
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| format!("its ZIP is damaged: {e}"))?;
    let meta = entry(&mut archive, "meta.json", MAX_META)?;
    let meta: Value = serde_json::from_slice(&meta).map_err(|e| format!("meta.json: {e}"))?;
    if meta["version"] != 2 {
        return Err(format!("SOG of version {}; 2 is read", meta["version"]).into());
    }
    let count = meta["count"].as_u64().filter(|count| (1..=(MAX_SIDE * MAX_SIDE) as u64).contains(count));
    let count = count.ok_or_else(|| "meta.json: `count` is no number of Gaussians".to_owned())? as usize;
    check_ratio(count, count as u64 * BYTES, length)?;
    // A picture may have a rim, and a palette its own size.
    let most = (4 * count as u64).max(LARGEST_PALETTE);
    let mut picture = |part: &str, i: usize| {
        let name = meta[part]["files"][i].as_str();
        let name = name.ok_or_else(|| format!("meta.json: `{part}.files` lacks a name"))?;
        pixels(&entry(&mut archive, name, length.saturating_mul(2))?, name, most)
    };
    let mut of_each = |part: &str, i: usize| {
        let picture = picture(part, i)?;
        let there = picture.width() as usize * picture.height() as usize;
        if there < count {
            return Err(Problem::from(format!("{part}: {there} pixels for {count} Gaussians")));
        }
        Ok(picture)
    };
    let (low, high) = (of_each("means", 0)?, of_each("means", 1)?);
    let (quats, scales, sh0) = (of_each("quats", 0)?, of_each("scales", 0)?, of_each("sh0", 0)?);
    let [mins, maxs] = ["mins", "maxs"].map(|name| numbers(&meta["means"][name], 3, "means"));
    let (mins, maxs) = (mins?, maxs?);
    let [scale_book, color_book] = ["scales", "sh0"].map(|part| numbers(&meta[part]["codebook"], 256, part));
    let (scale_book, color_book) = (scale_book?, color_book?);

    let mut columns: Vec<Vec<f32>> = Vec::new();
    for axis in 0..3 {
        let value = |(low, high): (&image::Rgba<u8>, &image::Rgba<u8>)| {
            let share = f32::from(u16::from_le_bytes([low[axis], high[axis]])) / 65535.0;
            let log = mins[axis] + share * (maxs[axis] - mins[axis]);
            let value = log.signum() * log.abs().exp_m1();
            if axis < 2 { -value } else { value }
        };
        columns.push(low.pixels().zip(high.pixels()).take(count).map(value).collect());
    }
    let turned = quats.pixels().take(count).map(|pixel| {
        let [a, b, c, left_out] = pixel.0;
        let largest = usize::from(left_out.saturating_sub(FIRST_LEFT_OUT));
        let [w, x, y, z] = smallest_three(largest, [a, b, c].map(|byte| f32::from(byte) / 255.0));
        // The quaternion of the turn back, −k, times (w, x, y, z).
        [z, y, -x, -w]
    });
    let turned: Vec<[f32; 4]> = turned.collect();
    columns.extend((0..4).map(|c| turned.iter().map(|q| q[c]).collect::<Vec<f32>>()));
    let coded = |picture: &RgbaImage, book: &[f32], c: usize| -> Vec<f32> {
        picture.pixels().take(count).map(|pixel| book[usize::from(pixel[c])]).collect()
    };
    columns.extend((0..3).map(|axis| coded(&scales, &scale_book, axis)));
    columns.push(sh0.pixels().take(count).map(|pixel| logit(f32::from(pixel[3]) / 255.0)).collect());
    columns.extend((0..3).map(|channel| coded(&sh0, &color_book, channel)));
    let mut coefficients = 1;
    if !meta["shN"].is_null() {
        let bands = meta["shN"]["bands"].as_u64().and_then(|bands| COEFFICIENTS.get(bands as usize));
        coefficients = *bands.ok_or_else(|| "meta.json: `shN.bands` must be 0 to 3".to_owned())?;
        let book = numbers(&meta["shN"]["codebook"], 256, "shN")?;
        let labels = of_each("shN", 1)?;
        let centroids = picture("shN", 0)?;
        for channel in 0..3 {
            for band in 1..coefficients {
                // A turn by 180° about z negates every second basis function.
                let sign = if band % 2 == 1 { -1.0 } else { 1.0 };
                let value = |pixel: &image::Rgba<u8>| {
                    let label = u32::from(u16::from_le_bytes([pixel[0], pixel[1]]));
                    let column = label % ENTRIES * (coefficients as u32 - 1) + band as u32 - 1;
                    let found = centroids.get_pixel_checked(column, label / ENTRIES);
                    found.map(|found| sign * book[usize::from(found[channel])])
                };
                let values: Option<Vec<f32>> = labels.pixels().take(count).map(value).collect();
                columns.push(values.ok_or_else(|| "shN: a label is beyond the palette".to_owned())?);
            }
        }
    }
    Ok(Stored { coefficients, columns })
}

/// A file of the archive of at most `most` bytes.
fn entry(archive: &mut ZipArchive<impl Read + Seek>, name: &str, most: u64) -> Result<Vec<u8>, Problem> {
    let damaged = |e: &dyn std::fmt::Display| format!("{name}: {e}");
    let mut file = archive.by_name(name).map_err(|e| damaged(&e))?;
    let mut bytes = Vec::new();
    (&mut file).take(most + 1).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
    if bytes.len() as u64 > most {
        return Err(format!("{name}: is too large").into());
    }
    Ok(bytes)
}

/// The pixels of a WebP picture of at most `most` pixels.
fn pixels(bytes: &[u8], name: &str, most: u64) -> Result<RgbaImage, Problem> {
    let damaged = |e: image::ImageError| format!("{name}: {e}");
    let decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > most {
        return Err(format!("{name}: {width}×{height} pixels are too many for its Gaussians").into());
    }
    Ok(DynamicImage::from_decoder(decoder).map_err(damaged)?.into_rgba8())
}

/// A list of `count` finite numbers.
fn numbers(value: &Value, count: usize, part: &str) -> Result<Vec<f32>, Problem> {
    let list = value.as_array().filter(|list| list.len() == count);
    let numbers = list.and_then(|list| list.iter().map(|v| v.as_f64().map(|v| v as f32)).collect());
    let numbers = numbers.filter(|numbers: &Vec<f32>| numbers.iter().all(|v| v.is_finite()));
    numbers.ok_or_else(|| format!("meta.json: `{part}` lacks its {count} numbers").into())
}
