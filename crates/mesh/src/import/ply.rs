//! PLY meshes, ASCII and binary of either endianness: colours of vertices or faces, or a texture with coordinates per
//! vertex or per corner.

use std::collections::HashMap;
use std::path::Path;

use glam::{Vec2, Vec3};
use snapsnap_base::{FileError, file};
use snapsnap_splat::ply::Problem;
use snapsnap_splat::ply::body::Body;
use snapsnap_splat::ply::header::{Element, Scalar, parse};

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
    let mut body = Body::new(&bytes[header.len..], header.format);
    let mut mesh = Mesh::default();
    let mut textures = Textures::default();
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
            _ => body.skip(element),
        }
        .map_err(|problem| FileError::unsuitable(path, problem))?;
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

fn vertices(element: &Element, body: &mut Body<&[u8]>, mesh: &mut Mesh) -> Result<(), Problem> {
    let place = ["x", "y", "z"].map(|name| column(element, &[name]));
    let [Some(x), Some(y), Some(z)] = place else {
        return Err("`vertex` has no properties `x`, `y`, `z`".to_owned().into());
    };
    let color = colors(element);
    let s = column(element, &["s", "u", "texture_u"]);
    let texcoord = s.zip(column(element, &["t", "v", "texture_v"]));
    let mut values = vec![0.0; element.properties.len()];
    for row in 0..element.count {
        body.row(element, row, usize::MAX, |column, value| {
            values[column] = value.number()?;
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

fn faces(
    element: &Element,
    body: &mut Body<&[u8]>,
    mesh: &mut Mesh,
    polygons: &mut Polygons,
) -> Result<(), Problem> {
    let is_corners = |name: &str| matches!(name, "vertex_indices" | "vertex_index");
    if !element.properties.iter().any(|p| p.list.is_some() && is_corners(&p.name)) {
        return Err("`face` has no list `vertex_indices`".to_owned().into());
    }
    polygons.per_vertex = !mesh.texcoords.is_empty();
    let is_number = |name: &str| matches!(name, "texnumber" | "texture_number");
    if mesh.materials.len() > 1 && !element.properties.iter().any(|p| is_number(&p.name)) {
        let textures = mesh.materials.len();
        return Err(format!("it has {textures} textures, and `face` has no `texnumber`").into());
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
        body.row(element, row, MAX_CORNERS, |column, value| {
            let property = &element.properties[column];
            match property.name.as_str() {
                "vertex_indices" | "vertex_index" => {
                    corners.push(u32::try_from(value.count()?).ok()?);
                }
                name if is_number(name) => material = u32::try_from(value.count()?).ok()?,
                "texcoord" => texcoords.push(value.number()?),
                _ => {
                    let value = value.number()?;
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
                return Err(format!("its faces have more than {MAX_COLORS} colours: {advice}").into());
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
