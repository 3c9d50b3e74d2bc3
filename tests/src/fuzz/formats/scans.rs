//! Scans, and what comes with them: materials, textures, the parameters that say which way they face, the config of views.

use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::{ImageFormat, Rgb, RgbImage};
use snapsnap_data::dataset;
use snapsnap_mesh::export;
use snapsnap_mesh::mesh::{Face, Material, Mesh};

use super::super::Format;
use super::put;
use crate::character::character;

/// What `prepare` may leave of a data set for which no subject could be made.
pub const DESCRIPTIONS: &[&str] = &["out/dataset.toml", "out/prepare.config.toml"];

/// What all have in common.
const SCAN: Format = Format {
    name: "",
    sample: |_| (),
    changed: &[],
    command: "",
    file: None,
    partial: false,
    kept: DESCRIPTIONS,
    whole: data_set,
    share: 28,
};

/// A scan command with few and small views.
macro_rules! scan {
    ($arguments:literal) => {
        concat!(
            "prepare scan ",
            $arguments,
            " -o out --set views.count=2 --set views.resolution=16 --set views.samples_per_axis=1"
        )
    };
}

/// A scan that stands beside the parameters of its body.
macro_rules! with_body {
    ($name:literal, $file:literal, $content:expr) => {
        Format {
            name: $name,
            sample: |folder| {
                obj(&folder.join("0001"), "0001");
                put(folder, concat!("0001/", $file), $content);
            },
            changed: &[$file],
            command: scan!("in/0001/0001.obj --collection thuman2.0"),
            ..SCAN
        }
    };
}

pub const FORMATS: &[Format] = &[
    Format {
        name: "obj",
        sample: |folder| obj(folder, "a"),
        changed: &[".obj", ".mtl"],
        command: scan!("in/a.obj"),
        share: 48,
        ..SCAN
    },
    Format {
        name: "texture-png",
        sample: |folder| obj(folder, "a"),
        changed: &[".png"],
        command: scan!("in"),
        ..SCAN
    },
    Format {
        name: "texture-tiff",
        sample: |folder| {
            obj(folder, "a");
            let picture = image::open(folder.join("a_0.png")).expect("just written");
            picture.save(folder.join("a_0.tiff")).expect("encodes");
            put(
                folder,
                "a.mtl",
                "newmtl m0\nKd 1 1 1\nmap_Kd -s 1 1 1 a_0.tiff\nnewmtl m1\nKd 0.2 0.4 0.6\n",
            );
        },
        changed: &[".tiff"],
        command: scan!("in/a.obj"),
        ..SCAN
    },
    Format {
        name: "mesh-ply",
        sample: |folder| {
            put(folder, "a.ply", ply("binary_little_endian"));
            put(folder, "skin.png", png());
        },
        changed: &[".ply"],
        command: scan!("in/a.ply"),
        share: 24,
        ..SCAN
    },
    Format {
        name: "mesh-ply-big-endian",
        sample: |folder| {
            put(folder, "a.ply", ply("binary_big_endian"));
            put(folder, "skin.png", png());
        },
        changed: &[".ply"],
        command: scan!("in/a.ply"),
        ..SCAN
    },
    Format {
        name: "mesh-ply-ascii",
        sample: |folder| {
            put(folder, "a.ply", ply("ascii"));
            put(folder, "skin.png", png());
        },
        changed: &[".ply"],
        command: scan!("in/a.ply"),
        share: 24,
        ..SCAN
    },
    Format {
        name: "glb",
        sample: |folder| put(folder, "a.glb", glb()),
        changed: &[".glb"],
        command: scan!("in/a.glb"),
        share: 96,
        ..SCAN
    },
    Format {
        name: "avatars",
        sample: |folder| {
            // The first person is for test.
            for name in ["a_suit.glb", "b_suit.glb"] {
                put(folder, name, character(1.0, |_| {}));
            }
        },
        changed: &["b_suit.glb"],
        command: "prepare avatars in --subjects 1 -o out --set views.count=2 --set views.resolution=16 --set views.samples_per_axis=1",
        share: 24,
        ..SCAN
    },
    with_body!(
        "smplx-pickle-2",
        "smplx_param.pkl",
        include_bytes!("../../../../crates/data/tests/smplx/protocol2.pkl")
    ),
    with_body!(
        "smplx-pickle-4",
        "smplx_param.pkl",
        include_bytes!("../../../../crates/data/tests/smplx/protocol4.pkl")
    ),
    with_body!(
        "smplx-pickle-big-endian",
        "smplx_param.pkl",
        include_bytes!("../../../../crates/data/tests/smplx/big_endian.pkl")
    ),
    with_body!(
        "smplx-json",
        "smplx_param.json",
        r#"{"betas": [[0.1, 0.2]], "global_orient": [[0.1, 1.5707963267948966, 0]], "scale": 1.0}"#
    ),
    Format {
        name: "smplx-folder",
        sample: |folder| {
            obj(folder, "0001");
            put(folder, "smplx/0001.json", r#"{"global_orient": [0.1, -0.5, 0]}"#);
        },
        changed: &[".json"],
        command: scan!("in/0001.obj --smplx in/smplx"),
        ..SCAN
    },
    Format {
        name: "config-data",
        sample: |folder| {
            obj(folder, "a");
            put(folder, "c.toml", include_str!("../../../../configs/data/training.toml"));
        },
        changed: &["c.toml"],
        command: scan!("in/a.obj --config in/c.toml"),
        ..SCAN
    },
];

/// A block as large as a person, no side like another, half of it with a texture.
pub fn person() -> Mesh {
    let corner = |i: u32| {
        let [x, y, z] = [i & 1, i >> 1 & 1, i >> 2].map(|bit| bit as f32);
        Vec3::new(0.5 * x - 0.2 - 0.1 * y, 1.7 * y + 0.05 * x, 0.3 * z - 0.15 + 0.1 * y * x)
    };
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let texcoords = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    let faces = sides.iter().enumerate().flat_map(|(side, rows)| {
        let material = side as u32 / 3;
        [[0, 1, 2], [0, 2, 3]].map(|corners: [usize; 3]| Face {
            positions: corners.map(|corner| rows[corner]),
            texcoords: (material == 0).then(|| corners.map(|corner| corner as u32)),
            material,
        })
    });
    let texture = image::load_from_memory(&png()).expect("just encoded").into_rgb8();
    Mesh {
        positions: (0..8).map(corner).collect(),
        texcoords: texcoords.to_vec(),
        faces: faces.collect(),
        materials: vec![
            Material { color: Vec3::ONE, texture: Some(Arc::new(texture)) },
            Material { color: Vec3::new(0.2, 0.4, 0.6), texture: None },
        ],
        ..Mesh::default()
    }
}

fn png() -> Vec<u8> {
    let texture = RgbImage::from_fn(8, 8, |x, y| Rgb([(x * 30) as u8, (y * 30) as u8, 128]));
    let mut bytes = Cursor::new(Vec::new());
    texture.write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

pub fn obj(folder: &Path, name: &str) {
    export::write_obj(&person(), &folder.join(format!("{name}.obj"))).expect("written");
}

/// Colours, texture coordinates, polygons and an element that is skipped.
fn ply(format: &str) -> Vec<u8> {
    let mesh = person();
    let mut bytes = format!(
        "ply\nformat {format} 1.0\ncomment TextureFile skin.png\nelement vertex 8\nproperty float x\nproperty double y\n\
         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement edge 1\n\
         property list uchar int16 ends\nelement face 12\nproperty list uchar int vertex_indices\n\
         property list uchar float texcoord\nend_header\n"
    )
    .into_bytes();
    let (text, big) = (format == "ascii", format.contains("big"));
    let mut put = |value: f64, binary: &[u8]| {
        if text {
            bytes.extend(format!("{value} ").bytes());
        } else if big {
            bytes.extend(binary.iter().rev());
        } else {
            bytes.extend(binary);
        }
    };
    let float = |value: f32| (f64::from(value), value.to_le_bytes());
    for (row, position) in mesh.positions.iter().enumerate() {
        let [x, y, z] = position.to_array().map(float);
        put(x.0, &x.1);
        put(y.0, &y.0.to_le_bytes());
        put(z.0, &z.1);
        (0..3).for_each(|channel| put(f64::from(row as u8 * 30 + channel), &[row as u8 * 30 + channel]));
    }
    put(2.0, &[2]);
    [0_i16, 3].into_iter().for_each(|row| put(f64::from(row), &row.to_le_bytes()));
    for face in &mesh.faces {
        put(3.0, &[3]);
        face.positions.iter().for_each(|row| put(f64::from(*row), &row.to_le_bytes()));
        put(6.0, &[6]);
        for row in face.texcoords.unwrap_or_default() {
            for value in mesh.texcoords[row as usize].to_array().map(float) {
                put(value.0, &value.1);
            }
        }
    }
    bytes
}

/// Three nodes, two of which show one mesh; vertex colours, texture coordinates, indices and a texture inside.
fn glb() -> Vec<u8> {
    let mesh = person();
    let mut binary = Vec::new();
    let mut views = Vec::new();
    let mut add = |part: Vec<u8>| {
        views.push(format!(r#"{{"buffer":0,"byteOffset":{},"byteLength":{}}}"#, binary.len(), part.len()));
        binary.extend(part);
        binary.resize(binary.len().next_multiple_of(4), 0);
    };
    add(mesh.positions.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes).collect());
    add((0..8).flat_map(|row| [row as f32 / 8.0, 0.5]).flat_map(f32::to_le_bytes).collect());
    add((0..8).flat_map(|row: u8| [row * 30, 99, 255 - row * 30, 255]).collect());
    add(mesh
        .faces
        .iter()
        .flat_map(|face| face.positions)
        .flat_map(|row| (row as u16).to_le_bytes())
        .collect());
    add(png());
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
"nodes":[{{"children":[1,2],"translation":[0,0.1,0]}},{{"mesh":0,"scale":[1,1,1]}},{{"mesh":0,"translation":[0.1,0,0.2],"rotation":[0,1,0,0]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1,"COLOR_0":2}},"indices":3,"material":0,"mode":4}}]}}],
"materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[1,0.9,0.8,1],"baseColorTexture":{{"index":0,"texCoord":0}}}}}}],
"textures":[{{"source":0,"sampler":0}}],"samplers":[{{"wrapS":10497}}],"images":[{{"bufferView":4,"mimeType":"image/png"}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":8,"type":"VEC3","min":[-1,0,-1],"max":[1,2,1]}},
{{"bufferView":1,"componentType":5126,"count":8,"type":"VEC2"}},
{{"bufferView":2,"byteOffset":0,"componentType":5121,"normalized":true,"count":8,"type":"VEC4"}},
{{"bufferView":3,"componentType":5123,"count":36,"type":"SCALAR"}}],
"bufferViews":[{}],"buffers":[{{"byteLength":{}}}]}}"#,
        views.join(","),
        binary.len()
    );
    let mut json = json.into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    bytes.extend(2_u32.to_le_bytes());
    bytes.extend((28 + json.len() as u32 + binary.len() as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", &json), (b"BIN\0", &binary)] {
        bytes.extend((chunk.len() as u32).to_le_bytes());
        bytes.extend(kind);
        bytes.extend(chunk);
    }
    bytes
}

/// Whether the data set in `out` has no fault, and a subject.
pub fn data_set(folder: &Path) -> Result<(), String> {
    let checked = dataset::check(&folder.join("out"), |_, _| ()).map_err(|e| e.to_string())?;
    match checked.problems.first() {
        Some(problem) => Err(problem.clone()),
        None if checked.subjects == 0 => Err("no subject".into()),
        None => Ok(()),
    }
}
