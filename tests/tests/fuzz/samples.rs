//! Small sound samples.

use std::fs;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use glam::{Vec2, Vec3};
use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::{self, Folder, Layout, Split};
use snapsnap_data::prepare::{DataConfig, ViewsConfig};
use snapsnap_mesh::export;
use snapsnap_mesh::mesh::{Face, Material, Mesh};
use snapsnap_net::config::Config;
use snapsnap_net::weights::init;
use snapsnap_splat::{Camera, Gaussians, scene};
use snapsnap_tests::character::character;
use snapsnap_tests::ply::{balls, cloud, ply_bytes};
use snapsnap_tests::{TRAINING, data};

/// Side of a photograph: the smallest that is taken.
const SIDE: u32 = 64;
/// A training of the smallest networks that make sense.
const SMALL: &str = include_str!("../../../crates/train/src/stability/small.toml");
/// Most kinds of keys of an evaluation, with small values.
const EVALUATION: &str = r#"
[data]
folders = ["in/set"]
subjects = 1
only = ["0000"]
scans = "in/scans"
[views]
inputs = [0, 2]
turns = [0]
resolution = 32
supersampling = 1
[model]
set = ["network.conf_threshold=0.4"]
[metrics]
protocols = ["paper", "masked"]
lpips = "in/none"
opaque = 0.1
[baselines]
mean = ["in/set"]
[ablations.sideless]
sides = false
[groups.loose]
subjects = ["0000"]
[report]
people = 1
degrees = [0.0, 90.0]
"#;
const BENCH: &str = r#"
[data]
folders = ["in/set"]
[bench]
runs = 2
warm_up = 1
people = 1
views = 2
resolution = 32
oracle = 4
lpips = "in/none"
[settings."no sides"]
scene = "standing"
omits = "the sides"
sides = false
side_colors = false
stride = 2
min_opacity = 0.1
only = ["0000"]
inputs = [0, 2]
[settings.tuned]
knob = "Gaussians"
set = ["network.conf_threshold=0.4"]
preset = "gsplat"
antialiased = true
precision = "f32"
supersampling = 1
"#;

/// Writes a file of a sample, and the folders around it.
fn put(folder: &Path, name: &str, content: impl AsRef<[u8]>) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().expect("in a folder")).expect("a folder");
    fs::write(path, content).expect("a file");
}

// Photographs and masks.

/// A standing ellipse of many colours before nothing.
fn picture() -> DynamicImage {
    let picture = RgbaImage::from_fn(SIDE, SIDE, |x, y| {
        let [u, v] = [x, y].map(|at| at as f32 / SIDE as f32 - 0.5);
        let is_inside = (u / 0.3).powi(2) + (v / 0.45).powi(2) < 1.0;
        Rgba([(x * 7) as u8, (y * 5) as u8, ((x + y) * 3) as u8, if is_inside { 255 } else { 0 }])
    });
    picture.into()
}

fn save(folder: &Path, name: &str, picture: &DynamicImage) {
    picture.save(folder.join(name)).expect("encodes");
}

pub fn png_and_webp(folder: &Path) {
    save(folder, "a.png", &picture());
    save(folder, "b.webp", &picture());
    weights(folder);
}

pub fn deep_and_gif(folder: &Path) {
    save(folder, "a.png", &picture().into_rgba16().into());
    save(folder, "b.gif", &picture());
    weights(folder);
}

pub fn tiff_and_bmp(folder: &Path) {
    save(folder, "a.tiff", &picture());
    save(folder, "b.bmp", &picture());
    weights(folder);
}

/// A JPEG whose EXIF data say which way is up, and a progressive one, which the encoder at hand does not write.
pub fn jpegs_and_masks(folder: &Path) {
    let mut jpeg = Cursor::new(Vec::new());
    let plain = DynamicImage::from(picture().into_rgb8());
    plain.write_to(&mut jpeg, ImageFormat::Jpeg).expect("encodes");
    let jpeg = jpeg.into_inner();
    // APP1 segment: "Exif", little-endian TIFF with one entry, tag 0x0112 (orientation) = 2 (mirrored).
    let exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x02\0\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    put(folder, "a.jpg", [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat());
    put(folder, "b.jpg", include_bytes!("../../../crates/mesh/tests/progressive.jpg"));
    let mask = GrayImage::from_fn(SIDE, SIDE, |x, y| {
        Luma([image::GenericImageView::get_pixel(&picture(), x, y).0[3]])
    });
    save(folder, "m.png", &mask.clone().into());
    save(folder, "m.jpg", &mask.into());
    weights(folder);
}

/// With a HEIC in place of the first, made with libheif.
pub fn heic_and_masks(folder: &Path) {
    jpegs_and_masks(folder);
    put(folder, "a.jpg", include_bytes!("../../../crates/mesh/tests/square.heic"));
}

/// Two pictures and a mask.
pub fn compared(folder: &Path) {
    save(folder, "a.png", &picture());
    save(folder, "b.tiff", &picture().into_rgb32f().into());
    save(
        folder,
        "m.png",
        &GrayImage::from_fn(SIDE, SIDE, |x, _| Luma([if x < 40 { 255 } else { 0 }])).into(),
    );
}

// Weights and configs.

pub fn weights(folder: &Path) {
    let (networks, _) = SMALL.split_once("[samples]").expect("sections of networks before the others");
    put(folder, "c.toml", networks);
    let config = Config::from_toml(networks, "the smallest networks", &[]).expect("a sound config");
    init(&config, 1, &folder.join("w.safetensors"), &|_, _| ()).expect("written");
}

/// In the authors' layouts.
pub fn checkpoints(folder: &Path) {
    for name in ["stage1.pth", "stage2.pth"] {
        put(folder, name, fs::read(data("pipeline").join(name)).expect("test data"));
    }
    put(folder, "c.toml", include_str!("../../../configs/tiny.toml"));
}

pub fn training(folder: &Path) {
    four_views(&folder.join("set"), &[Split::Train]);
    weights(folder);
    put(
        folder,
        "t.toml",
        format!("{TRAINING}[data]\nfolders = [\"in/set\"]\n[samples.augment]\nexposure = 0.1\n"),
    );
}

/// A test person with a scan and a training person, with four views each; weights, and both configs.
pub fn evaluation(folder: &Path) {
    four_views(&folder.join("set"), &[Split::Test, Split::Train]);
    weights(folder);
    fs::create_dir(folder.join("scans")).expect("a folder");
    export::write_obj(&block(), &folder.join("scans/0000.obj")).expect("written");
    put(folder, "e.toml", EVALUATION);
    put(folder, "b.toml", BENCH);
}

// Gaussians.

pub fn gaussians(folder: &Path, name: &str) {
    let device = Device::flex();
    let three = Gaussians::new(
        Tensor::from_floats([[0.0, 0.3, 0.0], [0.1, 0.9, 0.05], [-0.1, 1.5, -0.05]], &device),
        Tensor::from_floats([[1.0, 0.0, 0.0, 0.0], [0.8, 0.6, 0.0, 0.0], [0.0, 0.0, 0.6, 0.8]], &device),
        Tensor::full([3, 3], 0.1, &device),
        Tensor::full([3], 0.9, &device),
        Tensor::full([3, 3], 0.5, &device),
    );
    scene::write(&three.expect("three of each"), &folder.join(name)).expect("written");
}

/// An element that is skipped, before the Gaussians.
const EDGE: &str = "element face 1\nproperty list uchar int vertex_indices\n";

pub fn gaussians_ascii(folder: &Path) {
    let bytes = ply_bytes(&cloud(2, 1), snapsnap_tests::ply::Format::Ascii, EDGE, b"3 0 1 0\n");
    put(folder, "h.ply", bytes);
}

pub fn gaussians_big_endian(folder: &Path) {
    let face = [&[3][..], &[0_i32, 1, 0].map(i32::to_be_bytes).concat()].concat();
    put(folder, "h.ply", ply_bytes(&cloud(2, 2), snapsnap_tests::ply::Format::Big, EDGE, &face));
}

pub fn spz_harmonics(folder: &Path) {
    put(folder, "h.spz", fs::read(data("spz/v3_degree3.spz")).expect("test data"));
}

pub fn cameras(folder: &Path) {
    gaussians(folder, "h.ply");
    snapsnap_splat::camera_file::write(&Camera::orbit(2, 24, 16), &folder.join("cameras.json"))
        .expect("written");
}

/// Gaussians on an upright ellipsoid of 2 by 0.24 metres, whose mesh takes a third of the time of a ball's.
pub fn column(folder: &Path) {
    let places = (0..60_u16).map(|i| {
        let y = 1.0 - 2.0 * (f32::from(i) + 0.5) / 60.0;
        let (sin, cos) = (2.4 * f32::from(i)).sin_cos();
        let radius = 0.12 * (1.0 - y * y).sqrt();
        [radius * cos, y, radius * sin]
    });
    put(folder, "h.ply", balls(places, 0.08_f32.ln()));
}

// Scans.

/// A block as large as a person, no side like another, half of it with a texture.
fn block() -> Mesh {
    let corner = |i: u32| {
        let [x, y, z] = [i & 1, i >> 1 & 1, i >> 2].map(|bit| bit as f32);
        Vec3::new(0.5 * x - 0.2 - 0.1 * y, 1.7 * y + 0.05 * x, 0.3 * z - 0.15 + 0.1 * y * x)
    };
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().enumerate().flat_map(|(side, rows)| {
        let material = side as u32 / 3;
        [[0, 1, 2], [0, 2, 3]].map(|corners: [usize; 3]| Face {
            positions: corners.map(|corner| rows[corner]),
            texcoords: (material == 0).then(|| corners.map(|corner| corner as u32)),
            material,
        })
    });
    let texture = RgbImage::from_fn(8, 8, |x, y| Rgb([(x * 30) as u8, (y * 30) as u8, 128]));
    Mesh {
        positions: (0..8).map(corner).collect(),
        texcoords: vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y],
        faces: faces.collect(),
        materials: vec![
            Material { color: Vec3::ONE, texture: Some(Arc::new(texture)) },
            Material { color: Vec3::new(0.2, 0.4, 0.6), texture: None },
        ],
        ..Mesh::default()
    }
}

fn obj(folder: &Path, name: &str) {
    export::write_obj(&block(), &folder.join(name)).expect("written");
}

/// The second material has a TIFF.
pub fn obj_and_textures(folder: &Path) {
    obj(folder, "a.obj");
    let texture = image::open(folder.join("a_0.png")).expect("just written");
    save(folder, "a.tiff", &texture);
    put(
        folder,
        "a.mtl",
        "newmtl m0\nKd 1 1 1\nmap_Kd a_0.png\nnewmtl m1\nKd 0.2 0.4 0.6\nmap_Kd -s 1 1 1 a.tiff\n",
    );
}

pub fn glb(folder: &Path) {
    export::write(&block(), &folder.join("a.glb")).expect("written");
}

/// Colours, texture coordinates, polygons and an element that is skipped.
pub fn ply(folder: &Path, format: &str) {
    let mesh = block();
    let mut bytes = format!(
        "ply\nformat {format} 1.0\ncomment TextureFile skin.png\nelement vertex 8\nproperty float x\nproperty double y\n\
         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement edge 1\n\
         property list uchar int16 ends\nelement face 12\nproperty list uchar int vertex_indices\n\
         property list uchar float texcoord\nend_header\n"
    )
    .into_bytes();
    let (is_text, is_big_endian) = (format == "ascii", format.contains("big"));
    let mut add = |value: f64, binary: &[u8]| {
        if is_text {
            bytes.extend(format!("{value} ").bytes());
        } else if is_big_endian {
            bytes.extend(binary.iter().rev());
        } else {
            bytes.extend(binary);
        }
    };
    for (row, position) in mesh.positions.iter().enumerate() {
        let (y, color) = (f64::from(position.y), 30 * row as u8);
        add(position.x.into(), &position.x.to_le_bytes());
        add(y, &y.to_le_bytes());
        add(position.z.into(), &position.z.to_le_bytes());
        (0..3).for_each(|channel| add((color + channel).into(), &[color + channel]));
    }
    add(2.0, &[2]);
    [0_i16, 3].into_iter().for_each(|row| add(row.into(), &row.to_le_bytes()));
    for face in &mesh.faces {
        add(3.0, &[3]);
        face.positions.iter().for_each(|row| add((*row).into(), &row.to_le_bytes()));
        add(6.0, &[6]);
        for row in face.texcoords.unwrap_or_default() {
            let texcoord = mesh.texcoords[row as usize].to_array();
            texcoord.into_iter().for_each(|value| add(value.into(), &value.to_le_bytes()));
        }
    }
    put(folder, "a.ply", bytes);
    save(folder, "skin.png", &picture());
}

/// The first person is for test.
pub fn avatars(folder: &Path) {
    ["a_suit.glb", "b_suit.glb"].iter().for_each(|name| put(folder, name, character(1.0, |_| {})));
}

/// Scans with the parameters of their bodies.
pub fn smplx(folder: &Path) {
    let parameters: [(&str, &[u8]); 4] = [
        ("1.pkl", include_bytes!("../../../crates/data/tests/smplx/protocol2.pkl")),
        ("2.pkl", include_bytes!("../../../crates/data/tests/smplx/protocol4.pkl")),
        ("3.pkl", include_bytes!("../../../crates/data/tests/smplx/big_endian.pkl")),
        (
            "4.json",
            br#"{"betas": [[0.1, 0.2]], "global_orient": [[0.1, 1.5707963267948966, 0]], "scale": 1.0}"#,
        ),
    ];
    for (name, content) in parameters {
        obj(folder, &format!("{}.obj", &name[..1]));
        put(folder, &format!("smplx/{name}"), content);
    }
}

pub fn data_config(folder: &Path) {
    obj(folder, "a.obj");
    put(folder, "c.toml", include_str!("../../../configs/data/training.toml"));
}

/// MakeHuman's data in small: a base mesh of a few tubes with the names that people are made by, clothes and hair bound
/// to it, and a motion file. The person of seed 2 wears a suit, shoes and hair.
pub fn makehuman(folder: &Path) {
    let file = fs::File::open(data("makehuman.zip")).expect("test data");
    zip::ZipArchive::new(file).and_then(|mut archive| archive.extract(folder)).expect("a sound archive");
}

// Data sets.

fn set(root: &Path, splits: &[Split], views: ViewsConfig) {
    let config = DataConfig { views: ViewsConfig { samples_per_axis: 1, ..views }, ..DataConfig::default() };
    let people = splits.iter().map(|split| (*split, "0000".to_owned(), block()));
    config.make(root, "for tests", people).expect("written").tidy();
}

/// One subject of four views in each split.
fn four_views(root: &Path, splits: &[Split]) {
    set(root, splits, ViewsConfig { count: 4, resolution: 64, ..ViewsConfig::default() });
}

fn two_views(root: &Path, layout: Layout) {
    set(root, &[Split::Train], ViewsConfig { count: 2, resolution: 16, layout, ..ViewsConfig::default() });
}

pub fn exact_set(folder: &Path) {
    two_views(&folder.join("set"), Layout::Exact);
}

pub fn authors_set(folder: &Path) {
    two_views(&folder.join("set_16_2"), Layout::Authors);
}

pub fn packed_set(folder: &Path) {
    let temporary = tempfile::tempdir().expect("a folder");
    two_views(temporary.path(), Layout::Exact);
    let set = Folder::open(temporary.path()).expect("opens");
    dataset::pack(&set, &folder.join("packed"), 1 << 20, |_, _| {}).expect("packs");
}
