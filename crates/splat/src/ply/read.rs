//! Reading of Gaussian PLY files: ASCII and binary of either endianness, SH degree 0 to 3, properties in any order,
//! further properties and elements ignored.

use std::io::{BufRead, BufReader, Cursor, Read};

use super::body::Body;
use super::header::{Header, MAX_HEADER, Scalar, parse};
use super::{Y_DOWN, compressed};
use crate::sh;
use crate::stored::{COEFFICIENTS, Problem, Stored};
use snapsnap_base::quoted;

/// Reads a PLY's Gaussians. The input is read as far as the header promises, not to its end.
pub(crate) fn read(mut input: impl Read) -> Result<Stored, Problem> {
    let mut start = Vec::new();
    (&mut input).take(MAX_HEADER as u64 + 1).read_to_end(&mut start)?;
    let header = parse(&start)?;
    let body = BufReader::new(Cursor::new(start.split_off(header.len)).chain(input));
    let body = Body::new(body, header.format);
    let is_compressed = compressed::is_compressed(&header);
    let mut stored = if is_compressed { compressed::read(&header, body) } else { table(&header, body) }?;
    if header.comments.iter().any(|comment| comment == Y_DOWN) {
        stored.turn(true);
    }
    Ok(stored)
}

fn table(header: &Header, mut body: Body<impl BufRead>) -> Result<Stored, Problem> {
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
    // Other programs write colours of points.
    let is_colored = position("f_dc_0").is_none() && position("red").is_some();
    for name in Stored::COLUMNS {
        let name = match name {
            "f_dc_0" if is_colored => "red",
            "f_dc_1" if is_colored => "green",
            "f_dc_2" if is_colored => "blue",
            name => name,
        };
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
    let mut columns = vec![Vec::new(); wanted.len()];
    let mut column_of = vec![None; vertex.properties.len()];
    wanted.iter().enumerate().for_each(|(column, property)| column_of[*property] = Some(column));
    header.elements[..at].iter().try_for_each(|element| body.skip(element))?;
    for row in 0..vertex.count {
        body.row(vertex, row, 1, |property, value| {
            if let Some(column) = column_of[property] {
                columns[column].push(value.number()?);
            }
            Some(())
        })?;
    }
    if is_colored {
        let white = if vertex.properties[wanted[11]].kind == Scalar::U8 { 255.0 } else { 1.0 };
        columns[11..14].iter_mut().flatten().for_each(|value| *value = (*value / white - 0.5) / sh::C0);
    }
    Ok(Stored { coefficients, columns })
}
