//! Reading of Gaussian PLY files: ASCII and binary of either endianness, SH degree 0 to 3, properties in any order,
//! further properties and elements ignored.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};

use super::header::{Element, Format, Header, MAX_HEADER, Property, parse};
use crate::error::quoted;
use crate::{Gaussians, SplatError, sh};

/// Every property that must be there, in the order in which they are gathered.
const REQUIRED: [&str; 14] = [
    "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity", "f_dc_0",
    "f_dc_1", "f_dc_2",
];

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
    let wrong = |problem| SplatError::Ply { path: path.to_owned(), problem };
    let cannot = |source| SplatError::Read { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(cannot)?;
    let mut bytes = Vec::new();
    (&mut file).take(MAX_HEADER as u64 + 1).read_to_end(&mut bytes).map_err(cannot)?;
    // Before the rest of a file that may be anything.
    let header = parse(&bytes).map_err(wrong)?;
    file.read_to_end(&mut bytes).map_err(cannot)?;
    let table = table(&header, &mut bytes).map_err(wrong)?;
    drop(bytes);
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

fn table(header: &Header, bytes: &mut [u8]) -> Result<Table, String> {
    let at = header.elements.iter().position(|e| e.name == "vertex").ok_or("it has no element `vertex`")?;
    let vertex = &header.elements[at];
    if let Some(list) = vertex.properties.iter().find(|p| p.list.is_some()) {
        return Err(format!("`vertex` has a list, `{}`; Gaussians are single values", quoted(&list.name)));
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
        _ => return Err(format!("{rest} properties `f_rest_*`; SH of degree 0 to 3 have 0, 9, 24 or 45")),
    };
    for index in 0..rest {
        let name = format!("f_rest_{index}");
        wanted.push(position(&name).ok_or_else(|| format!("`vertex` has no property `{name}`"))?);
    }
    let body = &mut bytes[header.len..];
    let columns = match header.format {
        Format::Ascii => ascii(header, at, body, &wanted)?,
        Format::LittleEndian | Format::BigEndian => binary(header, at, body, &wanted)?,
    };
    Ok(Table { n: vertex.count, coefficients, columns })
}

/// Where row `row` of `vertex` cannot be read to its end.
fn truncated(vertex: &Element, detail: &str) -> String {
    format!("the file ends too early: the header promises {} vertices, {detail}", vertex.count)
}

fn ascii(header: &Header, at: usize, body: &[u8], wanted: &[usize]) -> Result<Vec<Vec<f32>>, String> {
    let text = std::str::from_utf8(body).map_err(|_| "the body is not text, though the format is ascii")?;
    // One row per line, as the format demands; elements before the vertices are skipped.
    let before: usize = header.elements[..at].iter().fold(0, |sum, e| sum.saturating_add(e.count));
    let vertex = &header.elements[at];
    // A value and its separator take two bytes: never reserve more than the file can hold.
    if vertex.count > body.len() / (2 * vertex.properties.len()) + 1 {
        return Err(truncated(vertex, &format!("{} bytes follow it", body.len())));
    }
    let mut columns: Vec<Vec<f32>> = wanted.iter().map(|_| Vec::with_capacity(vertex.count)).collect();
    let mut lines = text.lines().filter(|line| !line.trim().is_empty()).skip(before);
    let mut values = Vec::with_capacity(vertex.properties.len());
    for row in 0..vertex.count {
        let line = lines.next().ok_or_else(|| truncated(vertex, &format!("{row} are there")))?;
        values.clear();
        values.extend(line.split_ascii_whitespace());
        if values.len() != vertex.properties.len() {
            let (found, expected) = (values.len(), vertex.properties.len());
            return Err(format!("vertex {row}: {found} values, expected {expected}"));
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

fn binary(header: &Header, at: usize, body: &mut [u8], wanted: &[usize]) -> Result<Vec<Vec<f32>>, String> {
    let big = header.format == Format::BigEndian;
    let mut start = 0;
    for element in &header.elements[..at] {
        start = skip(element, body, start, big)
            .ok_or_else(|| format!("the file ends too early: in element `{}`", quoted(&element.name)))?;
    }
    let vertex = &header.elements[at];
    let stride: usize = vertex.properties.iter().map(|p| p.kind.size()).sum();
    let available = body.len() - start;
    let needed =
        vertex.count.checked_mul(stride).filter(|needed| *needed <= available).ok_or_else(|| {
            truncated(vertex, &format!("{stride} bytes each, but {available} bytes are left"))
        })?;
    let rows = &mut body[start..start + needed];
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

/// Where the body goes on after `element`, which starts at `start`; `None` if the file is too short.
fn skip(element: &Element, body: &[u8], start: usize, big: bool) -> Option<usize> {
    let fixed: usize = element.properties.iter().map(|p| p.kind.size()).sum();
    if element.properties.iter().all(|p| p.list.is_none()) {
        return start.checked_add(element.count.checked_mul(fixed)?).filter(|end| *end <= body.len());
    }
    let mut at = start;
    for _ in 0..element.count {
        for Property { kind, list, .. } in &element.properties {
            let items = match list {
                None => 1,
                Some(length) => {
                    let mut bytes = body.get(at..at.checked_add(length.size())?)?.to_vec();
                    if big {
                        bytes.reverse();
                    }
                    at += length.size();
                    length.read_count(&bytes)?
                }
            };
            at = at.checked_add(items.checked_mul(kind.size())?).filter(|end| *end <= body.len())?;
        }
    }
    Some(at)
}
