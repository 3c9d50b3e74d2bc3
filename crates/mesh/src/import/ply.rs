//! PLY meshes, ASCII and binary of either endianness: colours of vertices or faces, or a texture with coordinates per
//! vertex or per corner.

use std::collections::HashMap;
use std::path::Path;
use std::str::SplitAsciiWhitespace;

use glam::{Vec2, Vec3};
use snapsnap_base::{FileError, file, quoted};
use snapsnap_splat::ply::header::{Element, Format, Scalar, parse};

use super::{MAX_BYTES, Textures, triangles};
use crate::mesh::{Face, Material, Mesh};

/// Most corners of a face; a longer list is a damaged file.
const MAX_CORNERS: usize = 1 << 16;
/// Most colours of faces; each is a material.
const MAX_COLORS: usize = 1 << 12;

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
    let mut mesh = Mesh::default();
    let mut textures = Textures::new();
    for name in header.comments.iter().filter_map(|comment| comment.strip_prefix("TextureFile")) {
        let texture = Some(textures.beside(path, name.trim())?);
        mesh.materials.push(Material { texture, ..Material::default() });
    }
    if mesh.materials.is_empty() {
        mesh.materials.push(Material::default());
    }
    let mut polygons = Polygons::default();
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" => vertices(element, &mut body, &mut mesh),
            "face" => faces(element, &mut body, &mut mesh, &mut polygons),
            // Elements without properties have no bytes in the file.
            _ if element.properties.is_empty() => Ok(()),
            _ => (0..element.count).try_for_each(|row| {
                let skip =
                    |body: &mut Body, column: usize| body.number(element.properties[column].kind).map(drop);
                read_row(element, row, usize::MAX, &mut body, skip)
            }),
        }
        .map_err(wrong)?;
    }
    polygons.build(&mut mesh).map_err(wrong)?;
    let is_textured = mesh.materials.iter().any(|material| material.texture.is_some());
    if is_textured && mesh.faces.iter().any(|face| face.texcoords.is_none()) {
        return Err(wrong("it has a texture, and a face without texture coordinates".into()));
    }
    Ok(mesh)
}

/// Faces of any number of corners. Their vertices may come later.
#[derive(Default)]
struct Polygons {
    /// Vertices of all faces.
    corners: Vec<u32>,
    /// By face: number of corners, row of the first corner's texture coordinate if each corner has its own, material.
    faces: Vec<(usize, Option<u32>, u32)>,
    /// Whether vertices have texture coordinates.
    per_vertex: bool,
}

impl Polygons {
    fn build(&self, mesh: &mut Mesh) -> Result<(), String> {
        let mut left = &self.corners[..];
        for (face, (count, first, material)) in self.faces.iter().enumerate() {
            let (corners, after) = left.split_at(*count);
            left = after;
            let place = |row: &u32| mesh.positions.get(*row as usize).copied().ok_or(*row);
            let places = corners.iter().map(place).collect::<Result<Vec<_>, _>>().map_err(|row| {
                format!("face {face} refers to position {row}, there are {}", mesh.positions.len())
            })?;
            for triangle in triangles(&places) {
                let positions = triangle.map(|i| corners[i]);
                let own = first.map(|first| triangle.map(|i| first + i as u32));
                let texcoords = if self.per_vertex { Some(positions) } else { own };
                mesh.faces.push(Face { positions, texcoords, material: *material });
            }
        }
        Ok(())
    }
}

/// The values after the header.
enum Body<'a> {
    Text(SplitAsciiWhitespace<'a>),
    Binary { bytes: &'a [u8], big: bool },
}

/// The next value of a binary body in little-endian order, padded with zeros to eight bytes.
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
    /// The next value as a number; `None` at the end and for text that is no number.
    fn number(&mut self, kind: Scalar) -> Option<f32> {
        match self {
            Self::Text(words) => words.next()?.parse().ok(),
            Self::Binary { bytes, big } => take(bytes, kind, *big).map(|b| kind.read(&b)),
        }
    }

    /// The next value as a length or an index.
    fn count(&mut self, kind: Scalar) -> Option<usize> {
        match self {
            Self::Text(words) => words.next()?.parse().ok(),
            Self::Binary { bytes, big } => kind.read_count(&take(bytes, kind, *big)?[..kind.size()]),
        }
    }
}

/// Reads one row of an element. `value` receives the index of a property and reads its next value. It returns `None`
/// for a value that is missing or no number.
///
/// # Errors
/// A missing or wrong value, or a list of more than `longest` values.
fn read_row(
    element: &Element,
    row: usize,
    longest: usize,
    body: &mut Body,
    mut value: impl FnMut(&mut Body, usize) -> Option<()>,
) -> Result<(), String> {
    for (column, property) in element.properties.iter().enumerate() {
        let broken = || {
            let (name, count) = (quoted(&element.name), element.count);
            let property = quoted(&property.name);
            format!("{name} {row} of {count}: `{property}` is missing or no number; the file may be cut off")
        };
        let length = property.list.map_or(Some(1), |kind| body.count(kind)).ok_or_else(broken)?;
        if length > longest {
            let (name, property) = (quoted(&element.name), quoted(&property.name));
            return Err(format!("{name} {row}: `{property}` has {length} entries"));
        }
        for _ in 0..length {
            value(body, column).ok_or_else(broken)?;
        }
    }
    Ok(())
}

/// Index of the property that has one of these names of different exporters.
fn column(element: &Element, names: &[&str]) -> Option<usize> {
    element.properties.iter().position(|p| p.list.is_none() && names.contains(&p.name.as_str()))
}

/// Indices of the properties with a colour.
fn colors(element: &Element) -> Option<[usize; 3]> {
    let names = [["red", "r", "diffuse_red"], ["green", "g", "diffuse_green"], ["blue", "b", "diffuse_blue"]];
    let [r, g, b] = names.map(|names| column(element, &names));
    Some([r?, g?, b?])
}

/// A stored intensity of a colour in [0, 1].
fn intensity(value: f32, kind: Scalar) -> f32 {
    match kind {
        Scalar::F32 | Scalar::F64 => value,
        Scalar::U16 => value / 65_535.0,
        _ => value / 255.0,
    }
}

fn vertices(element: &Element, body: &mut Body, mesh: &mut Mesh) -> Result<(), String> {
    let place = ["x", "y", "z"].map(|name| column(element, &[name]));
    let [Some(x), Some(y), Some(z)] = place else {
        return Err("`vertex` has no properties `x`, `y`, `z`".into());
    };
    let color = colors(element);
    let s = column(element, &["s", "u", "texture_u"]);
    let texcoord = s.zip(column(element, &["t", "v", "texture_v"]));
    let mut values = vec![0.0; element.properties.len()];
    for row in 0..element.count {
        read_row(element, row, usize::MAX, body, |body, column| {
            values[column] = body.number(element.properties[column].kind)?;
            Some(())
        })?;
        mesh.positions.push(Vec3::new(values[x], values[y], values[z]));
        if let Some(columns) = color {
            mesh.colors.push(Vec3::from(columns.map(|c| intensity(values[c], element.properties[c].kind))));
        }
        if let Some((s, t)) = texcoord {
            mesh.texcoords.push(Vec2::new(values[s], values[t]));
        }
    }
    Ok(())
}

fn faces(element: &Element, body: &mut Body, mesh: &mut Mesh, polygons: &mut Polygons) -> Result<(), String> {
    let is_corners = |name: &str| matches!(name, "vertex_indices" | "vertex_index");
    if !element.properties.iter().any(|p| p.list.is_some() && is_corners(&p.name)) {
        return Err("`face` has no list `vertex_indices`".into());
    }
    polygons.per_vertex = !mesh.texcoords.is_empty();
    let is_number = |name: &str| matches!(name, "texnumber" | "texture_number");
    if mesh.materials.len() > 1 && !element.properties.iter().any(|p| is_number(&p.name)) {
        return Err(format!("it has {} textures, and `face` has no `texnumber`", mesh.materials.len()));
    }
    // Colours of vertices and textures show more than colours of faces.
    let is_plain = mesh.colors.is_empty() && mesh.materials.iter().all(|material| material.texture.is_none());
    let color = colors(element).filter(|_| is_plain);
    let mut materials: HashMap<[u32; 3], u32> = HashMap::new();
    let (mut corners, mut texcoords) = (Vec::new(), Vec::new());
    for row in 0..element.count {
        corners.clear();
        texcoords.clear();
        let (mut material, mut painted) = (0, [0.0; 3]);
        read_row(element, row, MAX_CORNERS, body, |body, column| {
            let property = &element.properties[column];
            match property.name.as_str() {
                "vertex_indices" | "vertex_index" => {
                    corners.push(u32::try_from(body.count(property.kind)?).ok()?);
                }
                name if is_number(name) => material = u32::try_from(body.count(property.kind)?).ok()?,
                "texcoord" => texcoords.push(body.number(property.kind)?),
                _ => {
                    let value = body.number(property.kind)?;
                    if let Some(channel) = color.and_then(|color| color.iter().position(|c| *c == column)) {
                        painted[channel] = intensity(value, property.kind);
                    }
                }
            }
            Some(())
        })?;
        if color.is_some() {
            let next = mesh.materials.len() as u32;
            material = *materials.entry(painted.map(f32::to_bits)).or_insert(next);
            if material == next {
                mesh.materials.push(Material { color: Vec3::from(painted), ..Material::default() });
            }
            if materials.len() > MAX_COLORS {
                let advice = "give its vertices colours instead";
                return Err(format!("its faces have more than {MAX_COLORS} colours: {advice}"));
            }
        }
        let first = mesh.texcoords.len() as u32;
        let per_corner = !polygons.per_vertex && !corners.is_empty() && texcoords.len() == 2 * corners.len();
        if per_corner {
            mesh.texcoords.extend(texcoords.chunks_exact(2).map(Vec2::from_slice));
        }
        polygons.corners.extend(&corners);
        polygons.faces.push((corners.len(), per_corner.then_some(first), material));
    }
    Ok(())
}
