//! Niantic's SPZ: quantised Gaussians, column by column, in one gzip stream, or from version 4 on in a Zstandard stream
//! for each kind of columns. Version 3 is written, versions 1 to 4 are read. SH of degree 4 lose their highest degree.
//!
//! The axes are x right, y up, z back, as in the world frame; nothing is rotated. Layout: github.com/nianticlabs/spz,
//! README ("File Format").

use std::io::{self, Read, Write};
use std::ops::{Range, RangeInclusive};

use burn::tensor::f16;
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use crate::stored::{COEFFICIENTS, Problem, Stored, check_ratio, logit, unit};

/// First bytes of a gzip stream.
pub(crate) const GZIP: [u8; 2] = [0x1f, 0x8b];
/// First bytes of version 4, which is not one gzip stream.
pub(crate) const BARE: [u8; 2] = *b"NG";
const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// The version whose columns have streams of their own.
const STREAMS: u32 = 4;
/// Bytes of its header, and of a stream's entry in the table behind it: compressed and decompressed length.
const HEADER: usize = 32;
const ENTRY: usize = 16;
/// Number of Gaussians of the largest file that Niantic's library reads. It limits the memory for a hostile file,
/// which may decompress to a thousand times its size.
const MAX_POINTS: usize = 10_000_000;
/// Most bytes of extensions that are read.
const EXTENSIONS: u64 = 1 << 24;
/// Fractional bits of coordinates, if they fit: steps of a quarter of a millimetre up to 2 km.
const FRACTIONAL_BITS: u8 = 12;
/// Largest coordinate in 24 bits.
const MAX_FIXED: f64 = 8_388_607.0;
/// Factor from a coefficient of SH degree 0 to its byte.
const COLOR_SCALE: f32 = 0.15;
/// Quantisation steps of SH coefficients of degree 1 and above 1, as in Niantic's library. Coarse steps compress well.
const SH_STEPS: [i32; 2] = [8, 16];

/// Reads a gzip stream of `length` bytes.
pub(crate) fn read(input: impl Read, length: u64) -> Result<Stored, Problem> {
    let mut input = GzDecoder::new(input);
    let header = take(&mut input, 16, "the header")?;
    let stored = columns(&header, 1..=VERSION, length, &mut |size, what| take(&mut input, size, what))?;
    // Read to the end, so that the decoder verifies the checksum. Extensions after the Gaussians are skipped; if they
    // are longer than `EXTENSIONS` bytes, the rest is not read.
    io::copy(&mut input.take(EXTENSIONS), &mut io::sink()).map_err(damaged)?;
    Ok(stored)
}

/// Reads a file of version 4 and of `length` bytes.
pub(crate) fn read_streams(mut input: impl Read, length: u64) -> Result<Stored, Problem> {
    let header = take(&mut input, HEADER, "the header")?;
    let table = usize::try_from(word(&header, 16)).unwrap_or(usize::MAX);
    let gap = table.checked_sub(HEADER).filter(|gap| (*gap as u64) < length);
    let gap = gap.ok_or_else(|| "the table of its streams is not in the file".to_owned())?;
    take(&mut input, gap, "extensions")?;
    let table = take(&mut input, ENTRY * usize::from(header[15]), "the table of streams")?;
    let mut entries = table.chunks_exact(ENTRY);
    columns(&header, STREAMS..=STREAMS, length, &mut |size, what| {
        let entry = entries.next().ok_or_else(|| format!("there is no stream of {what}"))?;
        let compressed = u64::from_le_bytes(entry[..8].try_into().expect("eight bytes"));
        let mut stream = (&mut input).take(compressed);
        let damaged =
            |e: &dyn std::fmt::Display| Problem::from(format!("the stream of {what} is damaged: {e}"));
        let decoder = ruzstd::decoding::StreamingDecoder::new(&mut stream).map_err(|e| damaged(&e))?;
        let mut bytes = Vec::new();
        decoder.take(size as u64 + 1).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
        if bytes.len() != size {
            return Err(damaged(&format_args!("{} bytes instead of {size}", bytes.len())));
        }
        io::copy(&mut stream, &mut io::sink())?;
        Ok(bytes)
    })
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// Reads the next bytes, of columns with this name.
type Take<'a> = dyn FnMut(usize, &str) -> Result<Vec<u8>, Problem> + 'a;

/// The Gaussians of a file with this header and a version among `versions`. `take` returns the next columns' bytes.
fn columns(
    header: &[u8],
    versions: RangeInclusive<u32>,
    length: u64,
    take: &mut Take,
) -> Result<Stored, Problem> {
    let word = |at: usize| word(header, at);
    if word(0) != MAGIC {
        return Err("a gzip stream, but no SPZ in it (its magic is missing)".to_owned().into());
    }
    let version = word(4);
    if !versions.contains(&version) {
        return Err(format!("SPZ of version {version}; 1 to {STREAMS} are read").into());
    }
    let n = word(8) as usize;
    if n > MAX_POINTS {
        return Err(format!("{n} Gaussians; SPZ files have {MAX_POINTS} at most").into());
    }
    let [degree, bits] = [header[12], header[13]];
    if degree > 4 {
        return Err(format!("SH of degree {degree}; an SPZ has 0 to 4").into());
    }
    if bits > 24 {
        return Err(format!("coordinates with {bits} fractional bits; 24 are possible").into());
    }
    // Values per channel.
    let there = (usize::from(degree) + 1).pow(2);
    let size = if version >= VERSION { 4 } else { 3 };
    let centre = if version == 1 { 6 } else { 9 };
    let content = (n * (centre + 7 + size + 3 * (there - 1))) as u64;
    check_ratio(n, content, length)?;
    let coefficients = there.min(COEFFICIENTS[3]);
    let mut columns = Vec::with_capacity(Stored::COLUMNS.len() + 3 * (coefficients - 1));

    if version == 1 {
        let halves = take(6 * n, "centres")?;
        for axis in 0..3 {
            let half = |p: &[u8]| f16::from_le_bytes([p[2 * axis], p[2 * axis + 1]]).to_f32();
            columns.push(halves.chunks_exact(6).map(half).collect());
        }
    } else {
        let fixed = take(9 * n, "centres")?;
        let unit = f64::from(bits).exp2().recip();
        for axis in 0..3 {
            let value = |p: &[u8]| {
                // A shift into the upper bytes and back extends the sign.
                let [a, b, c] = [0, 1, 2].map(|i| p[3 * axis + i]);
                (f64::from(i32::from_le_bytes([0, a, b, c]) >> 8) * unit) as f32
            };
            columns.push(fixed.chunks_exact(9).map(value).collect());
        }
    }
    // The first and the last step move inwards by a quarter step, to be finite.
    let logit = |step: &u8| logit(f32::from(*step).clamp(0.25, 254.75) / 255.0);
    let opacities: Vec<f32> = take(n, "opacities")?.iter().map(logit).collect();
    let colors = take(3 * n, "colours")?;
    let scales = take(3 * n, "scales")?;
    let rotations = take(size * n, "rotations")?;
    let mut quaternions = [(); 4].map(|()| Vec::with_capacity(n));
    for packed in rotations.chunks_exact(size) {
        let q = match *packed {
            [a, b, c, d] => unpack_smallest_three(u32::from_le_bytes([a, b, c, d])),
            _ => first_three([packed[0], packed[1], packed[2]]),
        };
        quaternions.iter_mut().zip(q).for_each(|(column, value)| column.push(value));
    }
    columns.extend(quaternions);
    for axis in 0..3 {
        columns.push(scales.chunks_exact(3).map(|s| f32::from(s[axis]) / 16.0 - 10.0).collect());
    }
    columns.push(opacities);
    for channel in 0..3 {
        let color = |c: &[u8]| (f32::from(c[channel]) / 255.0 - 0.5) / COLOR_SCALE;
        columns.push(colors.chunks_exact(3).map(color).collect());
    }
    if there > 1 {
        let stride = 3 * (there - 1);
        let bands = take(stride * n, "spherical harmonics")?;
        for channel in 0..3 {
            for band in 0..coefficients - 1 {
                let value = |s: &[u8]| (f32::from(s[3 * band + channel]) - 128.0) / 128.0;
                columns.push(bands.chunks_exact(stride).map(value).collect());
            }
        }
    }
    Ok(Stored { coefficients, columns })
}

/// Refuses values that an SPZ cannot hold.
pub(crate) fn check(stored: &Stored) -> Result<(), String> {
    let n = stored.len();
    if n > MAX_POINTS {
        return Err(format!("{n} Gaussians are more than an SPZ holds ({MAX_POINTS}): write a PLY"));
    }
    if largest(stored) > MAX_FIXED {
        return Err(format!("centres lie {} m away, an SPZ reaches 8,388 km", largest(stored)));
    }
    Ok(())
}

/// Losses beyond the usual quantisation of an SPZ, one sentence each. Scales below e⁻¹⁰ m (45 µm) become e⁻¹⁰ m,
/// which is invisible and not listed.
pub(crate) fn losses(stored: &Stored) -> Vec<String> {
    let mut losses = Vec::new();
    let bits = fractional_bits(stored);
    if bits < FRACTIONAL_BITS {
        let (step, largest) = (1e3 / f64::from(bits).exp2(), largest(stored));
        losses.push(format!("centres are kept in steps of {step:.1} mm, since one lies {largest:.0} m away"));
    }
    let mut count = |columns: Range<usize>, beyond: &dyn Fn(f64) -> bool, text: &str| {
        let has =
            |i: &usize| stored.columns[columns.clone()].iter().any(|column| beyond(f64::from(column[*i])));
        let count = (0..stored.len()).filter(has).count();
        if count > 0 {
            losses.push(format!("{count} Gaussians have {text}, and are cut off there"));
        }
    };
    // Values up to half a step beyond the range round to its last step.
    let beyond = |step: f64| !(0.0..=255.0).contains(&step.round());
    count(7..10, &|v| 16.0 * (v + 10.0) > 255.5, "scales beyond 379 m");
    count(11..14, &|v| beyond(255.0 * (v * f64::from(COLOR_SCALE) + 0.5)), "colours (f_dc) beyond ±3.33");
    count(14..stored.columns.len(), &|v| v.abs() > 1.0, "spherical harmonics beyond ±1");
    losses
}

fn fractional_bits(stored: &Stored) -> u8 {
    let largest = largest(stored);
    let fits = |bits: &u8| (largest * f64::from(*bits).exp2()).round() <= MAX_FIXED;
    (0..=FRACTIONAL_BITS).rev().find(fits).unwrap_or(0)
}

fn largest(stored: &Stored) -> f64 {
    stored.columns[..3].iter().flatten().fold(0.0, |most, v| most.max(f64::from(v.abs())))
}

/// Writes a gzip stream of Gaussians that [`check`] accepts.
pub(crate) fn write(stored: &Stored, out: &mut impl Write) -> io::Result<()> {
    let (n, bits) = (stored.len(), fractional_bits(stored));
    let mut out = GzEncoder::new(out, Compression::best());
    out.write_all(&MAGIC.to_le_bytes())?;
    out.write_all(&VERSION.to_le_bytes())?;
    out.write_all(&u32::try_from(n).map_err(io::Error::other)?.to_le_bytes())?;
    out.write_all(&[u8::try_from(stored.degree()).map_err(io::Error::other)?, bits, 0, 0])?;

    // Writes some columns row after row; `bytes` encodes a row.
    let mut rows = |range: Range<usize>, bytes: &dyn Fn(&[f32], &mut Vec<u8>)| {
        let mut row = vec![0.0; range.len()];
        let mut block = Vec::new();
        for i in 0..n {
            row.iter_mut().zip(&stored.columns[range.clone()]).for_each(|(value, column)| *value = column[i]);
            bytes(&row, &mut block);
            if block.len() > 1 << 16 || i + 1 == n {
                out.write_all(&block)?;
                block.clear();
            }
        }
        Ok::<_, io::Error>(())
    };
    let unit = f64::from(bits).exp2();
    rows(0..3, &|row, block| {
        for &v in row {
            let fixed = (f64::from(v) * unit).round() as i32;
            block.extend_from_slice(&fixed.to_le_bytes()[..3]);
        }
    })?;
    let each = |f: fn(f32) -> f32| {
        move |row: &[f32], block: &mut Vec<u8>| block.extend(row.iter().map(|&v| byte(f(v))))
    };
    rows(10..11, &each(|v| 255.0 / (1.0 + (-v).exp())))?;
    rows(11..14, &each(|v| 255.0 * (v * COLOR_SCALE + 0.5)))?;
    rows(7..10, &each(|v| 16.0 * (v + 10.0)))?;
    rows(3..7, &|row, block| {
        block.extend_from_slice(&pack_smallest_three([row[0], row[1], row[2], row[3]]).to_le_bytes());
    })?;
    let bands = stored.coefficients - 1;
    rows(14..14 + 3 * bands, &|row, block| {
        for band in 0..bands {
            let step = SH_STEPS[usize::from(band >= 3)];
            block.extend((0..3).map(|channel| sh_byte(row[channel * bands + band], step)));
        }
    })?;
    out.finish().map(drop)
}

/// The next bytes of the decompressed stream. Memory grows with the data, not with the header's promises.
fn take(input: &mut impl Read, length: usize, what: &str) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    input.take(length as u64).read_to_end(&mut bytes).map_err(damaged)?;
    if bytes.len() < length {
        return Err(format!("the file ends too early: {} of {length} bytes of {what}", bytes.len()).into());
    }
    Ok(bytes)
}

/// The problem of a read error: a stream that is cut or has a wrong checksum is a damaged file, no failing disk.
fn damaged(e: io::Error) -> Problem {
    match e.kind() {
        io::ErrorKind::UnexpectedEof => "the file ends too early: its gzip stream is cut".to_owned().into(),
        io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData => {
            format!("its gzip stream is damaged: {e}").into()
        }
        _ => Problem::Io(e),
    }
}

/// The nearest byte; 0 for NaN.
fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// The byte of a coefficient, rounded to a multiple of `step`.
fn sh_byte(value: f32, step: i32) -> u8 {
    let q = (value * 128.0).round().clamp(-128.0, 127.0) as i32 + 128;
    (((q + step / 2) / step) * step).clamp(0, 255) as u8
}

/// A quaternion (w, x, y, z) of versions 1 and 2: a byte each for x, y and z, from which w ≥ 0 follows.
fn first_three(packed: [u8; 3]) -> [f32; 4] {
    let [x, y, z] = packed.map(|v| f32::from(v) / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
}

/// Mask of the magnitude of a component in version 3.
const COMPONENT: u32 = (1 << 9) - 1;

/// A quaternion (w, x, y, z) of version 3: the index of the largest of (x, y, z, w), then signs and magnitudes of the
/// other components, divided by √½.
fn unpack_smallest_three(mut packed: u32) -> [f32; 4] {
    let largest = (packed >> 30) as usize;
    let mut q = [0.0_f32; 4];
    let mut sum = 0.0;
    for i in (0..4).rev().filter(|&i| i != largest) {
        let size = std::f32::consts::FRAC_1_SQRT_2 * (packed & COMPONENT) as f32 / COMPONENT as f32;
        q[i] = if packed >> 9 & 1 == 1 { -size } else { size };
        sum += size * size;
        packed >>= 10;
    }
    q[largest] = (1.0 - sum).max(0.0).sqrt();
    [q[3], q[0], q[1], q[2]]
}

/// The inverse of [`unpack_smallest_three`]. Quaternions may have any length; length 0 becomes the identity.
fn pack_smallest_three(wxyz: [f32; 4]) -> u32 {
    let [w, x, y, z] = unit(wxyz);
    let q = [x, y, z, w];
    // The first of equal components.
    let largest = (0..4).rev().max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).expect("four components");
    let others = (0..4).filter(|&i| i != largest);
    others.fold(largest as u32, |packed, i| {
        let size = (COMPONENT as f32 * q[i].abs() / std::f32::consts::FRAC_1_SQRT_2 + 0.5) as u32;
        let negative = (q[i] < 0.0) != (q[largest] < 0.0);
        packed << 10 | u32::from(negative) << 9 | size.min(COMPONENT)
    })
}

#[cfg(test)]
mod tests;
