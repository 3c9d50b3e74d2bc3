//! Binary glTF 2.0, all in one file.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::Path;

use glam::{Vec2, Vec3};
use serde_json::{Value, json};
use snapsnap_base::file::write_whole;

use super::png;
use crate::mesh::Mesh;
use snapsnap_base::FileError;

/// Kinds of numbers, in glTF's codes.
const U16: u32 = 5123;
const U32: u32 = 5125;
const F32: u32 = 5126;
/// What a buffer's view is for.
const ATTRIBUTES: u32 = 34962;
const INDICES: u32 = 34963;

pub fn write(mesh: &Mesh, path: &Path) -> Result<(), FileError> {
    let bytes = bytes(mesh).map_err(FileError::write(path))?;
    write_whole(path, |out| out.write_all(&bytes)).map_err(FileError::write(path))
}

/// The file: one node, one primitive for each material. Colours are photographs', with their light in them: the material is
/// unlit (KHR_materials_unlit), and rough where that is not known.
pub fn bytes(mesh: &Mesh) -> io::Result<Vec<u8>> {
    let mut file = Content::default();
    let vertices = Vertices::of(mesh);
    let normals = mesh.normals();
    let rows = &vertices.rows;
    let positions: Vec<Vec3> = rows.iter().map(|(p, _)| mesh.positions[*p as usize]).collect();
    let (low, high) = positions
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
    let mut attributes = serde_json::Map::new();
    let place = file.floats(positions.iter().flat_map(|p| p.to_array()));
    let bounds = json!({ "min": low.to_array(), "max": high.to_array() });
    attributes.insert("POSITION".into(), file.accessor(place, F32, rows.len(), "VEC3", bounds));
    let normals = rows.iter().flat_map(|(p, _)| match normals[*p as usize] {
        // A position without area has no normal, and glTF wants one of length 1.
        Vec3::ZERO => Vec3::Y.to_array(),
        normal => normal.to_array(),
    });
    let normals = file.floats(normals);
    attributes.insert("NORMAL".into(), file.accessor(normals, F32, rows.len(), "VEC3", json!({})));
    if !mesh.colors.is_empty() {
        // Linear in glTF, which takes more than 8 bits; rows are of 4 bytes or a multiple.
        let color = |(p, _): &(u32, Option<u32>)| {
            let [r, g, b] = mesh.colors[*p as usize].to_array().map(linear);
            [r, g, b, 1.0].map(|c| (c * f32::from(u16::MAX)).round() as u16)
        };
        let colors = file.view(rows.iter().flat_map(color).flat_map(u16::to_le_bytes), Some(ATTRIBUTES));
        let normalized = json!({ "normalized": true });
        attributes.insert("COLOR_0".into(), file.accessor(colors, U16, rows.len(), "VEC4", normalized));
    }
    if rows.iter().any(|(_, t)| t.is_some()) {
        // glTF's textures begin at the top.
        let texcoord = |t: Option<u32>| t.map_or(Vec2::ZERO, |t| mesh.texcoords[t as usize]);
        let texcoords = rows.iter().map(|(_, t)| texcoord(*t)).flat_map(|t| [t.x, 1.0 - t.y]);
        let texcoords = file.floats(texcoords);
        attributes.insert("TEXCOORD_0".into(), file.accessor(texcoords, F32, rows.len(), "VEC2", json!({})));
    }

    let (mut primitives, mut materials, mut images) = (Vec::new(), Vec::new(), Vec::new());
    for (row, material) in mesh.materials.iter().enumerate() {
        let faces = mesh.faces.iter().zip(&vertices.faces);
        let corners: Vec<u32> = faces
            .filter(|(face, _)| face.material as usize == row)
            .flat_map(|(_, corners)| *corners)
            .collect();
        let [r, g, b] = material.color.to_array().map(linear);
        let mut surface =
            json!({ "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0 });
        if let Some(texture) = &material.texture {
            surface["baseColorTexture"] = json!({ "index": images.len() });
            let view = file.view(png(texture)?, None);
            images.push(json!({ "bufferView": view, "mimeType": "image/png" }));
        }
        materials.push(json!({
            "pbrMetallicRoughness": surface,
            "extensions": { "KHR_materials_unlit": {} },
        }));
        if !corners.is_empty() {
            let count = corners.len();
            let view = file.view(corners.into_iter().flat_map(u32::to_le_bytes), Some(INDICES));
            let indices = file.accessor(view, U32, count, "SCALAR", json!({}));
            primitives.push(json!({ "attributes": attributes, "indices": indices, "material": row }));
        }
    }
    let mut document = json!({
        "asset": { "version": "2.0", "generator": "snapsnap" },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "person" }],
        "meshes": [{ "primitives": primitives }],
        "materials": materials,
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{ "byteLength": file.bytes.len() }],
    });
    if !images.is_empty() {
        document["textures"] =
            (0..images.len()).map(|source| json!({ "source": source, "sampler": 0 })).collect();
        document["samplers"] =
            json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }]);
        document["images"] = images.into();
    }
    file.finish(&document)
}

/// glTF's vertices: a position, with the texture coordinate that a face gives it.
struct Vertices {
    rows: Vec<(u32, Option<u32>)>,
    faces: Vec<[u32; 3]>,
}

impl Vertices {
    fn of(mesh: &Mesh) -> Self {
        let (mut rows, mut known) = (Vec::new(), HashMap::new());
        let mut faces = Vec::with_capacity(mesh.faces.len());
        for face in &mesh.faces {
            faces.push([0, 1, 2].map(|corner| {
                let vertex = (face.positions[corner], face.texcoords.map(|t| t[corner]));
                *known.entry(vertex).or_insert_with(|| {
                    rows.push(vertex);
                    rows.len() as u32 - 1
                })
            }));
        }
        Self { rows, faces }
    }
}

/// The binary part, and what the other says of it.
#[derive(Default)]
struct Content {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Content {
    /// Adds bytes; returns the view's row.
    fn view(&mut self, bytes: impl IntoIterator<Item = u8>, target: Option<u32>) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(bytes);
        let mut view = json!({ "buffer": 0, "byteOffset": start, "byteLength": self.bytes.len() - start });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.views.push(view);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.len() - 1
    }

    fn floats(&mut self, values: impl Iterator<Item = f32>) -> usize {
        self.view(values.flat_map(f32::to_le_bytes), Some(ATTRIBUTES))
    }

    /// Says what a view holds; returns the accessor's row.
    fn accessor(&mut self, view: usize, kind: u32, count: usize, shape: &str, more: Value) -> Value {
        let mut accessor =
            json!({ "bufferView": view, "componentType": kind, "count": count, "type": shape });
        for (key, value) in more.as_object().into_iter().flatten() {
            accessor[key] = value.clone();
        }
        self.accessors.push(accessor);
        (self.accessors.len() - 1).into()
    }

    fn finish(self, document: &Value) -> io::Result<Vec<u8>> {
        let mut text = serde_json::to_vec(document)?;
        text.resize(text.len().next_multiple_of(4), b' ');
        let chunks: [(&[u8; 4], &[u8]); 2] = [(b"JSON", &text), (b"BIN\0", &self.bytes)];
        let length = |bytes: usize| u32::try_from(bytes).map(u32::to_le_bytes).map_err(io::Error::other);
        let mut file = b"glTF\x02\0\0\0".to_vec();
        file.extend(length(12 + chunks.iter().map(|(_, bytes)| 8 + bytes.len()).sum::<usize>())?);
        for (kind, bytes) in chunks {
            file.extend(length(bytes.len())?);
            file.extend(kind);
            file.extend(bytes);
        }
        Ok(file)
    }
}

/// Light of a colour as a screen shows it (sRGB).
fn linear(shown: f32) -> f32 {
    let shown = shown.clamp(0.0, 1.0);
    if shown <= 0.040_45 { shown / 12.92 } else { ((shown + 0.055) / 1.055).powf(2.4) }
}
