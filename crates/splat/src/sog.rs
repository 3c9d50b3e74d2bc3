//! PlayCanvas' SOG: quantised Gaussians as lossless pictures in a ZIP. Version 2 is read, and written without SH above
//! degree 0.
//!
//! Layout: developer.playcanvas.com, "The SOG Format". There y is up, but PlayCanvas' viewers turn a SOG, like a
//! PLY, by 180° about z. The Gaussians are therefore stored turned, and appear upright and from the front.

mod read;

use std::io::{self, Cursor, Write};

use image::codecs::webp::WebPEncoder;
use image::{ExtendedColorType, ImageEncoder};
use serde_json::json;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use crate::stored::{Stored, opacity, unit};

pub(crate) use read::read;

/// Number of values in a codebook.
const CODES: usize = 256;
/// Rounds of the search for a codebook (Lloyd, "Least squares quantization in PCM", 1982).
const ROUNDS: usize = 12;
/// Alpha of the pixel of a quaternion whose first component is left out.
const FIRST_LEFT_OUT: u8 = 252;
/// Largest absolute value of a Gaussian. The range of larger values may overflow f32.
const LARGEST: f32 = 1e30;
/// Largest absolute colour and logarithm of a scale. Larger ones look the same, and take the others' precision.
const MOST: f32 = 100.0;
/// Largest side of a WebP picture in pixels.
const MAX_SIDE: usize = 16_383;

/// The reason why a SOG cannot contain the Gaussians, if there is one.
pub(crate) fn check(stored: &Stored) -> Result<(), String> {
    if stored.is_empty() {
        return Err("a SOG has one Gaussian at least".into());
    }
    if stored.columns.iter().flatten().any(|value| value.abs() > LARGEST) {
        return Err(format!("a SOG cannot have values beyond {LARGEST:e}"));
    }
    if stored.len() > MAX_SIDE * MAX_SIDE {
        return Err(format!("{} Gaussians; a SOG has {} at most", stored.len(), MAX_SIDE * MAX_SIDE));
    }
    Ok(())
}

/// Losses beyond quantisation, a sentence each.
pub(crate) fn losses(stored: &Stored) -> Vec<String> {
    let mut losses = match stored.degree() {
        0 => Vec::new(),
        degree => vec![format!("SH of degree {degree} became degree 0, as in every SOG of this program")],
    };
    let columns = [7..10, 11..14].into_iter().flat_map(|of| &stored.columns[of]);
    match columns.flatten().filter(|value| value.abs() > MOST).count() {
        0 => {}
        count => losses.push(format!("{count} scales and colours beyond ±{MOST} were cut off there")),
    }
    losses
}

/// Writes a SOG of Gaussians that [`check`] accepts.
pub(crate) fn write(stored: &Stored, out: &mut impl Write) -> io::Result<()> {
    // Neighbours in space become neighbours in the pictures, which then compress better.
    let order = along_a_curve(stored);
    let width = (order.len() as f64).sqrt().ceil() as usize;
    let size = [width, order.len().div_ceil(width)];

    let logs = [(-1.0, 0), (-1.0, 1), (1.0, 2)].map(|(sign, axis)| {
        let values = stored.columns[axis].iter();
        values.map(|v| sign * v.signum() * v.abs().ln_1p()).collect::<Vec<f32>>()
    });
    let limits = logs.each_ref().map(|values| range(values));
    let place = |i: usize| {
        [0, 1, 2].map(|axis| {
            let (low, high) = limits[axis];
            let share = if high > low { (logs[axis][i] - low) / (high - low) } else { 0.0 };
            (65535.0 * share).round() as u16
        })
    };
    let scales = Codebook::of(&stored.columns[7..10]);
    let colors = Codebook::of(&stored.columns[11..14]);
    let code = |book: &Codebook, first: usize, i: usize| {
        [0, 1, 2].map(|c| book.nearest(stored.columns[first + c][i]))
    };
    let opaque = |byte: [u8; 3]| [byte[0], byte[1], byte[2], 255];
    // The quaternion of the turn, k, times (w, x, y, z).
    let quaternion = |i: usize| {
        let [w, x, y, z] = [3, 4, 5, 6].map(|column| stored.columns[column][i]);
        pack_smallest_three([-z, -y, x, w])
    };
    let color = |i: usize| {
        let [r, g, b] = code(&colors, 11, i);
        [r, g, b, (255.0 * opacity(stored.columns[10][i])).round() as u8]
    };
    let pixels = |of: &dyn Fn(usize) -> [u8; 4]| picture(&order, size, of);
    let meta = json!({
        "version": 2,
        "asset": {"generator": "snapsnap"},
        "count": order.len(),
        "antialias": false,
        "means": {
            "mins": limits.map(|(low, _)| low),
            "maxs": limits.map(|(_, high)| high),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scales.0, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.0, "files": ["sh0.webp"]},
    });
    let files = [
        ("meta.json", serde_json::to_vec(&meta)?),
        ("means_l.webp", pixels(&|i| opaque(place(i).map(|v| v as u8)))?),
        ("means_u.webp", pixels(&|i| opaque(place(i).map(|v| (v >> 8) as u8)))?),
        ("quats.webp", pixels(&quaternion)?),
        ("scales.webp", pixels(&|i| opaque(code(&scales, 7, i)))?),
        ("sh0.webp", pixels(&color)?),
    ];
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // A fixed time gives the same bytes on every run; pictures are compressed already.
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(DateTime::default());
    for (name, bytes) in files {
        archive.start_file(name, options)?;
        archive.write_all(&bytes)?;
    }
    out.write_all(&archive.finish()?.into_inner())
}

/// The least and the largest value.
fn range(values: &[f32]) -> (f32, f32) {
    values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
}

/// A lossless WebP picture. Pixels after the last Gaussian repeat its pixel.
fn picture(order: &[u32], [width, height]: [usize; 2], of: &dyn Fn(usize) -> [u8; 4]) -> io::Result<Vec<u8>> {
    let last = *order.last().expect("one Gaussian at least");
    let rows = order.iter().copied().chain(std::iter::repeat(last)).take(width * height);
    let pixels: Vec<u8> = rows.flat_map(|row| of(row as usize)).collect();
    let mut bytes = Vec::new();
    let encoder = WebPEncoder::new_lossless(&mut bytes);
    encoder
        .write_image(&pixels, width as u32, height as u32, ExtendedColorType::Rgba8)
        .map_err(io::Error::other)?;
    Ok(bytes)
}

/// A quaternion (w, x, y, z): three bytes without the largest component, whose index is in the fourth byte.
fn pack_smallest_three(q: [f32; 4]) -> [u8; 4] {
    let q = unit(q);
    let largest = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).expect("four components");
    // A quaternion and its negative are one rotation; the largest component becomes positive.
    let step =
        |v: f32| ((v * q[largest].signum() * std::f32::consts::FRAC_1_SQRT_2 + 0.5) * 255.0).round() as u8;
    let mut kept = (0..4).filter(|i| *i != largest).map(|i| step(q[i]));
    let mut next = || kept.next().expect("three are kept");
    [next(), next(), next(), FIRST_LEFT_OUT + largest as u8]
}

/// The Gaussians in the order of a Morton curve (Morton, "A computer oriented geodetic data base", 1966).
fn along_a_curve(stored: &Stored) -> Vec<u32> {
    let axes = [0, 1, 2].map(|axis| {
        let values = &stored.columns[axis];
        let (low, high) = range(values);
        (values, low, high)
    });
    // The longest side has 1024 steps.
    let longest = axes.iter().map(|(_, low, high)| high - low).fold(f32::MIN_POSITIVE, f32::max);
    let spread = |value: u32| (0..10).fold(0, |bits, bit| bits | (value >> bit & 1) << (3 * bit));
    let key = |i: usize| {
        axes.iter().enumerate().fold(0_u32, |key, (axis, (values, low, _))| {
            key | spread(((values[i] - low) / longest * 1023.0) as u32) << axis
        })
    };
    let mut order: Vec<(u32, u32)> = (0..stored.len()).map(|i| (key(i), i as u32)).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// A codebook: values in ascending order, to which the values of columns are rounded.
struct Codebook(Vec<f32>);

impl Codebook {
    fn of(columns: &[Vec<f32>]) -> Self {
        let mut values = columns.concat();
        values.iter_mut().for_each(|value| *value = value.clamp(-MOST, MOST));
        values.sort_unstable_by(f32::total_cmp);
        let mut sums = vec![0.0];
        for value in &values {
            sums.push(sums[sums.len() - 1] + f64::from(*value));
        }
        let (low, high) = (values[0], values[values.len() - 1]);
        // Half of the codes are quantiles, half are even steps of the range, so that rare values have a code nearby.
        let mut codes: Vec<f32> = (0..CODES / 2)
            .flat_map(|i| {
                let last = CODES / 2 - 1;
                let share = i as f32 / last as f32;
                [values[i * (values.len() - 1) / last], low + share * (high - low)]
            })
            .collect();
        for _ in 0..ROUNDS {
            codes.sort_unstable_by(f32::total_cmp);
            let mut first = 0;
            for k in 0..CODES {
                let end = match codes.get(k + 1) {
                    Some(next) => values.partition_point(|v| *v < 0.5 * (codes[k] + next)).max(first),
                    None => values.len(),
                };
                if end > first {
                    codes[k] = ((sums[end] - sums[first]) / (end - first) as f64) as f32;
                }
                first = end;
            }
        }
        codes.sort_unstable_by(f32::total_cmp);
        Self(codes)
    }

    fn nearest(&self, value: f32) -> u8 {
        let above = self.0.partition_point(|code| *code < value).min(CODES - 1);
        let below = above.saturating_sub(1);
        if (self.0[above] - value).abs() < (value - self.0[below]).abs() { above as u8 } else { below as u8 }
    }
}
