use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};
use image::{DynamicImage, ImageFormat, RgbImage};

use super::{read, triangles};
use crate::mesh::Mesh;
use crate::view::{Renderer, ViewOptions};

mod odd;

/// A picture as PNG.
fn as_png(picture: impl Into<DynamicImage>) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.into().write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

/// A picture with one pixel of each of four colours, as PNG.
fn png() -> Vec<u8> {
    let colors = vec![255, 0, 0, 0, 255, 0, 0, 0, 255, 9, 9, 9];
    as_png(RgbImage::from_raw(2, 2, colors).expect("four pixels"))
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        // A space and letters beyond ASCII in every path.
        Self(tempfile::Builder::new().prefix("scän 人 ").tempdir().expect("temporary folder"))
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        fs::write(&path, content).expect("write");
        path
    }
}

fn corners(mesh: &Mesh) -> Vec<[Vec3; 3]> {
    mesh.faces.iter().map(|f| f.positions.map(|row| mesh.positions[row as usize])).collect()
}

fn texcoords(mesh: &Mesh, face: usize) -> Option<[Vec2; 3]> {
    mesh.faces[face].texcoords.map(|rows| rows.map(|row| mesh.texcoords[row as usize]))
}

const OBJ: &str = "mtllib my materials.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n\
                   usemtl cloth\nf 1/1 2/2 3/3 4/4\nusemtl skin\nf -5//  -4// -1//\n";

#[test]
fn obj_with_several_materials_polygons_and_a_texture_path_of_another_machine() {
    let folder = Folder::new();
    folder.file("cloth 1.png", png());
    folder.file(
        "my materials.mtl",
        "newmtl skin\nKd 0.5 0.25 1\nnewmtl cloth\nKd 0 0 0\nmap_Kd -s 1 1 1 C:\\scans\\cloth 1.png\n",
    );
    let mesh = read(&folder.file("a b.obj", OBJ)).expect("reads");
    let [o, x, xy, y, z] = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y, Vec3::Z];
    assert_eq!(corners(&mesh), [[o, x, xy], [o, xy, y], [o, x, z]]);
    assert_eq!(mesh.positions.len(), 5, "positions shared by two materials stay one");
    assert_eq!(texcoords(&mesh, 1), Some([Vec2::ZERO, Vec2::ONE, Vec2::Y]));
    let material = |face: usize| &mesh.materials[mesh.faces[face].material as usize];
    let texture = material(0).texture.as_ref().expect("has a texture");
    assert_eq!((texture.dimensions(), texture.get_pixel(0, 1).0), ((2, 2), [0, 0, 255]));
    assert_eq!(material(0).color, Vec3::ONE, "a texture replaces the colour");
    assert_eq!(material(2).color, Vec3::new(0.5, 0.25, 1.0));
    assert!(material(2).texture.is_none());
}

/// A triangle and a quadrilateral, with colours.
fn ply(format: &str) -> Vec<u8> {
    let header = format!(
        "ply\nformat {format} 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty float y\n\
         property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n\
         element edge 1\nproperty list uchar int16 ends\nelement face 2\nproperty uchar flags\n\
         property list uchar int vertex_indices\nend_header\n"
    );
    let body = "0 0 0 255 0 0 255\n1 0 0 0 255 0 255\n1 1 0 0 0 255 255\n0 1 0 51 51 51 255\n\
                2 0 3\n7 3 0 1 2\n7 4 0 1 2 3\n";
    if format == "ascii" {
        return (header + body).into_bytes();
    }
    let mut out = header.into_bytes();
    let types = ["ffdbbbb"; 4].concat() + "bss" + "bbiii" + "bbiiii";
    for (word, kind) in body.split_whitespace().zip(types.chars()) {
        let value: f64 = word.parse().expect("a number");
        let mut bytes = match kind {
            'f' => (value as f32).to_le_bytes().to_vec(),
            'd' => value.to_le_bytes().to_vec(),
            's' => (value as i16).to_le_bytes().to_vec(),
            'i' => (value as i32).to_le_bytes().to_vec(),
            _ => vec![value as u8],
        };
        if format == "binary_big_endian" {
            bytes.reverse();
        }
        out.extend(bytes);
    }
    out
}

#[test]
fn ply_in_every_format() {
    let folder = Folder::new();
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let mesh = read(&folder.file("a.ply", ply(format))).unwrap_or_else(|e| panic!("{format}: {e}"));
        let [o, x, xy, y] = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        assert_eq!(corners(&mesh), [[o, x, xy], [o, x, xy], [o, xy, y]], "{format}");
        assert_eq!(mesh.colors, [Vec3::X, Vec3::Y, Vec3::Z, Vec3::splat(0.2)], "{format}");
    }
}

#[test]
fn ply_with_a_texture_per_corner_and_per_vertex() {
    let folder = Folder::new();
    folder.file("skin.png", png());
    let start = "ply\nformat ascii 1.0\ncomment TextureFile skin.png\nelement vertex 3\nproperty float x\n\
                 property float y\nproperty float z\n";
    let faces = "element face 1\nproperty list uchar uint vertex_index\n";
    let per_corner = format!(
        "{start}{faces}property list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 0 1\n"
    );
    let per_vertex = format!(
        "{start}property float s\nproperty float t\n{faces}end_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    );
    for text in [per_corner, per_vertex] {
        let mesh = read(&folder.file("a.ply", text)).expect("reads");
        assert_eq!(texcoords(&mesh, 0), Some([Vec2::ZERO, Vec2::X, Vec2::Y]));
        assert!(mesh.materials[0].texture.is_some());
    }
}

/// A GLB with one textured triangle in a node that is moved by (0, 0, 5); `change` edits the JSON.
fn glb(change: impl FnOnce(String) -> String) -> Vec<u8> {
    let mut binary = Vec::new();
    for value in [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0_f32] {
        binary.extend(value.to_le_bytes());
    }
    for row in [0_u16, 1, 2, 0] {
        binary.extend(row.to_le_bytes());
    }
    let picture = png();
    let (at, length) = (binary.len(), picture.len());
    binary.extend(picture);
    binary.resize(binary.len().next_multiple_of(4), 0);
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"children":[1],"translation":[0,0,4]}},{{"mesh":0,"translation":[0,0,1]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}},"indices":2,"material":0}}]}}],
        "materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}}],
        "textures":[{{"source":0}}],"images":[{{"bufferView":3,"mimeType":"image/png"}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
        {{"bufferView":1,"componentType":5126,"count":3,"type":"VEC2"}},
        {{"bufferView":2,"componentType":5123,"count":3,"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":24}},
        {{"buffer":0,"byteOffset":60,"byteLength":6}},{{"buffer":0,"byteOffset":{at},"byteLength":{length}}}],
        "buffers":[{{"byteLength":{}}}]}}"#,
        binary.len()
    );
    let header = gltf::binary::Header { magic: *b"glTF", version: 2, length: 0 };
    let json = change(json).into_bytes();
    gltf::Glb { header, json: json.into(), bin: Some(binary.into()) }.to_vec().expect("writes")
}

/// The GLB with `from` in its JSON replaced once.
fn changed(from: &str, to: &str) -> Vec<u8> {
    glb(|json| json.replacen(from, to, 1))
}

#[test]
fn glb_with_nested_nodes_and_a_texture() {
    let folder = Folder::new();
    let mesh = read(&folder.file("a.GLB", glb(|json| json))).expect("reads");
    assert_eq!(corners(&mesh), [[Vec3::ZERO, Vec3::X, Vec3::Y].map(|p| p + 5.0 * Vec3::Z)]);
    // glTF counts texture rows from the top: (0, 1), (1, 1), (0, 0) are our (0, 0), (1, 0), (0, 1).
    assert_eq!(texcoords(&mesh, 0), Some([Vec2::ZERO, Vec2::X, Vec2::Y]));
    assert!(mesh.materials[mesh.faces[0].material as usize].texture.is_some());
    let mirrored = changed("\"translation\":[0,0,4]", "\"scale\":[-1,1,1]");
    let normals = read(&folder.file("b.glb", mirrored)).expect("reads").normals();
    assert!(normals[0].z > 0.9, "a mirrored node keeps the outside of its faces: {normals:?}");
}

/// A PNG with a header of 100,000 × 100,000 pixels.
fn absurd_png() -> Vec<u8> {
    let mut bytes = png();
    bytes[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
    bytes[20..24].copy_from_slice(&100_000_u32.to_be_bytes());
    // CRC-32 of the header chunk.
    bytes[29..33].copy_from_slice(&0x2730_9c9f_u32.to_be_bytes());
    bytes
}

/// Corrupt scans and the words that their errors must contain. Others are in `tests/tests/prepare.rs`.
#[test]
fn corrupt_scans_are_refused_by_name() {
    let folder = Folder::new();
    folder.file("absurd.png", absurd_png());
    folder.file("absurd.mtl", "newmtl a\nmap_Kd absurd.png\n");
    folder.file("known.mtl", "newmtl ä\nKd 1 1 1\n");
    let triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    let binary = ply("binary_little_endian");
    let bare = r#"{"asset":{"version":"2.0"},"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}]}"#;
    let image = |image: &str| changed(r#"{"bufferView":3,"mimeType":"image/png"}"#, image);
    let table: Vec<(&str, Vec<u8>, &str)> = vec![
        ("truncated.obj", b"v 0 0 0\nv 1 0 0\nv 0 1".into(), "line 3, `v 0 1`: no position"),
        ("huge.obj", triangle.replace("1 0 0", "1 1e39 0").into(), "position 1 is not finite"),
        ("range.obj", triangle.replace("f 1 2 3", "f 1 2 9").into(), "line 4: a face refers to vertex 9, there are 3"),
        ("line.obj", vec![b'v'; 5 << 20], "line 1: longer than 1048576 bytes"),
        ("bytes.obj", vec![0xff; 1000], "there is no triangle"),
        ("unknown.obj", format!("mtllib known.mtl\nusemtl zzz\n{triangle}").into(), "material `zzz` is missing"),
        ("faces.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 1000000000000000\nend_header\n".into(), "no list `vertex_indices`"),
        ("mtl.obj", format!("mtllib no.mtl\n{triangle}").into(), "material file `no.mtl` is missing"),
        ("absurd.obj", format!("mtllib absurd.mtl\n{triangle}").into(), "is 100000×100000, 28611 MiB in memory, more than 512"),
        ("cut.ply", binary[..binary.len() - 3].into(), "face 1 of 2: `vertex_indices` is missing"),
        ("foreign.ply", b"plyx".into(), "not a PLY file"),
        (
            "gaussians.ply",
            b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n".into(),
            "no properties `x`, `y`, `z`",
        ),
        ("cut.glb", glb(|json| json)[..600].into(), "is no valid GLB"),
        ("text.glb", b"not a GLB".into(), "is no valid GLB"),
        ("accessor.glb", changed("\"count\":3", "\"count\":1000000000"), "promises 1000000000 entries"),
        ("zero.glb", changed("\"count\":3", "\"count\":0"), "accessor 0"),
        ("indices.glb", changed("5123", "5126"), "accessor 2"),
        ("loop.glb", changed("\"mesh\":0,", "\"mesh\":0,\"children\":[0],"), "loop"),
        ("picture.glb", changed("\"bufferView\":3", "\"bufferView\":0"), "not a readable image"),
        // The parser panics on these documents.
        ("bare.glb", bare.into(), "is no valid GLB: mesh 0 refers to accessor 0, there are 0"),
        ("index.glb", changed("\"indices\":2", "\"indices\":9"), "is no valid GLB: mesh 0 refers to accessor 9"),
        ("source.glb", image("{}"), "is no valid GLB: image 0 has neither `uri` nor `bufferView` and `mimeType`"),
        ("type.glb", image(r#"{"bufferView":3}"#), "is no valid GLB: image 0 has neither"),
        ("scan.stl", b"solid".into(), "expected a file .obj, .ply or .glb"),
    ];
    for (name, content, expected) in table {
        let path = folder.file(name, content);
        let error = read(&path).map(|mesh| mesh.faces.len()).expect_err(name).to_string();
        assert!(error.contains(expected), "{name}: {error}");
        assert!(error.starts_with(&folder.0.path().display().to_string()), "{name}: {error}");
    }
    assert!(read(Path::new("/no/such.obj")).expect_err("missing").to_string().contains("cannot read"));
}

/// One mesh in very many nodes is counted before it is built.
#[test]
fn glb_that_unfolds_to_too_many_elements_is_refused() {
    // `count` nodes, each with a mesh of `count` primitives.
    let nodes = |count: usize| {
        glb(|json| {
            let primitive = r#"{"attributes":{"POSITION":0,"TEXCOORD_0":1},"indices":2,"material":0}"#;
            let json = json.replace(primitive, &vec![primitive; count].join(","));
            let places = vec![r#"{"mesh":0}"#; count].join(",");
            let children: Vec<String> = (2..count + 2).map(|node| node.to_string()).collect();
            json.replace("\"children\":[1]", &format!("\"children\":[{}]", children.join(",")))
                .replace("\"mesh\":0,\"translation\":[0,0,1]}", &format!("\"mesh\":0}},{places}"))
        })
    };
    let folder = Folder::new();
    assert_eq!(read(&folder.file("a.glb", nodes(30))).expect("reads").faces.len(), 900);
    // Three positions and three corners each.
    let error = read(&folder.file("a.glb", nodes(900))).map(|_| ()).expect_err("refuses").to_string();
    assert!(error.contains("its nodes unfold to more than 4000000 positions and corners"), "{error}");
}

#[test]
fn obj_that_is_cut_short_is_refused() {
    let folder = Folder::new();
    let start = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    let outcome = |text: &str| read(&folder.file("a.obj", text)).map(|_| ()).map_err(|e| e.to_string());
    let error = outcome(&format!("{start}f 1 2 3\nf 1 3 2")).expect_err("a line without an end");
    assert!(error.contains("its last line, `f 1 3 2`, has no end"), "{error}");
    assert_eq!(outcome(&format!("{start}f 1 2 3\nf 1 3 2\n")), Ok(()));
    assert_eq!(outcome(&format!("{start}f 1 2 3\n# End of File")), Ok(()));
    assert_eq!(outcome(&format!("{start}f 1 2 3\n\u{1a}")), Ok(()));
    let counts = ["# Faces: 2", "# number of triangles: 2", "#Face count 2", "# Vertices: 4", "# 4 vertices"];
    for comment in counts {
        let error = outcome(&format!("{comment}\n{start}f 1 2 3\n")).expect_err(comment);
        assert!(error.contains("a comment promises"), "{comment}: {error}");
        assert_eq!(outcome(&format!("{comment}\n{start}v 1 1 0\nf 1 2 3\nf 2 4 3\n")), Ok(()), "{comment}");
    }
    // Comments that count something else than the vertices or faces of the file.
    for comment in [
        "# 9 vertex normals",
        "# made of 9 vertices and 3 faces",
        "# Texture vertices: 9",
        "# UV vertices: 9",
        "# decimated from 2000000 faces",
        "# Object scan_500000_faces.obj",
        "# 3 points\n# 9 vertices\n# 1 primitives",
    ] {
        assert_eq!(outcome(&format!("{comment}\n{start}f 1 2 3\n")), Ok(()), "{comment}");
    }
    assert_eq!(outcome(&format!("{start}# 3 vertices\ng a\nf 1 2 3\n# 1 faces\n")), Ok(()));
}
