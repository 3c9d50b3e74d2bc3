//! PLY meshes, ASCII and binary of either endianness: vertex colours, or a texture with coordinates per vertex or per
//! corner.

use std::path::Path;
use std::str::SplitAsciiWhitespace;

use glam::{Vec2, Vec3};
use snapsnap_base::file;
use snapsnap_base::quoted;
use snapsnap_splat::ply::header::{Element, Format, Scalar, parse};

use super::{MAX_BYTES, Textures};
use crate::mesh::{Face, Material, Mesh};
use snapsnap_base::FileError;

/// Most corners of a face; a longer list is a damaged file.
const MAX_CORNERS: usize = 1 << 16;

pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    let wrong = |problem: String| FileError::unsuitable(path, problem);
    let header = parse(&bytes).map_err(wrong)?;
    let body = &bytes[header.len..];
    let mut body = match header.format {
        Format::Ascii => Body::Text(
            std::str::from_utf8(body)
                .map_err(|_| wrong("the body is not text, though the format is ascii".into()))?
                .split_ascii_whitespace(),
        ),
        format => Body::Binary { bytes: body, big: format == Format::BigEndian },
    };
    let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" => vertices(element, &mut body, &mut mesh),
            "face" => faces(element, &mut body, &mut mesh),
            _ => skip(element, &mut body),
        }
        .map_err(wrong)?;
    }
    let named = header.comments.iter().find_map(|comment| comment.strip_prefix("TextureFile"));
    if let Some(name) = named {
        mesh.materials[0].texture = Some(Textures::of(path).load(name.trim())?);
    }
    Ok(mesh)
}

/// What follows the header.
enum Body<'a> {
    Text(SplitAsciiWhitespace<'a>),
    Binary { bytes: &'a [u8], big: bool },
}

/// The next value of a binary body, lowest byte first; only its type's bytes count.
fn take(bytes: &mut &[u8], kind: Scalar, big: bool) -> Option<[u8; 8]> {
    let (value, rest) = bytes.split_at_checked(kind.size())?;
    *bytes = rest;
    let mut out = [0; 8];
    out[..value.len()].copy_from_slice(value);
    if big {
        out[..value.len()].reverse();
    }
    Some(out)
}

impl Body<'_> {
    /// The next value as a number; `None` at the end and for text that is none.
    fn number(&mut self, kind: Scalar) -> Option<f32> {
        match self {
            Self::Text(words) => words.next()?.parse().ok(),
            Self::Binary { bytes, big } => take(bytes, kind, *big).map(|b| kind.read(&b)),
        }
    }

    /// The next value as a length or a row.
    fn count(&mut self, kind: Scalar) -> Option<usize> {
        match self {
            Self::Text(words) => words.next()?.parse().ok(),
            Self::Binary { bytes, big } => kind.read_count(&take(bytes, kind, *big)?[..kind.size()]),
        }
    }

    /// Rows that the rest can hold at most, of so many values each.
    fn rows(&self, element: &Element) -> usize {
        let (left, row): (usize, usize) = match self {
            // How long the rest of the text is, is not known; vectors grow with what is there.
            Self::Text(_) => (1 << 20, 1),
            Self::Binary { bytes, .. } => {
                let size = |kind: Scalar, list: Option<Scalar>| list.unwrap_or(kind).size();
                (bytes.len(), element.properties.iter().map(|p| size(p.kind, p.list)).sum())
            }
        };
        left / row.max(1)
    }
}

/// Where an element cannot be read on.
fn broken(element: &Element, row: usize, property: &str) -> String {
    format!(
        "{} {row} of {}: `{}` is missing or no number; the file may be cut off",
        quoted(&element.name),
        element.count,
        quoted(property)
    )
}

/// Columns by one of the names that exporters give them.
fn column(element: &Element, names: &[&str]) -> Option<usize> {
    element.properties.iter().position(|p| p.list.is_none() && names.contains(&p.name.as_str()))
}

fn vertices(element: &Element, body: &mut Body, mesh: &mut Mesh) -> Result<(), String> {
    let place = ["x", "y", "z"].map(|name| column(element, &[name]));
    let [Some(x), Some(y), Some(z)] = place else {
        return Err("`vertex` has no properties `x`, `y`, `z`".into());
    };
    let color = [["red", "r", "diffuse_red"], ["green", "g", "diffuse_green"], ["blue", "b", "diffuse_blue"]]
        .map(|names| column(element, &names));
    let color = match color {
        [Some(r), Some(g), Some(b)] => Some([r, g, b]),
        _ => None,
    };
    let s = column(element, &["s", "u", "texture_u"]);
    let texcoord = s.zip(column(element, &["t", "v", "texture_v"]));
    let capacity = element.count.min(body.rows(element));
    mesh.positions.reserve(capacity);
    let mut values = vec![0.0; element.properties.len()];
    for row in 0..element.count {
        for (value, property) in values.iter_mut().zip(&element.properties) {
            let end = || broken(element, row, &property.name);
            match property.list {
                None => *value = body.number(property.kind).ok_or_else(end)?,
                Some(length) => {
                    for _ in 0..body.count(length).ok_or_else(end)? {
                        body.number(property.kind).ok_or_else(end)?;
                    }
                }
            }
        }
        mesh.positions.push(Vec3::new(values[x], values[y], values[z]));
        if let Some(columns) = color {
            // Whole numbers count to 255; floats are shares already.
            let [r, g, b] = columns.map(|c| match element.properties[c].kind {
                Scalar::F32 | Scalar::F64 => values[c],
                Scalar::U16 => values[c] / 65_535.0,
                _ => values[c] / 255.0,
            });
            mesh.colors.push(Vec3::new(r, g, b));
        }
        if let Some((s, t)) = texcoord {
            mesh.texcoords.push(Vec2::new(values[s], values[t]));
        }
    }
    Ok(())
}

fn faces(element: &Element, body: &mut Body, mesh: &mut Mesh) -> Result<(), String> {
    let is_corners = |name: &str| matches!(name, "vertex_indices" | "vertex_index");
    if !element.properties.iter().any(|p| p.list.is_some() && is_corners(&p.name)) {
        return Err("`face` has no list `vertex_indices`".into());
    }
    let per_vertex = !mesh.texcoords.is_empty();
    let (mut corners, mut texcoords) = (Vec::new(), Vec::new());
    for row in 0..element.count {
        corners.clear();
        texcoords.clear();
        for property in &element.properties {
            let end = || broken(element, row, &property.name);
            let length = match property.list {
                None => 1,
                Some(kind) => body.count(kind).ok_or_else(end)?,
            };
            if length > MAX_CORNERS {
                return Err(format!("face {row}: `{}` has {length} entries", quoted(&property.name)));
            }
            for _ in 0..length {
                match property.name.as_str() {
                    "vertex_indices" | "vertex_index" => {
                        let index = body.count(property.kind).and_then(|i| u32::try_from(i).ok());
                        corners.push(index.ok_or_else(end)?);
                    }
                    "texcoord" => texcoords.push(body.number(property.kind).ok_or_else(end)?),
                    _ => drop(body.number(property.kind).ok_or_else(end)?),
                }
            }
        }
        let first = mesh.texcoords.len() as u32;
        let per_corner = !per_vertex && !corners.is_empty() && texcoords.len() == 2 * corners.len();
        if per_corner {
            mesh.texcoords.extend(texcoords.chunks_exact(2).map(Vec2::from_slice));
        }
        // A fan; fewer than three corners are no face.
        for i in 1..corners.len().saturating_sub(1) {
            let positions = [corners[0], corners[i], corners[i + 1]];
            let texcoords = if per_vertex {
                Some(positions)
            } else {
                per_corner.then(|| [first, first + i as u32, first + i as u32 + 1])
            };
            mesh.faces.push(Face { positions, texcoords, material: 0 });
        }
    }
    Ok(())
}

fn skip(element: &Element, body: &mut Body) -> Result<(), String> {
    if element.properties.is_empty() {
        return Ok(());
    }
    for row in 0..element.count {
        for property in &element.properties {
            let end = || broken(element, row, &property.name);
            let length = property.list.map_or(Some(1), |kind| body.count(kind)).ok_or_else(end)?;
            for _ in 0..length {
                body.number(property.kind).ok_or_else(end)?;
            }
        }
    }
    Ok(())
}
