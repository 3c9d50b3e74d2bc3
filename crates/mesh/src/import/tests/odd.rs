//! Files as other programs write them.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use glam::{DMat3, DVec2, DVec3};
use image::RgbaImage;
use snapsnap_splat::{Camera, RigidTransform};

use super::*;

/// Area of a polygon's triangles.
fn area(corners: &[Vec3]) -> f32 {
    let triangles = triangles(corners);
    assert_eq!(triangles.len(), corners.len() - 2);
    let area =
        |[a, b, c]: [usize; 3]| (corners[b] - corners[a]).cross(corners[c] - corners[a]).length() / 2.0;
    triangles.into_iter().map(area).sum()
}

/// Gaps of concave polygons stay open, whichever corner is the first and whichever way they look.
#[test]
fn concave_polygons_keep_their_gaps() {
    // Trousers, an arrow and a comb.
    let trousers = [[0, 0], [1, 0], [1, 3], [2, 3], [2, 0], [3, 0], [3, 4], [0, 4]];
    let arrow = [[0, 0], [2, 1], [4, 0], [2, 4]];
    let comb =
        [[0, 0], [1, 0], [1, 2], [2, 2], [2, 0], [3, 0], [3, 2], [4, 2], [4, 0], [5, 0], [5, 3], [0, 3]];
    for (polygon, expected) in [(&trousers[..], 9.0), (&arrow[..], 6.0), (&comb[..], 11.0)] {
        for first in 0..polygon.len() {
            for is_reversed in [false, true] {
                let mut corners: Vec<Vec3> =
                    polygon.iter().map(|[x, y]| Vec3::new(*x as f32, 0.5 * *y as f32, *y as f32)).collect();
                corners.rotate_left(first);
                if is_reversed {
                    corners.reverse();
                }
                let found = area(&corners) / 1.25_f32.sqrt();
                assert!((found - expected).abs() < 1e-4, "{first} {is_reversed}: {found}, not {expected}");
            }
        }
    }
    // A polygon without an area, and one that crosses itself, still give triangles.
    assert_eq!(triangles(&[Vec3::ZERO; 5]).len(), 3);
    assert_eq!(triangles(&[Vec3::ZERO, Vec3::ONE, Vec3::X, Vec3::Y]).len(), 2);
}

#[test]
fn objs_of_every_writer_are_read() {
    let folder = Folder::new();
    folder.file("Skin.PNG", png());
    folder.file("a.mtl", "NEWMTL a\n\tKD 1 0 \\\n 0\n");
    folder.file("b.mtl", "newmtl b\nmap_kd skin.png\n");
    let start =
        "mtllib a.mtl b.mtl\n\tv\t0 0 0\nv 1 0 0 # right\nv 0 1 0 1.0\nv 7 7 7\nvt 0 0\nvt 1 0\nvt 0 1\n";
    let faces = "usemtl a\nf 1 \\\n2 3\n  usemtl\tb\nf 1/1 2/2 3/3\n";
    let mesh = read(&folder.file("a.obj", format!("{start}{faces}"))).expect("reads");
    assert_eq!(corners(&mesh), [[Vec3::ZERO, Vec3::X, Vec3::Y]; 2]);
    assert_eq!(mesh.positions.len(), 3, "a vertex without a face is no part of the surface");
    let [a, b] = [0, 1].map(|face| &mesh.materials[mesh.faces[face].material as usize]);
    assert!(a.color == Vec3::X && a.texture.is_none() && b.texture.is_some());
    assert!(a.opacity.is_none() && b.opacity.is_none());

    // Hair cards: the picture of `map_d` cuts them out by its alpha, or else by its brightness.
    let half = |x: u32| if x == 0 { 40 } else { 200 };
    let grey = image::GrayImage::from_fn(2, 1, |x, _| image::Luma([half(x)]));
    let clear = RgbaImage::from_fn(2, 1, |x, _| image::Rgba([255, 255, 255, half(x)]));
    for (name, picture) in [("grey.png", as_png(grey)), ("clear.png", as_png(clear))] {
        folder.file(name, picture);
        folder.file("b.mtl", format!("newmtl b\nmap_kd skin.png\nmap_d -imfchan m {name}\n"));
        let mesh = read(&folder.file("a.obj", format!("{start}{faces}"))).expect("reads");
        let hair = &mesh.materials[mesh.faces[1].material as usize];
        let opacity = hair.opacity.as_ref().expect("is cut out");
        assert_eq!(opacity.as_raw(), &[0, 255], "{name}");
    }
    // Some vertices have colours; the others are white.
    let mixed = "v 0 0 0\nv 1 0 0 1 0 0 0.5\nv 0 1 0\nv 5 5 5 0 0 1\nf 1 2 3\n";
    assert_eq!(read(&folder.file("b.obj", mixed)).expect("reads").colors, [Vec3::ONE, Vec3::X, Vec3::ONE]);
    let of_255 = "v 0 0 0 255 0 0\nv 1 0 0 0 255 0\nv 0 1 0 0 0 51\nf 1 2 3\n";
    let colors = read(&folder.file("b.obj", of_255)).expect("reads").colors;
    assert_eq!(colors, [Vec3::X, Vec3::Y, 0.2 * Vec3::Z]);
    // A last line without an end is whole if comments count as many vertices and faces as there are.
    let counted = "# 3 vertices\n# 1 faces\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3";
    assert_eq!(read(&folder.file("c.obj", counted)).expect("reads").faces.len(), 1);
    for (text, expected) in [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n", "line 4: its material `a` is missing"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "line 4, `f 1 2 0`: no face"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "line 4, `f 1 2 -4`: no face"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n", "texture coordinate 1, there are 0"),
    ] {
        let error = read(&folder.file("d.obj", text)).map(|_| ()).expect_err(text).to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn plys_with_several_textures_name_them_by_face() {
    let folder = Folder::new();
    folder.file("a.png", png());
    let text = |number: &str, rows: [&str; 2]| {
        format!(
            "ply\nformat ascii 1.0\ncomment TextureFile a.png\ncomment TextureFile a.png\nelement vertex 3\n\
             property float x\nproperty float y\nproperty float z\nelement face 2\n\
             property list uchar int vertex_indices\nproperty list uchar float texcoord\n{number}end_header\n\
             0 0 0\n1 0 0\n0 1 0\n{}\n{}\n",
            rows[0], rows[1]
        )
    };
    let face = "3 0 1 2 6 0 0 1 0 0 1";
    let rows = [format!("{face} 1"), format!("{face} 0")];
    let number = "property int texnumber\n";
    let mesh = read(&folder.file("a.ply", text(number, [&rows[0], &rows[1]]))).expect("reads");
    assert_eq!(mesh.faces.iter().map(|face| face.material).collect::<Vec<_>>(), [1, 0]);
    for (text, expected) in [
        (text("", [face, face]), "has 2 textures, and `face` has no `texnumber`"),
        (text(number, [&format!("{face} 2"), &rows[1]]), "refers to material 2, there are 2"),
        (text(number, ["3 0 1 2 0 0", &rows[1]]), "a face without texture coordinates"),
        (text(number, ["3 0 1 9 6 0 0 1 0 0 1 0", &rows[1]]), "refers to position 9, there are 3"),
    ] {
        let error = read(&folder.file("b.ply", text)).map(|_| ()).expect_err("refused").to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn colours_of_faces_become_materials() {
    let folder = Folder::new();
    let text = |count: usize, row: &dyn Fn(usize) -> String| {
        let rows: String = (0..count).map(row).collect();
        format!(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
             element face {count}\nproperty list uchar int vertex_indices\nproperty uchar red\n\
             property uchar green\nproperty uchar blue\nend_header\n0 0 0\n1 0 0\n0 1 0\n{rows}"
        )
    };
    let some = text(3, &|row| format!("3 0 1 2 {} 0 51\n", [255, 0, 255][row]));
    let mesh = read(&folder.file("a.ply", some)).expect("reads");
    let color = |face: usize| mesh.materials[mesh.faces[face].material as usize].color;
    assert_eq!([0, 1, 2].map(color), [255.0, 0.0, 255.0].map(|red| Vec3::new(red, 0.0, 51.0) / 255.0));
    let many = text(5000, &|row| format!("3 0 1 2 {} {} 0\n", row / 256, row % 256));
    let error = read(&folder.file("b.ply", many)).map(|_| ()).expect_err("too many").to_string();
    assert!(error.contains("more than 4096 colours: give its vertices colours instead"), "{error}");
}

/// The triangle of [`glb`] with another material, texture and further keys.
fn with(material: &str, texture: &str, keys: &str) -> Vec<u8> {
    glb(|json| json.replace(PLAIN, material).replace(SOURCE, texture).replacen('{', &format!("{{{keys}"), 1))
}

const PLAIN: &str = r#""materials":[{"pbrMetallicRoughness":{"baseColorTexture":{"index":0}}}]"#;
const SOURCE: &str = r#""textures":[{"source":0}]"#;
const PICTURE: &str = r#"{"bufferView":3,"mimeType":"image/png"}"#;

#[test]
fn glbs_of_every_writer_are_read() {
    let folder = Folder::new();
    let mesh = |bytes: Vec<u8>| read(&folder.file("a.glb", bytes)).expect("reads");
    let material = |mesh: &Mesh| mesh.materials[mesh.faces[0].material as usize].clone();
    let required = |name: &str| format!(r#""extensionsUsed":["{name}"],"extensionsRequired":["{name}"],"#);
    // Specular and glossy, with a texture, or with a colour.
    let glossy = |diffuse: &str| {
        format!(r#""materials":[{{"extensions":{{"KHR_materials_pbrSpecularGlossiness":{{{diffuse}}}}}}}]"#)
    };
    let name = "KHR_materials_pbrSpecularGlossiness";
    let textured = mesh(with(&glossy(r#""diffuseTexture":{"index":0}"#), SOURCE, &required(name)));
    assert!(material(&textured).texture.is_some());
    let red = mesh(with(&glossy(r#""diffuseFactor":[1,0,0,1]"#), SOURCE, ""));
    assert!(material(&red).color.abs_diff_eq(Vec3::X, 1e-6) && material(&red).texture.is_none());
    // Light that is baked into a texture that shines.
    let baked = r#""materials":[{"pbrMetallicRoughness":{"baseColorFactor":[0,0,0,1]},"emissiveTexture":{"index":0}}]"#;
    let shining = material(&mesh(with(baked, SOURCE, "")));
    assert!(shining.texture.is_some() && shining.color.abs_diff_eq(Vec3::ONE, 1e-6));
    // Half of the texture, turned by 90° counter-clockwise and moved.
    let transform = r#""KHR_texture_transform":{"offset":[0.25,0.5],"rotation":1.5707963,"scale":[0.5,1]}"#;
    let turned = PLAIN.replace(r#""index":0"#, &format!(r#""index":0,"extensions":{{{transform}}}"#));
    let places =
        texcoords(&mesh(with(&turned, SOURCE, &required("KHR_texture_transform"))), 0).expect("has some");
    // From (0, 1), (1, 1), (0, 0), counted from the top.
    for (found, [u, v]) in places.iter().zip([[1.25, 0.5], [1.25, 0.0], [0.25, 0.5]]) {
        assert!(found.abs_diff_eq(Vec2::new(u, 1.0 - v), 1e-6), "{places:?}");
    }
    // WebP alone.
    let webp = r#""textures":[{"extensions":{"EXT_texture_webp":{"source":0}}}]"#;
    assert!(material(&mesh(with(PLAIN, webp, &required("EXT_texture_webp")))).texture.is_some());
    // A picture as text, and zeros after the JSON.
    let text = format!("data:image/png;base64,{}", BASE64_STANDARD.encode(png()));
    let in_text = changed(PICTURE, &format!(r#"{{"uri":"{text}"}}"#));
    assert!(material(&mesh(in_text)).texture.is_some());
    assert_eq!(mesh(glb(|json| json + "\0\0\0")).faces.len(), 1);
    // Positions as shares of the largest number, which the node enlarges.
    let quantized = glb(|json| {
        let json = json.replacen("\"componentType\":5126", "\"componentType\":5122,\"normalized\":true", 1);
        json.replacen("\"byteLength\":36", "\"byteLength\":36,\"byteStride\":12", 1)
    });
    let found = corners(&mesh(quantized));
    // The upper halves of 1.0 as f32: 0x3f80 of 0x7fff.
    assert!((found[0][1].y - 16_256.0 / 32_767.0).abs() < 1e-6, "{found:?}");
    for (bytes, expected) in [
        (
            with(PLAIN, SOURCE, &required("KHR_draco_mesh_compression")),
            "KHR_draco_mesh_compression, which is not read: export",
        ),
        (with(PLAIN, SOURCE, &required("ACME_secret")), "requires the extension ACME_secret"),
        (with(PLAIN, r#""textures":[{}]"#, ""), "texture 0 has no picture"),
        (
            with(PLAIN, r#""textures":[{"extensions":{"EXT_texture_webp":{"source":7}}}]"#, ""),
            "texture 0 has no picture",
        ),
        (changed(r#","TEXCOORD_0":1"#, ""), "has a texture, but no `TEXCOORD_0`"),
        (changed(PICTURE, r#"{"uri":"a.png"}"#), "picture 0 is another file, a.png"),
        (changed("\"buffers\":[{", "\"buffers\":[{\"uri\":\"a.bin\","), "its data is another file, a.bin"),
    ] {
        let error = read(&folder.file("b.glb", bytes)).map(|_| ()).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    }
}

/// A hair card is no board: texels without opacity show what is behind.
#[test]
fn surfaces_are_cut_out_where_their_texture_has_no_opacity() {
    let folder = Folder::new();
    // The left half is solid.
    let texel = |x: u32, _: u32| image::Rgba([255, 255, 255, if x < 4 { 255 } else { 60 }]);
    let picture = BASE64_STANDARD.encode(as_png(RgbaImage::from_fn(8, 8, texel)));
    let uri = format!(r#"{{"uri":"data:image/png;base64,{picture}"}}"#);
    let coverage = |mode: &str| {
        let bytes = glb(|json| {
            json.replace(PICTURE, &uri).replace(r#""materials":[{"#, &format!(r#""materials":[{{{mode}"#))
        });
        let mesh = read(&folder.file("a.glb", bytes)).expect("reads");
        // Above (½, ½, 7), looking down at the triangle.
        let world_to_camera = RigidTransform {
            rotation: DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
            translation: DVec3::new(-0.5, 0.5, 7.0),
        };
        let (focal, principal_point) = (DVec2::splat(64.0), DVec2::splat(32.0));
        let camera = Camera { width: 64, height: 64, focal, principal_point, world_to_camera };
        let view = Renderer::new(&mesh).expect("sound").draw(&camera, &ViewOptions::default());
        view.alpha.iter().sum::<f32>()
    };
    let whole = coverage("");
    assert!(whole > 100.0, "{whole}");
    // The left half of a right-angled triangle is three quarters of it.
    for (mode, share) in [
        (r#""alphaMode":"MASK","#, 0.75),
        (r#""alphaMode":"BLEND","#, 0.75),
        (r#""alphaMode":"MASK","alphaCutoff":0.2,"#, 1.0),
        (r#""alphaMode":"OPAQUE","#, 1.0),
    ] {
        let found = coverage(mode) / whole;
        assert!((found - share).abs() < 0.02, "{mode}: {found}, not {share}");
    }
}
