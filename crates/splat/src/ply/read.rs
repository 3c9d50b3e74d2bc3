//! Reading of Gaussian PLY files: ASCII and binary of either endianness, SH degree 0 to 3, properties in any order,
//! further properties and elements ignored.

use std::io::{self, BufRead, BufReader, Cursor, Read};
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};

use super::header::{Element, Format, Header, MAX_HEADER, Property, parse};
use crate::error::quoted;
use crate::file;
use crate::{Gaussians, SplatError, sh};

/// Every property that must be there, in the order in which they are gathered.
const REQUIRED: [&str; 14] = [
    "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity", "f_dc_0",
    "f_dc_1", "f_dc_2",
];

/// Longest line of a body in text.
const MAX_LINE: u64 = 1 << 20;

/// What keeps a file from being read.
enum Problem {
    Io(io::Error),
    Ply(String),
}

impl From<io::Error> for Problem {
    fn from(e: io::Error) -> Self {
        Self::Io(e)
    }
}

impl From<String> for Problem {
    fn from(problem: String) -> Self {
        Self::Ply(problem)
    }
}

/// A file's Gaussians.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// After activation; colours are those of SH degree 0, max(0, ½ + C₀·f_dc).
    pub gaussians: Gaussians,
    /// Coefficients `[N,K,3]` for [`sh::colors`], where the file has a degree above 0.
    pub harmonics: Option<Tensor<3>>,
}

/// Reads the Gaussians of `path` onto `device`. Values that are not finite are kept, a render counts and leaves them
/// out.
///
/// # Errors
/// [`SplatError::Read`] if the file cannot be read, [`SplatError::Ply`] if it is no PLY, is shorter than its header
/// says, or lacks a property.
pub fn read(path: &Path, device: &Device) -> Result<Loaded, SplatError> {
    let cannot = |source| SplatError::Read { path: path.to_owned(), source };
    let failed = |problem| match problem {
        Problem::Io(source) => cannot(source),
        Problem::Ply(problem) => SplatError::Ply { path: path.to_owned(), problem },
    };
    let mut file = file::open(path).map_err(cannot)?;
    let mut start = Vec::new();
    (&mut file).take(MAX_HEADER as u64 + 1).read_to_end(&mut start).map_err(cannot)?;
    let header = parse(&start).map_err(|problem| failed(Problem::Ply(problem)))?;
    // Only what the header promises is read of a file that may go on for ever.
    let mut body = BufReader::new(Cursor::new(start.split_off(header.len)).chain(file));
    let table = table(&header, &mut body).map_err(failed)?;
    let Table { n, coefficients: k, columns } = table;
    let rows = |names: usize, first: usize, f: fn(f32) -> f32| {
        let values: Vec<f32> = (0..n)
            .flat_map(|i| (first..first + names).map(move |c| (c, i)))
            .map(|(c, i)| f(columns[c][i]))
            .collect();
        Tensor::<2>::from_data(TensorData::new(values, [n, names]), device)
    };
    let opacities = columns[10].iter().map(|o| 1.0 / (1.0 + (-o).exp())).collect::<Vec<f32>>();
    let gaussians = Gaussians::new(
        rows(3, 0, |v| v),
        rows(4, 3, |v| v),
        rows(3, 7, f32::exp),
        Tensor::from_data(TensorData::new(opacities, [n]), device),
        rows(3, 11, |v| {
            let color = 0.5 + sh::C0 * v;
            // Not `max`: it would turn a NaN into black.
            if color < 0.0 && color.is_finite() { 0.0 } else { color }
        }),
    )?;
    let harmonics = (k > 1).then(|| {
        // In the file all coefficients of red come first, then green, then blue.
        let value = |i: usize, band: usize, channel: usize| match band {
            0 => columns[11 + channel][i],
            band => columns[REQUIRED.len() + channel * (k - 1) + band - 1][i],
        };
        let bands = |i: usize| (0..k).flat_map(move |band| (0..3).map(move |c| (i, band, c)));
        let values: Vec<f32> = (0..n).flat_map(bands).map(|(i, band, c)| value(i, band, c)).collect();
        Tensor::<3>::from_data(TensorData::new(values, [n, k, 3]), device)
    });
    Ok(Loaded { gaussians, harmonics })
}

/// The vertex element, column by column.
struct Table {
    n: usize,
    /// SH coefficients per channel: 1, 4, 9 or 16.
    coefficients: usize,
    /// [`REQUIRED`], then `f_rest_0` ….
    columns: Vec<Vec<f32>>,
}

fn table(header: &Header, body: &mut impl BufRead) -> Result<Table, Problem> {
    let at = header
        .elements
        .iter()
        .position(|e| e.name == "vertex")
        .ok_or_else(|| "it has no element `vertex`".to_owned())?;
    let vertex = &header.elements[at];
    if let Some(list) = vertex.properties.iter().find(|p| p.list.is_some()) {
        let list = quoted(&list.name);
        return Err(format!("`vertex` has a list, `{list}`; Gaussians are single values").into());
    }
    let position = |name: &str| vertex.properties.iter().position(|p| p.name == name);
    let mut wanted = Vec::new();
    for name in REQUIRED {
        wanted.push(position(name).ok_or_else(|| {
            let found: Vec<String> = vertex.properties.iter().map(|p| quoted(&p.name)).take(12).collect();
            format!(
                "`vertex` has no property `{name}`: not a file of Gaussians (it has {})",
                found.join(", ")
            )
        })?);
    }
    let rest = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let coefficients = match rest {
        0 => 1,
        9 => 4,
        24 => 9,
        45 => 16,
        _ => {
            let message = format!("{rest} properties `f_rest_*`; SH of degree 0 to 3 have 0, 9, 24 or 45");
            return Err(message.into());
        }
    };
    for index in 0..rest {
        let name = format!("f_rest_{index}");
        wanted.push(position(&name).ok_or_else(|| format!("`vertex` has no property `{name}`"))?);
    }
    let columns = match header.format {
        Format::Ascii => ascii(header, at, body, &wanted)?,
        Format::LittleEndian | Format::BigEndian => binary(header, at, body, &wanted)?,
    };
    Ok(Table { n: vertex.count, coefficients, columns })
}

/// Where `vertex` cannot be read to its end.
fn truncated(vertex: &Element, detail: &str) -> Problem {
    let count = vertex.count;
    format!("the file ends too early: the header promises {count} vertices, {detail}").into()
}

fn ascii(
    header: &Header,
    at: usize,
    body: &mut impl BufRead,
    wanted: &[usize],
) -> Result<Vec<Vec<f32>>, Problem> {
    // One row per line, as the format demands; elements before the vertices are skipped.
    let before = header.elements[..at].iter().fold(0_usize, |sum, e| sum.saturating_add(e.count));
    let vertex = &header.elements[at];
    let mut columns: Vec<Vec<f32>> = wanted.iter().map(|_| Vec::new()).collect();
    let mut line = Vec::new();
    for _ in 0..before {
        if !next_line(body, &mut line)? {
            return Err(truncated(vertex, "0 are there"));
        }
    }
    for row in 0..vertex.count {
        if !next_line(body, &mut line)? {
            return Err(truncated(vertex, &format!("{row} are there")));
        }
        let text = std::str::from_utf8(&line)
            .map_err(|_| "the body is not text, though the format is ascii".to_owned())?;
        let values: Vec<&str> = text.split_ascii_whitespace().collect();
        if values.len() != vertex.properties.len() {
            let (found, expected) = (values.len(), vertex.properties.len());
            return Err(format!("vertex {row}: {found} values, expected {expected}").into());
        }
        for (column, &index) in columns.iter_mut().zip(wanted) {
            let name = &vertex.properties[index].name;
            let value = values[index].parse();
            column.push(
                value.map_err(|_| {
                    format!("vertex {row}: `{name}` is `{}`, no number", quoted(values[index]))
                })?,
            );
        }
    }
    Ok(columns)
}

/// The next line that is not blank; `false` at the end of the file.
fn next_line(body: &mut impl BufRead, line: &mut Vec<u8>) -> Result<bool, Problem> {
    loop {
        line.clear();
        if body.take(MAX_LINE).read_until(b'\n', line)? == 0 {
            return Ok(false);
        }
        if line.len() as u64 == MAX_LINE && !line.ends_with(b"\n") {
            return Err(format!("a line of the body is longer than {MAX_LINE} bytes").into());
        }
        if !line.trim_ascii().is_empty() {
            return Ok(true);
        }
    }
}

fn binary(
    header: &Header,
    at: usize,
    body: &mut impl BufRead,
    wanted: &[usize],
) -> Result<Vec<Vec<f32>>, Problem> {
    let big = header.format == Format::BigEndian;
    for element in &header.elements[..at] {
        if !skip(element, body, big)? {
            let name = quoted(&element.name);
            return Err(format!("the file ends too early: in element `{name}`").into());
        }
    }
    let vertex = &header.elements[at];
    let stride: usize = vertex.properties.iter().map(|p| p.kind.size()).sum();
    let needed = (vertex.count as u64).saturating_mul(stride as u64);
    let mut rows = Vec::new();
    body.take(needed).read_to_end(&mut rows)?;
    if (rows.len() as u64) < needed {
        let detail = format!("{stride} bytes each, but {} bytes are left", rows.len());
        return Err(truncated(vertex, &detail));
    }
    let offset = |index: usize| vertex.properties[..index].iter().map(|p| p.kind.size()).sum::<usize>();
    let column = |&index: &usize| {
        let (kind, offset) = (vertex.properties[index].kind, offset(index));
        let value = |row: &mut [u8]| {
            let bytes = &mut row[offset..offset + kind.size()];
            if big {
                bytes.reverse();
            }
            kind.read(bytes)
        };
        // No property is wanted twice, so that each is reversed once.
        rows.chunks_exact_mut(stride).map(value).collect()
    };
    Ok(wanted.iter().map(column).collect())
}

/// Leaves an element out; `false` if the file is too short for it.
fn skip(element: &Element, body: &mut impl BufRead, big: bool) -> io::Result<bool> {
    let pass = |body: &mut dyn BufRead, bytes: Option<u64>| -> io::Result<bool> {
        let Some(bytes) = bytes else { return Ok(false) };
        Ok(io::copy(&mut body.take(bytes), &mut io::sink())? == bytes)
    };
    let fixed: usize = element.properties.iter().map(|p| p.kind.size()).sum();
    if element.properties.iter().all(|p| p.list.is_none()) {
        return pass(body, (element.count as u64).checked_mul(fixed as u64));
    }
    for _ in 0..element.count {
        for Property { kind, list, .. } in &element.properties {
            let mut items = Some(1);
            if let Some(length) = list {
                let mut bytes = Vec::new();
                body.take(length.size() as u64).read_to_end(&mut bytes)?;
                if bytes.len() < length.size() {
                    return Ok(false);
                }
                if big {
                    bytes.reverse();
                }
                items = length.read_count(&bytes);
            }
            if !pass(body, items.and_then(|n| (n as u64).checked_mul(kind.size() as u64)))? {
                return Ok(false);
            }
        }
    }
    Ok(true)
}
