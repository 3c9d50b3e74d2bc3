//! A rigged character as a GLB, with the joint names of Mixamo and a box around every joint's bone.

use std::io::Cursor;

use glam::{Mat4, Vec3};
use image::{ImageFormat, Rgb, RgbImage};
use serde_json::{Value, json};

/// Name, row of the parent, place in metres. T-pose, facing +z.
const JOINTS: [(&str, Option<usize>, [f32; 3]); 20] = [
    ("mixamorig:Hips", None, [0.0, 1.0, 0.0]),
    ("mixamorig:Spine", Some(0), [0.0, 1.15, 0.0]),
    ("mixamorig:Neck", Some(1), [0.0, 1.5, 0.0]),
    ("mixamorig:Head", Some(2), [0.0, 1.6, 0.0]),
    ("mixamorig:HeadTop_End", Some(3), [0.0, 1.8, 0.0]),
    ("mixamorig:LeftShoulder", Some(1), [0.05, 1.45, 0.0]),
    ("mixamorig:LeftArm", Some(5), [0.2, 1.45, 0.0]),
    ("mixamorig:LeftForeArm", Some(6), [0.48, 1.45, 0.0]),
    ("mixamorig:LeftHand", Some(7), [0.73, 1.45, 0.0]),
    ("mixamorig:RightShoulder", Some(1), [-0.05, 1.45, 0.0]),
    ("mixamorig:RightArm", Some(9), [-0.2, 1.45, 0.0]),
    ("mixamorig:RightForeArm", Some(10), [-0.48, 1.45, 0.0]),
    ("mixamorig:RightHand", Some(11), [-0.73, 1.45, 0.0]),
    ("mixamorig:LeftUpLeg", Some(0), [0.1, 0.95, 0.0]),
    ("mixamorig:LeftLeg", Some(13), [0.1, 0.5, 0.0]),
    ("mixamorig:LeftFoot", Some(14), [0.1, 0.08, 0.0]),
    ("mixamorig:RightUpLeg", Some(0), [-0.1, 0.95, 0.0]),
    ("mixamorig:RightLeg", Some(16), [-0.1, 0.5, 0.0]),
    ("mixamorig:RightFoot", Some(17), [-0.1, 0.08, 0.0]),
    ("mixamorig:LeftToeBase", Some(15), [0.1, 0.02, 0.15]),
];
/// Bones: the row of the joint that moves the bone, and the place where the bone ends.
const BONES: [(usize, [f32; 3]); 16] = [
    (0, [0.0, 1.15, 0.0]),
    (1, [0.0, 1.5, 0.0]),
    (3, [0.0, 1.8, 0.0]),
    (6, [0.48, 1.45, 0.0]),
    (7, [0.73, 1.45, 0.0]),
    (8, [0.9, 1.45, 0.0]),
    (10, [-0.48, 1.45, 0.0]),
    (11, [-0.73, 1.45, 0.0]),
    (12, [-0.9, 1.45, 0.0]),
    (13, [0.1, 0.5, 0.0]),
    (14, [0.1, 0.08, 0.0]),
    (15, [0.1, 0.02, 0.18]),
    (16, [-0.1, 0.5, 0.0]),
    (17, [-0.1, 0.08, 0.0]),
    (18, [-0.1, 0.02, 0.18]),
    (2, [0.0, 1.6, 0.0]),
];

/// The character. Its mesh is stored `units` times too large, and the inverse bind matrices of its skin scale it back.
/// `change` edits the description before it is written.
pub fn character(units: f32, change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let (mut positions, mut joints, mut weights, mut rows) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut texcoords = Vec::new();
    for (place, (joint, end)) in BONES.into_iter().enumerate() {
        let (start, end) = (Vec3::from(JOINTS[joint].2), Vec3::from(end));
        let (low, high) = (start.min(end) - 0.04, start.max(end) + 0.04);
        let first = positions.len() as u16;
        for corner in 0..8 {
            let pick = |axis: usize| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] };
            positions.push([pick(0), pick(1), pick(2)].map(|v| v * units));
            joints.push([joint as u8, 0, 0, 0]);
            weights.push([1.0_f32, 0.0, 0.0, 0.0]);
            // Each bone has a cell of the texture.
            let [x, y] = [corner % 2, corner / 2 % 2].map(|part| 0.1 + 0.8 * part as f32);
            texcoords.push([(place % 4) as f32 + x, (place / 4) as f32 + y].map(|v| v / 4.0));
        }
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        rows.extend(faces.iter().flat_map(|f| [0, 1, 2, 0, 2, 3].map(|i| first + f[i])));
    }
    let inverse = JOINTS.map(|(_, _, place)| {
        (Mat4::from_translation(-Vec3::from(place)) * Mat4::from_scale(Vec3::splat(1.0 / units)))
            .to_cols_array()
    });
    let mut blob = Vec::new();
    let mut views = Vec::new();
    let mut add = |bytes: Vec<u8>| {
        views.push(json!({ "buffer": 0, "byteOffset": blob.len(), "byteLength": bytes.len() }));
        blob.extend(bytes);
        blob.resize(blob.len().next_multiple_of(4), 0);
    };
    let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    add(floats(positions.as_flattened()));
    add(joints.as_flattened().to_vec());
    add(floats(weights.as_flattened()));
    add(rows.iter().flat_map(|row| row.to_le_bytes()).collect());
    add(floats(inverse.as_flattened()));
    add(floats(texcoords.as_flattened()));
    add(png());
    let count = positions.len();
    let accessor = |view: usize, count: usize, component: u32, kind: &str| json!({ "bufferView": view, "count": count, "componentType": component, "type": kind });
    let mut position = accessor(0, count, 5126, "VEC3");
    (position["min"], position["max"]) = (json!(vec![-2.0 * units; 3]), json!(vec![2.0 * units; 3]));
    let nodes = JOINTS.iter().enumerate().map(|(row, (name, parent, place))| {
        let from = parent.map_or(Vec3::ZERO, |parent| Vec3::from(JOINTS[parent].2));
        let children: Vec<usize> = (0..JOINTS.len()).filter(|child| JOINTS[*child].1 == Some(row)).collect();
        let mut node = json!({ "name": name, "translation": (Vec3::from(*place) - from).to_array() });
        if !children.is_empty() {
            node["children"] = json!(children);
        }
        node
    });
    let mut nodes: Vec<Value> = nodes.collect();
    // A node's own place has no effect on a mesh with a skin.
    nodes.push(json!({ "name": "Body", "mesh": 0, "skin": 0, "translation": [9.0, 9.0, 9.0] }));
    let mut description = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0, JOINTS.len()] }],
        "nodes": nodes,
        "skins": [{ "joints": (0..JOINTS.len()).collect::<Vec<_>>(), "inverseBindMatrices": 4 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2, "TEXCOORD_0": 5 }, "indices": 3, "material": 0 }] }],
        "materials": [{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }],
        "textures": [{ "source": 0 }],
        "images": [{ "bufferView": 6, "mimeType": "image/png" }],
        "accessors": [
            position,
            accessor(1, count, 5121, "VEC4"),
            accessor(2, count, 5126, "VEC4"),
            accessor(3, rows.len(), 5123, "SCALAR"),
            accessor(4, JOINTS.len(), 5126, "MAT4"),
            accessor(5, count, 5126, "VEC2"),
        ],
        "bufferViews": views,
        "buffers": [{ "byteLength": blob.len() }],
    });
    change(&mut description);
    glb(&description, &blob)
}

/// Colour of skin, on head and hands.
pub const SKIN: [u8; 3] = [200, 150, 120];
/// Colour of cloth, everywhere else.
pub const CLOTH: [u8; 3] = [40, 90, 160];

/// The texture: a cell of 8 × 8 pixels for each bone.
fn png() -> Vec<u8> {
    let picture = RgbImage::from_fn(32, 32, |x, y| {
        let bone = (y / 8) * 4 + x / 8;
        Rgb(if matches!(BONES[bone as usize].0, 2 | 3 | 8 | 12) { SKIN } else { CLOTH })
    });
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

/// A binary glTF of a description and its buffer.
pub fn glb(description: &Value, blob: &[u8]) -> Vec<u8> {
    let mut text = description.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + blob.len();
    let mut bytes = Vec::new();
    for word in [0x4654_6c67, 2, length as u32, text.len() as u32, 0x4e4f_534a] {
        bytes.extend(u32::to_le_bytes(word));
    }
    bytes.extend(text);
    bytes.extend(u32::to_le_bytes(blob.len() as u32));
    bytes.extend(u32::to_le_bytes(0x004e_4942));
    bytes.extend(blob);
    bytes
}
