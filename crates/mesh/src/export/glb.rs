//! Binary glTF 2.0, all in one file.

use std::collections::HashMap;
use std::io;

use glam::{Affine3A, Mat4, Quat, Vec2, Vec3};
use gltf::binary::{Glb, Header};
use serde_json::{Value, json};
use snapsnap_splat::linear_light;

use super::png;
use crate::import::Weights;
use crate::mesh::{Face, Mesh, bounds};

/// glTF's codes of number types.
const U8: u32 = 5121;
const U16: u32 = 5123;
const U32: u32 = 5125;
const F32: u32 = 5126;
/// glTF's codes for the use of a buffer view.
const ATTRIBUTES: u32 = 34962;
const INDICES: u32 = 34963;

/// A skeleton, and how the positions of a mesh follow it.
#[derive(Debug, Clone, Default)]
pub struct Skin {
    /// Up to 256 joints, parents first. The first one is the root.
    pub joints: Vec<Joint>,
    /// By position: rows of joints and their shares.
    pub weights: Vec<Weights>,
    /// Motions.
    pub clips: Vec<Clip>,
}

/// A joint in the pose of the mesh.
#[derive(Debug, Clone)]
pub struct Joint {
    /// Its name.
    pub name: String,
    /// Row of the parent; `None` for the root.
    pub parent: Option<usize>,
    /// From the joint's axes to the world: rotation and place, metres.
    pub rest: Affine3A,
}

/// A motion.
#[derive(Debug, Clone)]
pub struct Clip {
    /// Its name.
    pub name: String,
    /// Time between two frames, seconds.
    pub step: f32,
    /// By frame and joint: from the joint's axes to the world.
    pub frames: Vec<Vec<Affine3A>>,
}

/// Encodes a binary glTF with one mesh, one primitive per material, and perhaps a skin. Colours contain the light of the photographs.
/// Materials are therefore unlit (KHR_materials_unlit), and rough for viewers without this extension.
///
/// # Errors
/// If a texture cannot be encoded.
pub fn glb_bytes(mesh: &Mesh, skin: Option<&Skin>) -> io::Result<Vec<u8>> {
    let mut file = Content::default();
    let (rows, faces) = vertices(mesh);
    let normals = mesh.normals();
    let positions: Vec<Vec3> = rows.iter().map(|(p, _)| mesh.positions[*p as usize]).collect();
    let (low, high) = bounds(positions.iter().copied());
    let mut attributes = serde_json::Map::new();
    let range = json!({ "min": low.to_array(), "max": high.to_array() });
    let places = file.floats(rows.len(), "VEC3", positions.iter().flat_map(|p| p.to_array()), range);
    attributes.insert("POSITION".into(), places);
    let normals = rows.iter().flat_map(|(p, _)| match normals[*p as usize] {
        // A vertex of degenerate faces has no normal, but glTF requires one of length 1.
        Vec3::ZERO => Vec3::Y.to_array(),
        normal => normal.to_array(),
    });
    attributes.insert("NORMAL".into(), file.floats(rows.len(), "VEC3", normals, json!({})));
    if !mesh.colors.is_empty() {
        // Colours are linear in glTF, for which 8 bits do not suffice. A vertex takes a multiple of 4 bytes.
        let color = |(p, _): &Vertex| {
            let [r, g, b] = mesh.colors[*p as usize].to_array().map(linear_light);
            [r, g, b, 1.0].map(|c| (c * f32::from(u16::MAX)).round() as u16)
        };
        let colors = file.view(rows.iter().flat_map(color).flat_map(u16::to_le_bytes), Some(ATTRIBUTES));
        let normalized = json!({ "normalized": true });
        attributes.insert("COLOR_0".into(), file.accessor(colors, U16, rows.len(), "VEC4", normalized));
    }
    if let Some(skin) = skin {
        let weights = || rows.iter().map(|(p, _)| skin.weights[*p as usize]);
        let joints = weights().flat_map(|weights| weights.map(|(joint, _)| joint as u8));
        let joints = file.view(joints, Some(ATTRIBUTES));
        attributes.insert("JOINTS_0".into(), file.accessor(joints, U8, rows.len(), "VEC4", json!({})));
        let shares = weights().flat_map(|weights| weights.map(|(_, share)| share));
        attributes.insert("WEIGHTS_0".into(), file.floats(rows.len(), "VEC4", shares, json!({})));
    }
    if rows.iter().any(|(_, t)| t.is_some()) {
        // The origin of glTF's texture coordinates is at the top.
        let texcoord = |t: Option<u32>| t.map_or(Vec2::ZERO, |t| mesh.texcoords[t as usize]);
        let texcoords = rows.iter().map(|(_, t)| texcoord(*t)).flat_map(|t| [t.x, 1.0 - t.y]);
        attributes.insert("TEXCOORD_0".into(), file.floats(rows.len(), "VEC2", texcoords, json!({})));
    }

    let (mut primitives, mut materials, mut images) = (Vec::new(), Vec::new(), Vec::new());
    for (row, material) in mesh.materials.iter().enumerate() {
        let faces = mesh.faces.iter().zip(&faces).filter(|(face, _)| face.material as usize == row);
        let corners: Vec<u32> = faces.flat_map(|(_, corners)| *corners).collect();
        let [r, g, b] = material.color.to_array().map(linear_light);
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
    });
    if let Some(skin) = skin {
        skin.describe(&mut document, &mut file);
    }
    document["accessors"] = file.accessors.split_off(0).into();
    document["bufferViews"] = file.views.split_off(0).into();
    document["buffers"] = json!([{ "byteLength": file.bytes.len() }]);
    if !images.is_empty() {
        document["textures"] =
            (0..images.len()).map(|source| json!({ "source": source, "sampler": 0 })).collect();
        document["samplers"] =
            json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }]);
        document["images"] = images.into();
    }
    file.finish(&document)
}

impl Skin {
    /// Adds the joints as nodes after the mesh's, and the motions.
    fn describe(&self, document: &mut Value, file: &mut Content) {
        let node = |joint: usize| 1 + joint;
        let local = |places: &[Affine3A], joint: usize| {
            let above = self.joints[joint].parent.map_or(Affine3A::IDENTITY, |parent| places[parent]);
            let (_, rotation, place) = (above.inverse() * places[joint]).to_scale_rotation_translation();
            (rotation.normalize(), place)
        };
        let rest: Vec<Affine3A> = self.joints.iter().map(|joint| joint.rest).collect();
        let nodes = document["nodes"].as_array_mut().expect("the document's nodes");
        nodes[0]["skin"] = 0.into();
        for (row, joint) in self.joints.iter().enumerate() {
            let (rotation, place) = local(&rest, row);
            let children = (0..self.joints.len()).filter(|child| self.joints[*child].parent == Some(row));
            let children: Vec<usize> = children.map(node).collect();
            let mut described = json!({
                "name": joint.name,
                "rotation": rotation.to_array(),
                "translation": place.to_array(),
            });
            if !children.is_empty() {
                described["children"] = children.into();
            }
            nodes.push(described);
        }
        document["scenes"] = json!([{ "nodes": [0, node(0)] }]);
        let inverse = rest.iter().flat_map(|rest| Mat4::from(rest.inverse()).to_cols_array());
        let inverse = file.view(inverse.flat_map(f32::to_le_bytes), None);
        let inverse = file.accessor(inverse, F32, rest.len(), "MAT4", json!({}));
        let joints: Vec<usize> = (0..rest.len()).map(node).collect();
        document["skins"] =
            json!([{ "joints": joints, "skeleton": node(0), "inverseBindMatrices": inverse }]);

        let mut animations = Vec::new();
        for Clip { name, step, frames } in &self.clips {
            let count = frames.len();
            let times = (0..count).map(|frame| frame as f32 * step);
            let range = json!({ "min": [0.0], "max": [count.saturating_sub(1) as f32 * step] });
            let times = file.plain_floats(count, "SCALAR", times, range);
            let (mut samplers, mut channels) = (Vec::new(), Vec::new());
            let mut channel = |joint: usize, path: &str, output: Value| {
                channels.push(
                    json!({ "sampler": samplers.len(), "target": { "node": node(joint), "path": path } }),
                );
                samplers.push(json!({ "input": times, "output": output, "interpolation": "LINEAR" }));
            };
            let places = frames.iter().flat_map(|frame| local(frame, 0).1.to_array());
            channel(0, "translation", file.plain_floats(count, "VEC3", places, json!({})));
            for joint in 0..self.joints.len() {
                let turns = frames.iter().scan(Quat::IDENTITY, |last, frame| {
                    let turn = local(frame, joint).0;
                    // The shorter way from frame to frame.
                    *last = if last.dot(turn) < 0.0 { -turn } else { turn };
                    Some(last.to_array())
                });
                channel(joint, "rotation", file.plain_floats(count, "VEC4", turns.flatten(), json!({})));
            }
            animations.push(json!({ "name": name, "samplers": samplers, "channels": channels }));
        }
        if !animations.is_empty() {
            document["animations"] = animations.into();
        }
    }
}

/// Indices of a position and of its texture coordinates, if any.
type Vertex = (u32, Option<u32>);

/// The distinct vertices, and the indices of each face's vertices.
fn vertices(mesh: &Mesh) -> (Vec<Vertex>, Vec<[u32; 3]>) {
    let (mut rows, mut known) = (Vec::new(), HashMap::new());
    let mut row = |vertex: Vertex| {
        *known.entry(vertex).or_insert_with(|| {
            rows.push(vertex);
            rows.len() as u32 - 1
        })
    };
    let corner = |face: &Face, corner: usize| (face.positions[corner], face.texcoords.map(|t| t[corner]));
    let faces = mesh.faces.iter().map(|face| [0, 1, 2].map(|i| row(corner(face, i)))).collect();
    (rows, faces)
}

/// The binary chunk, and the JSON that describes it.
#[derive(Default)]
struct Content {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Content {
    /// Adds a buffer view and returns its index.
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

    /// Adds an accessor of `count` vectors and returns its index.
    fn floats(&mut self, count: usize, shape: &str, values: impl Iterator<Item = f32>, more: Value) -> Value {
        let view = self.view(values.flat_map(f32::to_le_bytes), Some(ATTRIBUTES));
        self.accessor(view, F32, count, shape, more)
    }

    /// As [`Self::floats`], for other things than vertices.
    fn plain_floats(
        &mut self,
        count: usize,
        shape: &str,
        values: impl Iterator<Item = f32>,
        more: Value,
    ) -> Value {
        let view = self.view(values.flat_map(f32::to_le_bytes), None);
        self.accessor(view, F32, count, shape, more)
    }

    /// Adds an accessor for a buffer view and returns its index.
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
        let json = serde_json::to_vec(document)?;
        // Lengths in the file have 32 bits. Headers and padding take at most 32 bytes.
        u32::try_from(json.len() + self.bytes.len() + 32).map_err(io::Error::other)?;
        let header = Header { magic: *b"glTF", version: 2, length: 0 };
        let file = Glb { header, json: json.into(), bin: Some(self.bytes.into()) };
        file.to_vec().map_err(io::Error::other)
    }
}
