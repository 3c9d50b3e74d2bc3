//! Reading of Gaussian PLY files: ASCII and binary of either endianness, SH degree 0 to 3, properties in any order,
//! further properties and elements ignored.

use std::io::{self, BufRead, BufReader, Cursor, Read};

use super::Y_DOWN;
use super::header::{Element, Format, Header, MAX_HEADER, Property, parse};
use crate::stored::{COEFFICIENTS, Problem, Stored};
use snapsnap_base::quoted;

/// Longest line of a body in text.
const MAX_LINE: u64 = 1 << 20;

/// Reads a PLY's Gaussians. The input is read as far as the header promises, not to its end.
pub(crate) fn read(mut input: impl Read) -> Result<Stored, Problem> {
    let mut start = Vec::new();
    (&mut input).take(MAX_HEADER as u64 + 1).read_to_end(&mut start)?;
    let header = parse(&start)?;
    let mut body = BufReader::new(Cursor::new(start.split_off(header.len)).chain(input));
    let mut stored = table(&header, &mut body)?;
    if header.comments.iter().any(|comment| comment == Y_DOWN) {
        stored.turn(true);
    }
    Ok(stored)
}

fn table(header: &Header, body: &mut impl BufRead) -> Result<Stored, Problem> {
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
    for name in Stored::COLUMNS {
        wanted.push(position(name).ok_or_else(|| {
            let found: Vec<String> = vertex.properties.iter().map(|p| quoted(&p.name)).take(12).collect();
            format!(
                "`vertex` has no property `{name}`: not a file of Gaussians (it has {})",
                found.join(", ")
            )
        })?);
    }
    let rest = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let Some(coefficients) = COEFFICIENTS.into_iter().find(|count| 3 * (count - 1) == rest) else {
        let message = format!("{rest} properties `f_rest_*`; SH of degree 0 to 3 have 0, 9, 24 or 45");
        return Err(message.into());
    };
    for index in 0..rest {
        let name = format!("f_rest_{index}");
        wanted.push(position(&name).ok_or_else(|| format!("`vertex` has no property `{name}`"))?);
    }
    let columns = match header.format {
        Format::Ascii => ascii(header, at, body, &wanted)?,
        Format::LittleEndian | Format::BigEndian => binary(header, at, body, &wanted)?,
    };
    Ok(Stored { coefficients, columns })
}

/// The problem of a file that ends within its vertices.
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
        // No property is wanted twice, so each is reversed only once.
        rows.chunks_exact_mut(stride).map(value).collect()
    };
    Ok(wanted.iter().map(column).collect())
}

/// Skips an element; `false` if the file is too short for it.
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
