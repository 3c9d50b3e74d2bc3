//! Small sound samples: files of this repository, and files that the program or its libraries write.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use glam::Vec3;
use image::{DynamicImage, GrayImage, ImageFormat, Luma};
use serde_json::json;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_mesh::{export, import};
use snapsnap_splat::{Camera, camera_file};
use snapsnap_tests::character::{character, glb};
use snapsnap_tests::ply::{Format, Row, balls, cloud, ply_bytes};
use snapsnap_tests::workplace::person;
use snapsnap_tests::{TRAINING, data, exif, root, snapsnap, succeed};

/// Side of a photograph: the smallest that is taken.
const SIDE: u32 = 64;
/// Most keys of a benchmark's setting.
const SETTING: &str = "[settings.sideless]
scene = \"standing\"
omits = \"the sides\"
sides = false
stride = 2
min_opacity = 0.1
only = [\"a\"]
inputs = [0, 2]
set = [\"network.conf_threshold=0.4\"]
preset = \"gsplat\"
antialiased = true
precision = \"f32\"
supersampling = 1
";
/// A pyramid as large as a person, no side like another, half of it with a texture.
const PYRAMID: &str = "mtllib a.mtl
v -0.3 0 -0.15
v 0.35 0 -0.2
v 0.25 0.05 0.2
v -0.2 0 0.15
v 0.05 1.7 0
vt 0 0
vt 1 0
vt 0.5 1
vn 0 0 1
usemtl m0
f 1/1/1 5/3/1 2/2/1
f 2/1/1 5/3/1 3/2/1
usemtl m1
f 3//1 5//1 4//1
f 4//1 5//1 1//1
f 1//1 2//1 \\
3//1 4//1
";
const MATERIALS: &str =
    "newmtl m0\nKd 1 1 1\nmap_kd A.png\nnewmtl m1\nKd 0.2 0.4 0.6\nmap_Kd -s 1 1 1 a.tiff\n";
/// Cameras of other programs.
const SPLATTING: &str = r#"[{"id": 0, "img_name": "a", "width": 24, "height": 16, "position": [0, 1, 3],
    "rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "fx": 20.5, "fy": 20.5}]"#;
const TRANSFORMS: &str = r#"{"camera_angle_x": 0.6, "w": 24, "h": 16.0, "k1": 0, "frames": [{"file_path": "a",
    "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 3], [0, 0, 0, 1]]}]}"#;
/// An element that is skipped.
const EDGE: &str = "element edge 1\nproperty list uchar uchar ends\n";

/// Makes the file or folder `name` of a sample, and what belongs to it.
///
/// # Panics
/// If there is no sample of this name.
pub fn make(folder: &Path, name: &str) {
    fs::create_dir_all(folder).expect("a folder");
    let path = folder.join(name);
    let photograph = person(SIDE, SIDE, 0, 0);
    match name {
        "a.png" | "b.webp" | "b.gif" | "a.tiff" | "b.bmp" => save(&path, photograph),
        "deep.png" => save(&path, DynamicImage::from(photograph).into_rgba16()),
        "float.tiff" => save(&path, DynamicImage::from(photograph).into_rgb32f()),
        "a.jpg" => {
            save(&path, DynamicImage::from(photograph).into_rgb8());
            let jpeg = fs::read(&path).expect("just written");
            // Segment APP1: the lens and the tilt of a telephone.
            let exif = [b"Exif\0\0", &exif(26, [0, -990, -140])[..]].concat();
            let length = (2 + exif.len() as u16).to_be_bytes();
            put(&path, [&jpeg[..2], b"\xff\xe1", &length, &exif, &jpeg[2..]].concat());
        }
        // Progressive, which the encoder at hand does not write.
        "progressive.jpg" => copy("crates/mesh/tests/progressive.jpg", &path),
        // The first bytes of a picture say what it is, not its name. Made with libheif.
        "heic.jpg" => copy("crates/mesh/tests/square.heic", &path),
        "m.png" | "m.jpg" => {
            save(&path, GrayImage::from_fn(SIDE, SIDE, |x, y| Luma([photograph.get_pixel(x, y)[3]])));
        }
        "n.toml" => put(&path, TRAINING.split("[samples]").next().expect("sections of the networks")),
        "w.safetensors" => {
            make(folder, "n.toml");
            run(folder, "init-weights --seed 1 --config n.toml -o w.safetensors");
        }
        // In the authors' layouts.
        "stage1.pth" | "stage2.pth" => copy(&format!("tests/data/pipeline/{name}"), &path),
        "tiny.toml" => copy("configs/tiny.toml", &path),
        "training.toml" => copy("configs/data/training.toml", &path),
        "t.toml" => {
            prepare(folder, "train", 4, "set");
            let more = "[data]\nfolders = [\"in/set\"]\n[samples.augment]\nexposure = 0.1\n";
            put(&path, [TRAINING, more].concat());
        }
        "e.toml" => {
            let more = "[ablations.sideless]\nsides = false\n";
            put(&path, [include_str!("../../../configs/eval.toml"), more].concat());
        }
        "b.toml" => {
            let (general, _) =
                include_str!("../../../configs/bench.toml").split_once("[settings").expect("settings");
            put(&path, [general, SETTING].concat());
        }
        "people" => prepare(folder, "test", 4, "people"),
        "h.ply" => put(&path, ply_bytes(&cloud(3, 0), Format::Little, "", b"")),
        "ascii.ply" => put(&path, ply_bytes(&cloud(2, 1), Format::Ascii, EDGE, b"2 0 1\n")),
        "big_endian.ply" => put(&path, ply_bytes(&cloud(2, 2), Format::Big, EDGE, &[2, 0, 1])),
        "h.glb" | "h.spz" => {
            make(folder, "h.ply");
            run(folder, &format!("convert h.ply {name}"));
        }
        "v3_degree3.spz" => copy("tests/data/spz/v3_degree3.spz", &path),
        // The ending tells the envelope apart from a gzip stream.
        "v4_degree3.spz4" => copy("tests/data/spz/v4_degree3.spz", &path),
        "cloud.sog" | "cloud.compressed.ply" => copy(&format!("tests/data/foreign/{name}"), &path),
        "h.splat" => {
            let bytes = [0.25_f32.to_le_bytes().repeat(6), vec![200, 100, 50, 255, 255, 128, 128, 128]];
            put(&path, bytes.concat().repeat(3));
        }
        // Two metres high. Its mesh takes half of the time of a ball's.
        "rod.ply" => put(&path, balls((0..60_u8).map(|row| [0.0, f32::from(row) / 30.0, 0.0]), -2.5)),
        "cameras.json" => camera_file::write(&Camera::orbit(2, 24, 16), &path).expect("written"),
        "a.obj" => {
            put(&path, PYRAMID);
            put(&folder.join("a.mtl"), MATERIALS);
            save(&folder.join("a.png"), person(8, 8, 0, 0));
            save(&folder.join("a.tiff"), person(8, 8, 0, 0));
        }
        "odd.glb" => put(&path, odd_glb()),
        "splatting.json" => put(&path, SPLATTING),
        "transforms.json" => put(&path, TRANSFORMS),
        "a.glb" => export::write(&pyramid(folder), &path).expect("written"),
        "mesh.ply" => put(&path, mesh_ply(&pyramid(folder), Format::Double)),
        "mesh_big_endian.ply" => put(&path, mesh_ply(&pyramid(folder), Format::Big)),
        "mesh_ascii.ply" => put(&path, mesh_ply(&pyramid(folder), Format::Ascii)),
        // Scans with the parameters of their bodies.
        "scans" => {
            make(&path, "a.obj");
            copy("crates/data/tests/smplx/numpy2.pkl", &path.join("a.pkl"));
            for subject in ["protocol2", "protocol4", "big_endian"] {
                let parameters = format!("{subject}.pkl");
                copy(&format!("crates/data/tests/smplx/{parameters}"), &path.join(parameters));
                put(&path.join(format!("{subject}.obj")), PYRAMID);
            }
        }
        "avatars" => {
            put(&path.join("a_suit.glb"), character(1.0, |_| {}));
            put(&path.join("b_suit.glb"), character(1.0, |_| {}));
        }
        "makehuman" => {
            let file = fs::File::open(data("makehuman.zip")).expect("test data");
            zip::ZipArchive::new(file)
                .and_then(|mut archive| archive.extract(&path))
                .expect("a sound archive");
        }
        "set" => prepare(folder, "train", 2, "set"),
        "set_32_2" => prepare(folder, "train", 2, "set_32_2 --set views.layout=authors"),
        _ => panic!("no sample {name}"),
    }
}

/// A triangle of quantised positions with a cut-out, moved texture on a specular material.
fn odd_glb() -> Vec<u8> {
    let positions: [i16; 12] = [0, 0, 0, 0, 30_000, 0, 0, 0, 0, 30_000, 0, 0];
    let places = [0.0_f32, 1.0, 1.0, 1.0, 0.0, 0.0];
    let mut picture = Cursor::new(Vec::new());
    person(8, 8, 0, 0).write_to(&mut picture, ImageFormat::Png).expect("encoded");
    let uri = format!("data:image/png;base64,{}", BASE64_STANDARD.encode(picture.into_inner()));
    let blob: Vec<u8> = positions
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .chain(places.iter().flat_map(|v| v.to_le_bytes()))
        .collect();
    let texture = json!({ "index": 0, "extensions": { "KHR_texture_transform": { "offset": [0.1, 0.2], "rotation": 0.3, "scale": [0.5, 2] } } });
    let specular = json!({ "KHR_materials_pbrSpecularGlossiness": { "diffuseTexture": texture } });
    let description = json!({
        "asset": { "version": "2.0" },
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "scale": [2, 2, 2] }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "material": 0 }] }],
        "materials": [{ "alphaMode": "MASK", "alphaCutoff": 0.4, "extensions": specular }],
        "textures": [{ "source": 0 }],
        "images": [{ "uri": uri }],
        "accessors": [
            { "bufferView": 0, "componentType": 5122, "normalized": true, "count": 3, "type": "VEC3",
              "min": [0, 0, 0], "max": [30000, 30000, 0] },
            { "bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteLength": 24, "byteStride": 8 },
            { "buffer": 0, "byteOffset": 24, "byteLength": 24 },
        ],
        "buffers": [{ "byteLength": blob.len() }],
    });
    glb(&description, &blob)
}

/// Writes a file, and the folders around it.
pub fn put(path: &Path, content: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().expect("in a folder")).expect("a folder");
    fs::write(path, content).expect("a file");
}

/// Copies a file of this repository.
fn copy(from: &str, path: &Path) {
    put(path, fs::read(root().join(from)).expect("a file of the repository"));
}

fn save(path: &Path, picture: impl Into<DynamicImage>) {
    picture.into().save(path).expect("encodes");
}

/// Runs a command of the program in the sample's folder.
fn run(folder: &Path, line: &str) {
    succeed(snapsnap().current_dir(folder).args(line.split_whitespace()));
}

/// Makes a data set of the pyramid. `output` is a folder, and more options.
fn prepare(folder: &Path, split: &str, views: u32, output: &str) {
    make(&folder.join("mesh"), "a.obj");
    let size = format!("--set views.count={views} --set views.resolution={}", 16 * views);
    let options = format!("--split {split} {size} --set views.samples_per_axis=1 -o {output}");
    run(folder, &format!("prepare scan mesh/a.obj {options}"));
    fs::remove_dir_all(folder.join("mesh")).expect("removed");
}

fn pyramid(folder: &Path) -> Mesh {
    make(folder, "a.obj");
    import::read(&folder.join("a.obj")).expect("sound")
}

/// A PLY with colours, texture coordinates and an element that is skipped, before the vertices.
fn mesh_ply(mesh: &Mesh, format: Format) -> Vec<u8> {
    let mut lists: Vec<u8> = Vec::new();
    // Each value as a number and as little-endian bytes.
    let mut add = |row: Vec<(f64, Vec<u8>)>| {
        for (value, little) in row {
            match format {
                Format::Ascii => lists.extend(format!("{value} ").bytes()),
                Format::Big => lists.extend(little.iter().rev()),
                Format::Little | Format::Double => lists.extend(little),
            }
        }
        if matches!(format, Format::Ascii) {
            lists.push(b'\n');
        }
    };
    let byte = |value: u8| (f64::from(value), vec![value]);
    add([2, 0, 1].map(byte).into());
    for face in &mesh.faces {
        let positions = face.positions.into_iter().map(|row| (row.into(), row.to_le_bytes().into()));
        let places = face.texcoords.unwrap_or_default().map(|row| mesh.texcoords[row as usize].to_array());
        let places = places.into_iter().flatten().map(|value| (value.into(), value.to_le_bytes().into()));
        add([byte(3)].into_iter().chain(positions).chain([byte(6)]).chain(places).collect());
    }
    let vertex = |position: &Vec3| -> Row {
        let [x, y, z] = position.to_array().map(f64::from);
        let values = [("x", x), ("y", y), ("z", z), ("red", 0.2), ("green", 0.4), ("blue", 0.6)];
        values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    };
    let vertices: Vec<Row> = mesh.positions.iter().map(vertex).collect();
    let before = format!(
        "comment TextureFile a.png\n{EDGE}element face {}\nproperty list uchar int vertex_indices\n\
         property list uchar float texcoord\n",
        mesh.faces.len()
    );
    ply_bytes(&vertices, format, &before, &lists)
}
